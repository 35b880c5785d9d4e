"""Meshes to files: the moved vertices in the file's own rows, materials and nodes."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh

from styleexp import atomic
from styleexp.errors import UserError
from styleexp.meshes.gltf_writing import DISPLACEMENT, glb_of
from styleexp.meshes.mesh import Carrier, Mesh, vertex_normals
from styleexp.meshes.obj import MAP, surface
from styleexp.meshes.references import bare

if TYPE_CHECKING:
    from jaxtyping import Float


def save_mesh(
    mesh: Mesh,
    vertices: Float[np.ndarray, "vertices 3"],
    path: str | os.PathLike[str],
    displacement: Float[np.ndarray, " vertices"] | None = None,
) -> None:
    """Write a mesh with its vertices moved, as PLY (binary), OBJ or GLB by ``path``'s extension.

    ``vertices`` replace `Mesh.vertices`, in the same frame. The file's own rows come back: texture
    coordinates with their seams, materials and images, colours, part names, winding. A GLB gets
    normals, computed anew, with the hard edges of a glTF input.

    - PLY: one object without textures; ``displacement`` is its float vertex property.
    - OBJ: faces and materials in the file's order. Materials and images are written beside it,
      named after it: ``out.obj``, ``out.mtl``, ``out_wood.png``.
    - GLB: a glTF file's own document, with new positions, their normals (where it has some) and
      without their tangents; otherwise a node for each part. ``displacement``
      is the custom attribute ``_DISPLACEMENT``, in the mesh's own units whatever the nodes' scale.

    PLY and GLB hold single precision. Every file is replaced in one step, so an interrupted run
    leaves no half of one. Raises `UserError` if the place cannot be written, the extension is
    unknown or values are not finite.
    """
    path = Path(path)
    kind = path.suffix.lower()
    vertices = np.asarray(vertices, dtype=np.float64)
    if vertices.shape != mesh.vertices.shape:
        raise ValueError(f"expected vertices of shape {mesh.vertices.shape}, got {vertices.shape}")
    if displacement is not None and np.shape(displacement) != (len(vertices),):
        raise ValueError(f"expected {len(vertices)} displacements, not {np.shape(displacement)}")
    if not np.isfinite(vertices).all():
        raise UserError(
            f"'{path}' was not written, the result has NaN or infinite vertices: the run diverged, "
            "lower the learning rate."
        )
    if kind not in (".ply", ".obj", ".glb"):
        raise UserError(f"'{path}' cannot be written: supported are .ply, .obj, .glb.")
    if kind != ".obj" and np.abs(vertices).max() > np.finfo(np.float32).max:
        raise UserError(
            f"'{path}' cannot hold such large coordinates: save as OBJ or scale the mesh down."
        )
    carrier = mesh.carrier or Carrier(
        mesh.faces, np.arange(len(vertices)), np.zeros(len(mesh.faces), bool), parts=(mesh.name,)
    )
    if kind == ".ply":
        files = {path.name: _ply(carrier, vertices, displacement)}
    elif kind == ".obj":
        files = _obj(carrier, vertices, path)
    else:
        values = None if displacement is None else np.asarray(displacement, np.float32)
        normals = _row_normals(carrier, vertices)
        if carrier.document is not None:
            rows = carrier.rows
            moved = (vertices != mesh.vertices).any(axis=1)[rows]
            values = None if values is None else values[rows]
            content = glb_of(carrier, vertices[rows], moved, normals, values)
        else:
            scene = _new_scene(carrier, vertices, normals, values)
            content = scene.export(file_type="glb", include_normals=True)
        files = {path.name: content}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for name, content in files.items():  # the mesh comes last, when all it needs is there
            atomic.write(path.with_name(name), atomic.data(content))
    except OSError as error:
        raise UserError(f"'{path}' cannot be written ({error.strerror or error}).") from None


def _row_normals(carrier: Carrier, vertices: np.ndarray) -> np.ndarray:
    """Unit normals (rows, 3), smooth across the corners that the file's normals call smooth."""
    groups = carrier.rows
    if carrier.normals is not None:
        rounded = np.round(np.nan_to_num(carrier.normals) * 50)
        groups = _distinct(carrier.rows, rounded)[1]
    faces = carrier.rows[carrier.corners]
    return vertex_normals(vertices, faces, groups[carrier.corners])[groups]


def _distinct(*columns: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Distinct combinations of rows: the first row of each, and each row's combination."""
    table = np.column_stack([column for column in columns if column is not None])
    _, first, inverse = np.unique(table, axis=0, return_index=True, return_inverse=True)
    return first, inverse.ravel()


def ply_rows(carrier: Carrier) -> tuple[np.ndarray, np.ndarray]:
    """The rows that a PLY file gets, in its order, and which of them each row became."""
    return _distinct(carrier.rows, carrier.uv, carrier.colors)


def _runs(carrier: Carrier) -> Iterator[tuple[int, int, np.ndarray]]:
    """Part, material (-1 for none) and faces, wherever one of the two changes."""
    n = len(carrier.corners)
    part = np.zeros(n, dtype=np.int64) if carrier.face_part is None else carrier.face_part
    material = np.full(n, -1) if carrier.face_material is None else carrier.face_material
    turns = np.flatnonzero((np.diff(part) != 0) | (np.diff(material) != 0)) + 1
    for run in np.split(np.arange(n), turns):
        yield int(part[run[0]]), int(material[run[0]]), run


def _ply(carrier: Carrier, vertices: np.ndarray, displacement: np.ndarray | None) -> bytes:
    first, combined = ply_rows(carrier)
    rows = carrier.rows[first]
    colors = None if carrier.colors is None else carrier.colors[first]
    faces = combined[carrier.corners]
    mesh = trimesh.Trimesh(vertices[rows], faces, vertex_colors=colors, process=False)
    if carrier.uv is not None:
        for k, name in enumerate("st"):
            mesh.vertex_attributes[name] = carrier.uv[first, k].astype(np.float32)
    if displacement is not None:
        mesh.vertex_attributes["displacement"] = np.asarray(displacement, np.float32)[rows]
    return mesh.export(file_type="ply", vertex_normal=False)


# --------------------------------------------------------------------------------------------- GLB


def _attach(shape: trimesh.Trimesh, displacement: np.ndarray | None, rows: np.ndarray) -> None:
    shape.vertex_attributes.pop(DISPLACEMENT, None)  # of an input that is itself a result
    if displacement is not None:
        shape.vertex_attributes[DISPLACEMENT] = displacement[rows]


def _new_scene(
    carrier: Carrier, vertices: np.ndarray, normals: np.ndarray, displacement: np.ndarray | None
) -> trimesh.Scene:
    """A node for each part; if it has several materials, with a child for each."""
    pieces: dict[int, dict[int, list[np.ndarray]]] = {}
    for part, material, run in _runs(carrier):
        pieces.setdefault(part, {}).setdefault(material, []).append(run)
    scene = trimesh.Scene()
    names = {scene.graph.base_frame}
    for part, by_material in pieces.items():
        label = trimesh.util.unique_name(carrier.parts[part], names)
        names.add(label)
        if len(by_material) > 1:
            scene.graph.update(label)
        for material, runs in by_material.items():
            rows, faces = np.unique(carrier.corners[np.concatenate(runs)], return_inverse=True)
            shape = trimesh.Trimesh(
                vertices[carrier.rows[rows]],
                faces.reshape(-1, 3),
                vertex_normals=normals[rows],
                visual=_visual(carrier, material, rows),
                process=False,
            )
            _attach(shape, displacement, carrier.rows[rows])
            node, parent = label, None
            if len(by_material) > 1:
                # trimesh's own mark of such a child; `load_mesh` calls it by its parent's name.
                shape.metadata["from_gltf_primitive"] = True
                surface_name = carrier.materials[material].name if material >= 0 else "plain"
                node, parent = trimesh.util.unique_name(f"{label} {surface_name}", names), label
                names.add(node)
            scene.add_geometry(shape, node_name=node, geom_name=node, parent_node_name=parent)
    return scene


def _visual(carrier: Carrier, material: int, rows: np.ndarray) -> Any:
    uv = None if carrier.uv is None else carrier.uv[rows]
    colors = None if carrier.colors is None else carrier.colors[rows]
    if material < 0 and uv is None:
        return trimesh.visual.ColorVisuals(vertex_colors=colors)
    chosen = carrier.materials[material] if material >= 0 else surface("plain")
    visual = trimesh.visual.TextureVisuals(uv=uv, material=chosen)
    if colors is not None:
        visual.vertex_attributes["color"] = colors
    return visual


# --------------------------------------------------------------------------------------------- OBJ


def _obj(carrier: Carrier, vertices: np.ndarray, path: Path) -> dict[str, bytes]:
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

    # The whole mesh's vertices in their order, unless colours have seams.
    index, table = carrier.rows, vertices
    if carrier.colors is not None:
        first, index = _distinct(carrier.rows, carrier.colors)
        colors = carrier.colors[first, :3] / 255.0
        table = np.column_stack([vertices[carrier.rows[first]], colors])
    out += _lines("v", table, 12)
    words = [index + 1]
    if carrier.uv is not None:
        first, index = _distinct(carrier.uv)
        out += _lines("vt", carrier.uv[first], 9)
        words.append(index + 1)
    corner = ["/".join(map(str, row)) for row in np.stack(words, axis=1).tolist()]

    last_part = last_material = -1
    for part, chosen, run in _runs(carrier):
        if part != last_part:
            out.append(f"o {carrier.parts[part]}")
        if chosen != last_material and chosen >= 0:
            out.append(f"usemtl {names[chosen]}")
        last_part, last_material = part, chosen
        for a, b, c in carrier.corners[run].tolist():
            out.append(f"f {corner[a]} {corner[b]} {corner[c]}")
    files[path.name] = ("\n".join(out) + "\n").encode()
    return files


def _lines(word: str, table: np.ndarray, digits: int) -> list[str]:
    pattern = " ".join([word, *[f"%.{digits}g"] * table.shape[1]])
    return [pattern % tuple(row) for row in table.tolist()]


def _mtl(carrier: Carrier, names: list[str]) -> tuple[str, dict[str, bytes]]:
    """A material library and the images it names."""
    texts, textures = [], {}
    for material, name in zip(carrier.materials, names, strict=True):
        simple = material.to_simple()
        if material.baseColorFactor is None:
            simple.diffuse = np.full(4, 255, dtype=np.uint8)
        files, _ = simple.to_obj(name)
        texts.append(files.pop(f"{name}.mtl").decode())
        textures.update(files)
    return "\n\n".join(texts) + "\n", textures
