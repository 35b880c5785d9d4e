"""PLY files as meshes: interprets known properties and preserves the rest."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from styleexp.inputs import images
from styleexp.inputs.meshes import precision, references
from styleexp.inputs.meshes.mesh import Carrier
from styleexp.inputs.meshes.obj import surface, triangulate
from styleexp.inputs.meshes.ply import Column, Lists, Ply, numbers, parse, take, written
from styleexp.inputs.meshes.welding import check_indices, plural
from styleexp.system.errors import UserError

POSITION, NORMAL, COLOR = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")
UVS = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("texture_s", "texture_t"))
CORNERS = ("vertex_indices", "vertex_index")
DISPLACEMENT = "displacement"
VECTOR = {2: ("_x", "_y"), 3: ("_x", "_y", "_z"), 4: ("_x", "_y", "_z", "_w")}
"""Name suffixes of a vector's components, as in Blender."""


@dataclass(frozen=True)
class Table:
    """A PLY file's data per row and face, in its own types and order."""

    vertex: dict[str, Column]
    """Properties of the rows; positions, normals and texture coordinates as originally read."""
    face: dict[str, Column]
    """Properties of the triangles, without the corners. All triangles of a polygon share its
    values."""
    comments: tuple[str, ...] = ()

    @property
    def own(self) -> tuple[str, ...]:
        """Names of custom vertex properties."""
        known = {*POSITION, *NORMAL, *COLOR, "alpha", DISPLACEMENT, *sum(UVS, ())}
        return tuple(name for name in self.vertex if name not in known)

    @property
    def own_faces(self) -> tuple[str, ...]:
        """Names of custom face properties."""
        return tuple(name for name in self.face if name not in (*COLOR, "alpha"))

    @property
    def rows(self) -> bool:
        """Whether vertices at the same position may differ in more than colours and texture
        coordinates."""
        return bool(self.own) or NORMAL[0] in self.vertex


def attributes_of(vertex: dict[str, Column], names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """The named properties as float64 (rows, width). Lists of equal length are vectors, and so are
    ``NAME_x``, ``NAME_y`` and ``NAME_z`` (with or without the ``_``)."""
    found = {}
    for name in names:
        column = vertex[name]
        if isinstance(column, np.ndarray):
            found[name] = column.astype(np.float64)[:, None]
        elif len(column.lengths) and column.lengths[0] > 0 and not np.ptp(column.lengths):
            found[name] = column.values.astype(np.float64).reshape(len(column.lengths), -1)
    for name in names:
        stem = name[:-1].removesuffix("_")
        three = [name[:-1] + axis for axis in "xyz"]
        numbers_ = [found[each] for each in three if each in found and found[each].shape[1] == 1]
        if name[-1] == "x" and stem and stem not in found and len(numbers_) == 3:
            found[stem] = np.concatenate(numbers_, axis=1)
            for each in three:
                del found[each]
    return found


def read_ply(data: bytes, path: Path) -> tuple[np.ndarray, Carrier, list[str]]:
    """Read the rows' positions (rows, 3), the carrier, and notes."""
    ply = parse(data)
    vertex, face = ply.elements.get("vertex", {}), dict(ply.elements.get("face", {}))
    if not all(isinstance(vertex.get(name), np.ndarray) for name in POSITION):
        raise UserError("has no vertices with x, y and z: export the mesh again.")
    positions = numbers(vertex, *POSITION)
    corners = next((face.pop(name) for name in CORNERS if name in face), None)
    if corners is None or not len(corners.lengths if isinstance(corners, Lists) else ()):
        if "tristrips" in ply.elements:
            raise UserError(
                "stores its surface as triangle strips, which are not supported: export it again, "
                "with faces."
            )
        nothing = np.zeros((0, 3), dtype=np.int64)
        return positions, Carrier(nothing, nothing, nothing), []
    assert isinstance(corners, Lists)
    notes: list[str] = []
    counts, index = corners.lengths.astype(np.int64), corners.values.astype(np.int64)
    check_indices(index, len(positions))
    corner, owner = triangulate(counts, positions[index], notes)
    if not len(corner):
        raise UserError("has no face with three corners: export the mesh again.")
    # The second half of a quad starts at its third corner.
    second = (counts[owner] == 4) & (np.diff(owner, prepend=-1) == 0)
    corner[second] = np.roll(corner[second], -1, axis=1)

    uv = next((numbers(vertex, *names) for names in UVS if set(names) <= vertex.keys()), None)
    wedges = _wedges(face, counts)
    if wedges is None:
        chosen, inverse = np.unique(index[corner.ravel()], return_inverse=True)
        uv = None if uv is None else uv[chosen]
    else:  # a row is a combination of vertex and texture coordinates
        del face["texcoord"]
        table = np.column_stack([index, wedges])[corner.ravel()]
        table, inverse = np.unique(table, axis=0, return_inverse=True)
        chosen, uv = table[:, 0].astype(np.int64), table[:, 1:]
    if unused := len(positions) - len(np.unique(chosen)):
        notes.append(f"left out {plural(unused, 'vertex', 'vertices')} that no face uses")
    if ply.left:
        notes.append("has data after its last element: if it is damaged, faces are missing")
    others = [f"'{name}'" for name in ply.elements if name not in ("vertex", "face")]
    if others:
        word = "element" if len(others) == 1 else "elements"
        notes.append(f"left out the {word} {', '.join(others)} of the PLY file")
    colors = _colors(vertex)
    kept = Table(
        {name: take(column, chosen) for name, column in vertex.items()},
        {name: take(column, owner) for name, column in face.items()},
        tuple(c for c in ply.comments if not c.lower().startswith("comment texturefile")),
    )
    notes += _only_in_ply(kept)
    materials, face_material = _textures(ply, path, face, owner, notes)
    carrier = Carrier(
        inverse.reshape(-1, 3),
        np.zeros(len(chosen), dtype=np.int64),
        np.zeros(len(owner), dtype=bool),
        precision=_precision(data, positions, vertex),
        uv=uv,
        normals=numbers(vertex, *NORMAL)[chosen] if set(NORMAL) <= vertex.keys() else None,
        colors=None if colors is None else colors[chosen],
        face_colors=_colors(kept.face),
        parts=(path.stem,),
        face_part=np.zeros(len(owner), dtype=np.int64),
        materials=materials,
        face_material=face_material,
        attributes=attributes_of(kept.vertex, kept.own),
        ply=kept,
    )
    return positions[chosen], carrier, notes


def _precision(data: bytes, positions: np.ndarray, vertex: dict[str, Column]) -> float:
    head, _, body = data[: 1 << 22].partition(b"end_header")
    if b"format ascii" in head:
        words = [row for line in body.splitlines()[1:] for row in line.split()[:3]]
        return precision.of_text(words[: 3 * len(positions)], positions)
    single = all(_float(vertex[name]) == np.float32 for name in POSITION)
    return precision.of_floats(positions) if single else 0.0


def ply_of(
    carrier: Carrier,
    first: np.ndarray,
    faces: np.ndarray,
    points: np.ndarray,
    normals: np.ndarray | None,
    displacement: np.ndarray | None,
) -> bytes:
    """Make a PLY file of the rows ``first``, moved to ``points`` (rows, 3), and ``faces`` into
    them.

    Everything else from the source PLY is preserved, in its types. Without a source PLY, positions
    are floats. ``normals`` (rows, 3) and ``displacement`` (rows,) are written as float properties.
    """
    vertex: dict[str, Column] = {name: np.zeros(0, np.float32) for name in POSITION}
    face: dict[str, Column] = {}
    comments: list[str] = []
    if carrier.ply is not None:
        vertex = {name: take(column, first) for name, column in carrier.ply.vertex.items()}
        vertex.pop(DISPLACEMENT, None)  # if the input is itself a result
        face, comments = dict(carrier.ply.face), list(carrier.ply.comments)
    for k, name in enumerate(POSITION):
        vertex[name] = points[:, k].astype(_float(vertex[name]))
    if normals is not None:
        for k, name in enumerate(NORMAL):
            kind = _float(vertex.get(name, np.zeros(0, np.float32)))
            vertex[name] = normals[:, k].astype(kind)
    if carrier.colors is not None and not set(COLOR) <= vertex.keys():
        for k, name in enumerate((*COLOR, "alpha")):
            vertex[name] = carrier.colors[first, k]
    if carrier.face_colors is not None and not set(COLOR) <= face.keys():
        for k, name in enumerate((*COLOR, "alpha")):
            face[name] = carrier.face_colors[:, k]
    if carrier.uv is not None and not any(set(names) <= vertex.keys() for names in UVS):
        for k, name in enumerate("st"):
            vertex[name] = carrier.uv[first, k].astype(np.float32)
    if carrier.ply is None:
        for name, values in carrier.attributes.items():
            ends = [""] if values.shape[1] == 1 else VECTOR.get(values.shape[1], ())
            for k, end in enumerate(ends):
                vertex.setdefault(name + end, values[first, k].astype(np.float32))
    if displacement is not None:
        vertex[DISPLACEMENT] = displacement.astype(np.float32)
    corners = Lists(np.full(len(faces), 3, np.uint8), faces.ravel().astype(np.int32))
    return written(
        Ply({"vertex": vertex, "face": {CORNERS[0]: corners, **face}}, comments),
    )


def _float(column: Column) -> np.dtype:
    """The column's own dtype if floating-point, else float32."""
    kind = column.dtype if isinstance(column, np.ndarray) else np.dtype(np.float32)
    return kind if kind.kind == "f" else np.dtype(np.float32)


def _colors(table: dict[str, Column]) -> np.ndarray | None:
    """8-bit colours (rows, 4), from integers of any size or floats in [0, 1]."""
    if not set(COLOR) <= table.keys():
        return None
    names = (*COLOR, "alpha") if "alpha" in table else COLOR
    values = numbers(table, *names)
    top = [
        1.0 if column.dtype.kind == "f" else float(np.iinfo(column.dtype).max)
        for column in (table[name] for name in names)
        if isinstance(column, np.ndarray)
    ]
    bytes_ = np.clip(np.nan_to_num(values / top) * 255, 0, 255).round().astype(np.uint8)
    return bytes_ if len(names) == 4 else np.insert(bytes_, 3, 255, axis=1)


def _wedges(face: dict[str, Column], counts: np.ndarray) -> np.ndarray | None:
    """Texture coordinates per polygon corner, (corners, 2), as written by MeshLab."""
    given = face.get("texcoord")
    if not isinstance(given, Lists) or (given.lengths.astype(np.int64) != 2 * counts).any():
        return None
    return given.values.reshape(-1, 2).astype(np.float64)


def _textures(
    ply: Ply, path: Path, face: dict[str, Column], owner: np.ndarray, notes: list[str]
) -> tuple[tuple[Any, ...], np.ndarray | None]:
    """Materials for the images named in comments, and each triangle's material."""
    from PIL import Image

    names = [c.split(None, 2)[2] for c in ply.comments if c.lower().startswith("comment texturef")
             and len(c.split(None, 2)) == 3]  # fmt: skip
    materials: list[Any] = []
    place = np.full(len(names) + 1, -1)
    for k, name in enumerate(names):
        found, reason = references.find(name, path.parent, path.parent)
        content = b"" if found is None else found.read_bytes()
        reason = reason or images.fault(content)
        if reason:
            notes.append(f"saved without the texture '{name}': it {reason}")
            continue
        place[k] = len(materials)
        materials.append(surface(Path(name).stem, Image.open(io.BytesIO(content))))
    if not materials:
        return (), None
    number = face.get("texnumber")
    if not isinstance(number, np.ndarray):
        return tuple(materials), np.full(len(owner), place[0])
    number = np.where((number >= 0) & (number < len(names)), number, len(names)).astype(np.int64)
    return tuple(materials), place[number[owner]]


def _only_in_ply(table: Table) -> list[str]:
    """A note on data that only PLY can store among the result formats."""
    vertex, face = ", ".join(table.own), ", ".join(table.own_faces)
    colors = "face colours" if COLOR[0] in table.face else ""
    no_obj = [colors, f"vertex properties ({vertex})" if vertex else "",
              f"face properties ({face})" if face else ""]  # fmt: skip
    parts = [f"OBJ can't store {', '.join(filter(None, no_obj))}"] if any(no_obj) else []
    if face:
        parts.append(f"GLB can't store face properties ({face})")
    return ["only the PLY is complete: " + "; ".join(parts)] if parts else []
