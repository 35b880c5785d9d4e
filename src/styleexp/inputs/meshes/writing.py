"""Save meshes: moved vertices in the original file's rows, materials and nodes."""

from __future__ import annotations

import io
import os
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import trimesh

from styleexp.inputs.meshes.gltf_making import new_glb
from styleexp.inputs.meshes.gltf_writing import glb_of
from styleexp.inputs.meshes.mesh import Carrier, Mesh, vertex_normals
from styleexp.inputs.meshes.obj import MAP
from styleexp.inputs.meshes.ply_meshes import ply_of
from styleexp.inputs.meshes.references import bare
from styleexp.system import atomic
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from jaxtyping import Float


SUFFIXES = (".ply", ".obj", ".glb", ".stl", ".3mf")
"""Formats that can be written."""


def save_mesh(
    mesh: Mesh,
    vertices: Float[np.ndarray, "vertices 3"],
    path: str | os.PathLike[str],
    displacement: Float[np.ndarray, " vertices"] | None = None,
) -> None:
    """Write a mesh with moved vertices, as PLY (binary), OBJ, GLB, STL (binary) or 3MF by
    ``path``'s extension.

    ``vertices`` replace `Mesh.vertices`, in the same frame. The input file's rows are preserved:
    texture coordinates with their seams, materials and images, colours, part names, winding.
    Normals are recomputed, smooth but for the hard edges of a glTF or PLY input's own.

    - PLY: one object without textures; ``displacement`` is a float vertex property. A PLY input's
      own properties are preserved, in their types. No normals where the file's rows can't have the
      hard edges of a glTF input.
    - OBJ: faces and materials in the file's order. Materials and images are written next to it,
      named after it: ``out.obj``, ``out.mtl``, ``out_wood.png``. No normals where the input has
      smoothing groups, which are preserved.
    - GLB: a glTF input's own document, with new positions and normals (if it has normals) and
      without tangents; otherwise one node per part. ``displacement`` is the custom attribute
      ``_DISPLACEMENT``, in the mesh's own units regardless of node scales.
    - STL, 3MF: for printing, geometry alone, welded, wound outwards. A 3MF needs a unit: one of the
      mesh's own is a millimetre.

    PLY, GLB and STL use single precision, but a PLY whose source has doubles uses doubles. Every
    file is replaced atomically, so an interrupted run leaves no partial files. Raises `UserError`
    if the path isn't writable, the extension is unknown or values are not finite.
    """
    path = Path(path)
    kind = path.suffix.lower()
    vertices = np.asarray(vertices, dtype=np.float64)
    if vertices.shape != mesh.vertices.shape:
        raise ValueError(f"expected vertices of shape {mesh.vertices.shape}, got {vertices.shape}")
    if displacement is not None and np.shape(displacement) != (len(vertices),):
        raise ValueError(f"expected {len(vertices)} displacements, got {np.shape(displacement)}")
    if not np.isfinite(vertices).all():
        raise UserError(
            f"'{path}' was not written: the result has NaN or infinite vertices because the run "
            "diverged; lower the learning rate."
        )
    if kind not in SUFFIXES:
        raise UserError(f"'{path}' cannot be written: supported formats are {', '.join(SUFFIXES)}.")
    if kind not in (".obj", ".3mf") and np.abs(vertices).max() > np.finfo(np.float32).max:
        raise UserError(
            f"'{path}' cannot store such large coordinates: save as OBJ or scale the mesh down."
        )
    carrier = mesh.carrier or Carrier(
        mesh.faces, np.arange(len(vertices)), np.zeros(len(mesh.faces), bool), parts=(mesh.name,)
    )
    if kind == ".stl":
        files = {
            path.name: trimesh.Trimesh(vertices, mesh.faces, process=False).export(None, "stl")
        }
    elif kind == ".3mf":
        files = {path.name: _3mf(vertices, mesh.faces)}
    elif kind == ".ply":
        files = {path.name: _ply(carrier, mesh, vertices, displacement)}
    elif kind == ".obj":
        files = _obj(carrier, mesh, vertices, path)
    else:
        values = None if displacement is None else np.asarray(displacement, np.float32)
        normals = _row_normals(carrier, vertices)
        rows = carrier.rows
        values = None if values is None else values[rows]
        if carrier.document is not None:
            moved = (vertices != mesh.vertices).any(axis=1)[rows]
            content = glb_of(carrier, vertices[rows], moved, normals, values)
        else:
            content = new_glb(carrier, list(_runs(carrier)), vertices[rows], normals, values)
        files = {path.name: content}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for name, content in files.items():  # write the mesh last, after the files it refers to
            atomic.write(path.with_name(name), atomic.data(content))
    except OSError as error:
        raise UserError(f"'{path}' cannot be written ({error.strerror or error}).") from None


def glb_as_it_is(mesh: Mesh, normals: Float[np.ndarray, "rows 3"]) -> bytes:
    """A GLB of a mesh that was not moved, with these unit normals of its rows; a glTF input's
    document keeps its own."""
    carrier = mesh.carrier
    assert carrier is not None
    points = mesh.vertices[carrier.rows]
    if carrier.document is not None:
        return glb_of(carrier, points, np.zeros(len(points), bool), normals, None)
    return new_glb(carrier, list(_runs(carrier)), points, normals, None)


def _normals(carrier: Carrier, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals (normals, 3), smooth across corners that the file's normals mark as smooth, and
    the index of each row's."""
    groups = carrier.rows
    if carrier.normals is not None:
        rounded = np.round(np.nan_to_num(carrier.normals) * 50)
        groups = _distinct(carrier.rows, rounded)[1]
    faces = carrier.rows[carrier.corners]
    return vertex_normals(vertices, faces, groups[carrier.corners]), groups


def _row_normals(carrier: Carrier, vertices: np.ndarray) -> np.ndarray:
    """Unit normals (rows, 3)."""
    normals, index = _normals(carrier, vertices)
    return normals[index]


def _distinct(*columns: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Distinct combinations of column values: the first row of each, and each row's combination."""
    table = np.column_stack([column for column in columns if column is not None])
    _, first, inverse = np.unique(table, axis=0, return_index=True, return_inverse=True)
    return first, inverse.ravel()


def ply_rows(carrier: Carrier) -> tuple[np.ndarray, np.ndarray]:
    """The rows written to a PLY file, in order, and the index among them of each original row."""
    if carrier.ply is not None and carrier.ply.rows:
        return np.arange(len(carrier.rows)), np.arange(len(carrier.rows))
    return _distinct(carrier.rows, carrier.uv, carrier.colors, *carrier.attributes.values())


def _runs(carrier: Carrier, *more: np.ndarray) -> Iterator[tuple[int, int, np.ndarray]]:
    """Yield runs of faces with equal part, material (-1 for none) and values of ``more``."""
    n = len(carrier.corners)
    part = np.zeros(n, dtype=np.int64) if carrier.face_part is None else carrier.face_part
    material = np.full(n, -1) if carrier.face_material is None else carrier.face_material
    changes = [np.diff(column) != 0 for column in (part, material, *more)]
    turns = np.flatnonzero(np.logical_or.reduce(changes)) + 1
    for run in np.split(np.arange(n), turns):
        yield int(part[run[0]]), int(material[run[0]]), run


def _ply(
    carrier: Carrier, mesh: Mesh, vertices: np.ndarray, displacement: np.ndarray | None
) -> bytes:
    first, combined = ply_rows(carrier)
    rows = carrier.rows[first]
    points, of_rows = vertices[rows], _row_normals(carrier, vertices)
    normals: np.ndarray | None = of_rows[first]
    if not np.array_equal(of_rows, of_rows[first][combined]):
        normals = None  # hard edges would become smooth
    if carrier.ply is not None:
        moved = (vertices != mesh.vertices).any(axis=1)
        own = np.stack([carrier.ply.vertex[name] for name in "xyz"], axis=1)[first]
        # Welded rows that did not move keep their exact positions.
        points = np.where(moved[rows][:, None], points, own)
        if carrier.normals is not None:
            near = np.zeros(len(vertices), dtype=bool)
            near[mesh.faces[moved[mesh.faces].any(axis=1)]] = True
            normals = np.where(near[rows][:, None], of_rows[first], carrier.normals[first])
    values = None if displacement is None else np.asarray(displacement)[rows]
    return ply_of(carrier, first, combined[carrier.corners], points, normals, values)


def _3mf(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    """A package with one object: the core specification's model, its type and its relation."""
    points = "".join(
        f'<vertex x="{x:.9g}" y="{y:.9g}" z="{z:.9g}"/>' for x, y, z in vertices.tolist()
    )
    corners = "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in faces.tolist())
    schemas = "http://schemas.openxmlformats.org/package/2006"
    model = (
        '<model unit="millimeter" xml:lang="en-US" '
        'xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02">'
        '<resources><object id="1" type="model"><mesh>'
        f"<vertices>{points}</vertices><triangles>{corners}</triangles>"
        '</mesh></object></resources><build><item objectid="1"/></build></model>'
    )
    types = (
        f'<Types xmlns="{schemas}/content-types">'
        '<Default Extension="rels" '
        'ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
        '<Default Extension="model" '
        'ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>'
    )
    relation = (
        f'<Relationships xmlns="{schemas}/relationships"><Relationship Target="/3D/3dmodel.model" '
        'Id="rel0" Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/>'
        "</Relationships>"
    )
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as package:
        for name, text in (
            ("[Content_Types].xml", types), ("_rels/.rels", relation), ("3D/3dmodel.model", model)
        ):  # fmt: skip
            # With a date of its own, so that equal meshes make equal files.
            entry = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED
            package.writestr(entry, f'<?xml version="1.0" encoding="UTF-8"?>\n{text}')
    return out.getvalue()


# --------------------------------------------------------------------------------------------- OBJ


def _obj(carrier: Carrier, mesh: Mesh, vertices: np.ndarray, path: Path) -> dict[str, bytes]:
    files: dict[str, bytes] = {}
    out = ["# written by styleexp"]
    names: list[str] = []
    for material in carrier.materials:
        names.append(trimesh.util.unique_name(material.name or "material", names))
    if names:
        out.append(f"mtllib {path.stem}.mtl")
        mtl, textures = (carrier.mtl, carrier.textures) if carrier.mtl else _mtl(carrier, names)
        beside: dict[str, str] = {}
        for key in textures:
            wanted = f"{path.stem}_{bare(key)}"
            while wanted in beside.values():
                wanted = f"{Path(wanted).stem}_{Path(wanted).suffix}"
            beside[key] = wanted
        files.update({beside[key]: content for key, content in textures.items()})
        mtl = MAP.sub(lambda m: f"{m[1]}{beside[m[2]]}" if m[2] in beside else "", mtl)
        files[f"{path.stem}.mtl"] = mtl.encode()

    # All vertices in order, unless colours have seams.
    index, table = carrier.rows, vertices
    moved = (vertices != mesh.vertices).any(axis=1)
    if carrier.shades is not None:
        first, index = _distinct(carrier.rows, np.nan_to_num(carrier.shades, nan=-1.0))
        moved = moved[carrier.rows[first]]
        table = np.column_stack([vertices[carrier.rows[first]], carrier.shades[first]])
    elif carrier.colors is not None:
        first, index = _distinct(carrier.rows, carrier.colors)
        colors = carrier.colors[first, :3] / 255.0
        moved = moved[carrier.rows[first]]
        table = np.column_stack([vertices[carrier.rows[first]], colors])
    out += [
        _line("v", row, 12 if new else 17) for row, new in zip(table.tolist(), moved, strict=True)
    ]
    words = [index + 1]
    if carrier.uv is not None:
        first, index = _distinct(carrier.uv)
        out += [_line("vt", row, 17) for row in carrier.uv[first].tolist()]
        words.append(index + 1)
    if "s" not in carrier.labels:
        normals, index = _normals(carrier, vertices)
        out += [_line("vn", row, 4) for row in (normals.round(4) + 0.0).tolist()]  # no -0
        words += [np.full(len(index), "")] if carrier.uv is None else []
        words.append(index + 1)
    corner = ["/".join(map(str, row)) for row in np.stack(words, axis=1).tolist()]

    # Only write what changes between faces.
    said: dict[str, int] = {}
    texts = {"o": carrier.parts, "usemtl": tuple(names)} | {
        word: label for word, (label, _) in carrier.labels.items()
    }
    if not carrier.objects:
        del texts["o"]
    for part, chosen, run in _runs(carrier, *(which for _, which in carrier.labels.values())):
        state = {"o": part} | {w: int(which[run[0]]) for w, (_, which) in carrier.labels.items()}
        for word, number in (state | {"usemtl": chosen}).items():
            if word in texts and number >= 0 and said.get(word) != number:
                out.append(f"{word} {texts[word][number]}".rstrip())
                said[word] = number
        for a, b, c in carrier.corners[run].tolist():
            out.append(f"f {corner[a]} {corner[b]} {corner[c]}")
    files[path.name] = ("\n".join(out) + "\n").encode()
    return files


def _line(word: str, numbers: list[float], digits: int) -> str:
    """Format a line of the numbers that aren't NaN with this many digits; with 17, shortest exact
    form."""
    known = [x for x in numbers if x == x]
    if digits >= 17:
        return " ".join([word, *map(repr, known)])
    return " ".join([word, *(f"{x:.{digits}g}" for x in known)])


def _mtl(carrier: Carrier, names: list[str]) -> tuple[str, dict[str, bytes]]:
    """Make a material library and the images it names."""
    texts, textures = [], {}
    for material, name in zip(carrier.materials, names, strict=True):
        simple = material.to_simple()
        if material.baseColorFactor is None:
            simple.diffuse = np.full(4, 255, dtype=np.uint8)
        files, _ = simple.to_obj(name)
        texts.append(files.pop(f"{name}.mtl").decode())
        textures.update(files)
    return "\n\n".join(texts) + "\n", textures
