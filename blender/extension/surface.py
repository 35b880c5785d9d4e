"""What goes to the command and what comes back, as arrays. Needs no Blender.

Each corner of each triangle is a row of its own in the PLY file, with the triangle's number and
the corner's barycentric coordinates as properties. The command interpolates properties when it
refines, so every row of its result tells where on the original surface it is. Whatever the
original has there (UV maps, vertex groups, shape keys, materials, colours) is then looked up, and
need not fit into a file.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .errors import ExtensionError

PLACE = ("triangle", "corner_u", "corner_v")
"""Vertex properties: the triangle, and the barycentric coordinates of its first two corners."""
MASK, DISPLACEMENT = "mask", "displacement"
TYPES = {
    "char": "i1", "uchar": "u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4",
    "float": "<f4", "double": "<f8",
}  # fmt: skip
MOST_TRIANGLES = 1 << 24
"""The result has single precision, in which larger numbers of triangles aren't whole."""


@dataclass(frozen=True)
class Source:
    """An object's mesh as it is given to the command."""

    points: np.ndarray
    """(vertices, 3) float32, in the object's own frame."""
    triangles: np.ndarray
    """(triangles, 3) vertices."""
    loops: np.ndarray
    """(triangles, 3) corners of polygons."""
    polygons: np.ndarray
    """(triangles,)"""
    uv: np.ndarray | None = None
    """(corners, 2)"""
    mask: np.ndarray | None = None
    """(vertices,) from 0 to 1."""
    proportions: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """The object's scale relative to its mean: the relief is as large on stretched objects."""

    def same(self, other: Source) -> bool:
        """Whether the other has the same surface."""
        return np.array_equal(self.points, other.points) and np.array_equal(self.loops, other.loops)


def proportions(scale: tuple[float, float, float]) -> tuple[float, float, float]:
    """An object's scale divided by its geometric mean, without signs; 1 for a uniform one, so that
    rounding in the scale doesn't change the relief."""
    sizes = np.abs(np.asarray(scale, dtype=np.float64))
    if sizes.min() < 1e-9 or np.ptp(sizes) < 1e-4 * sizes.max():
        return (1.0, 1.0, 1.0)
    x, y, z = (sizes / np.cbrt(sizes.prod())).tolist()
    return (x, y, z)


def to_command(points: np.ndarray, scale: tuple[float, float, float]) -> np.ndarray:
    """From an object's frame, Z up, to the command's, Y up and with ``scale``, in doubles."""
    x, y, z = (points.astype(np.float64) * scale).T
    return np.stack([x, z, -y], axis=1)


def from_command(points: np.ndarray, scale: tuple[float, float, float]) -> np.ndarray:
    """The inverse of `to_command`."""
    x, y, z = points.astype(np.float64).T
    return np.stack([x, -z, y], axis=1) / scale


def write_source(path: Path, source: Source) -> None:
    """Write the triangles' corners as rows of a PLY file.

    Raises `ExtensionError` for a mesh without faces or with too many.
    """
    count = len(source.triangles)
    if not count:
        raise ExtensionError("the object has no faces: there is no surface to put a relief on.")
    if count >= MOST_TRIANGLES:
        raise ExtensionError(f"the object has {count:,} triangles: reduce them below 16 million.")
    corner = source.triangles.ravel()
    x, y, z = to_command(source.points, source.proportions)[corner].T
    columns = {"x": x, "y": y, "z": z}
    if source.uv is not None:
        columns["s"], columns["t"] = source.uv[source.loops.ravel()].T.astype(np.float32)
    if source.mask is not None:
        columns[MASK] = source.mask[corner].astype(np.float32)
    columns[PLACE[0]] = np.repeat(np.arange(count, dtype=np.float32), 3)
    columns[PLACE[1]] = np.tile(np.array([1, 0, 0], np.float32), count)
    columns[PLACE[2]] = np.tile(np.array([0, 1, 0], np.float32), count)
    write_ply(path, columns, np.arange(3 * count, dtype=np.int32).reshape(-1, 3))


def write_ply(path: Path, columns: dict[str, np.ndarray], triangles: np.ndarray) -> None:
    """Write a binary PLY file of float and double vertex properties, and triangles."""
    names = {"f4": "float", "f8": "double"}
    kind = np.dtype([(name, f"<{column.dtype.str[1:]}") for name, column in columns.items()])
    vertex = np.empty(len(next(iter(columns.values()))), kind)
    for name, column in columns.items():
        vertex[name] = column
    face = np.empty(len(triangles), np.dtype([("count", "u1"), ("corners", "<i4", 3)]))
    face["count"], face["corners"] = 3, triangles
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertex)}"]
    head += [f"property {names[column.dtype.str[1:]]} {name}" for name, column in columns.items()]
    head += [f"element face {len(face)}", "property list uchar int vertex_indices", "end_header\n"]
    path.write_bytes("\n".join(head).encode() + vertex.tobytes() + face.tobytes())


# ------------------------------------------------------------------------------------- the result


@dataclass(frozen=True)
class Table:
    """A PLY file of triangles."""

    vertex: np.ndarray
    """(rows,) with a field for each property."""
    faces: np.ndarray
    """(faces, 3) rows"""


def read_ply(path: Path) -> Table:
    """Read a result: binary, little-endian, of triangles. Raises `ExtensionError` for others."""
    try:
        head, end, body = path.read_bytes().partition(b"end_header\n")
        lines = head.decode().splitlines()
        if not end or lines[1:2] != ["format binary_little_endian 1.0"]:
            raise ValueError
        kinds: dict[str, list[tuple]] = {}
        counts: dict[str, int] = {}
        for line in lines:
            if match := re.fullmatch(r"element (\w+) (\d+)", line):
                counts[match[1]], kinds[match[1]] = int(match[2]), []
            elif match := re.fullmatch(r"property list uchar (u?int) vertex_indices", line):
                kinds["face"] += [("count", "u1"), ("corners", TYPES[match[1]], 3)]
            elif match := re.fullmatch(r"property (\w+) (\S+)", line):
                kinds[list(counts)[-1]].append((match[2], TYPES[match[1]]))
        vertex_kind, face_kind = np.dtype(kinds["vertex"]), np.dtype(kinds["face"])
        size = counts["vertex"] * vertex_kind.itemsize
        vertex = np.frombuffer(body[:size], vertex_kind, counts["vertex"])
        face = np.frombuffer(body[size:], face_kind, counts["face"])
        corners = face["corners"].astype(np.int64)
        if (face["count"] != 3).any() or corners.min() < 0 or corners.max() >= len(vertex):
            raise ValueError
        for axis in "xyz":
            if not np.isfinite(vertex[axis]).all():
                raise ValueError
    except (OSError, ValueError, KeyError, IndexError, UnicodeDecodeError):
        raise ExtensionError(f"'{path}' is missing or damaged: run again.") from None
    return Table(vertex, corners)


@dataclass(frozen=True)
class Moved:
    """The original vertices at new places: the mesh itself can stay."""

    points: np.ndarray
    """(vertices, 3) in the object's own frame."""
    displacement: np.ndarray
    """(vertices,) in units of the object's frame; 0 for vertices without faces."""


@dataclass(frozen=True)
class Refined:
    """A new surface, with its place on the original one; with ``triangle`` None, it is unknown."""

    points: np.ndarray
    """(vertices, 3) in the object's own frame."""
    faces: np.ndarray
    """(faces, 3) vertices"""
    displacement: np.ndarray
    """(vertices,)"""
    first: np.ndarray
    """(vertices,) a row of each."""
    rows: np.ndarray
    """(faces, 3) rows of the corners."""
    triangle: np.ndarray | None = None
    """(rows,)"""
    weights: np.ndarray | None = None
    """(rows, 3) barycentric coordinates"""

    def of_vertices(self, source: Source, values: np.ndarray) -> np.ndarray:
        """Values of the original vertices, at the new ones."""
        return self._at(self.first, source.triangles, values)

    def of_corners(self, source: Source, values: np.ndarray) -> np.ndarray:
        """Values of the original corners, at the new ones."""
        return self._at(self.rows.ravel(), source.loops, values)

    def of_faces(self, source: Source, values: np.ndarray) -> np.ndarray:
        """Values of the original polygons, for each new face."""
        assert self.triangle is not None
        return values[source.polygons[self.triangle[self.rows[:, 0]]]]

    def of_edges(self, source: Source, old: np.ndarray, new: np.ndarray) -> np.ndarray:
        """The original edge (of ``old``, (edges, 2) vertices) that each new one (of ``new``) is a
        piece of; -1 for those inside of polygons."""
        assert self.triangle is not None
        assert self.weights is not None
        result = np.full(len(new), -1)
        base = max(len(source.points), len(self.points))
        for a, b in ((0, 1), (1, 2), (2, 0)):
            first, second = self.rows[:, a], self.rows[:, b]
            on = (self.weights[first] == 0) & (self.weights[second] == 0)  # a side of the triangle
            k, side = on.argmax(1), on.any(1)
            own = source.triangles[self.triangle[first]]
            ends = np.take_along_axis(own, np.stack([k + 1, k + 2], 1) % 3, axis=1)[side]
            of = _found(ends, old, base)
            at = _found(self.faces[side][:, [a, b]], new, base)
            known = (of >= 0) & (at >= 0)
            result[at[known]] = of[known]
        return result

    def _at(self, rows: np.ndarray, corners: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Interpolate floats; whatever else has no values between gets the nearest corner's."""
        assert self.triangle is not None
        assert self.weights is not None
        own, weights = corners[self.triangle[rows]], self.weights[rows]
        if values.dtype.kind != "f":
            return values[np.take_along_axis(own, weights.argmax(1)[:, None], axis=1)[:, 0]]
        result = np.zeros((len(rows), *values.shape[1:]))
        for k in range(3):
            shape = (-1, *[1] * (values.ndim - 1))
            result += weights[:, k].reshape(shape) * values[own[:, k]]
        return result.astype(values.dtype)


def _found(pairs: np.ndarray, edges: np.ndarray, base: int) -> np.ndarray:
    """The index among edges (n, 2) of each pair of vertices below ``base``; -1 for none."""
    keys, wanted = (np.sort(each.astype(np.int64), 1) @ [base, 1] for each in (edges, pairs))
    order = np.argsort(keys)
    place = np.searchsorted(keys[order], wanted).clip(max=len(keys) - 1)
    return np.where(keys[order][place] == wanted, order[place], -1)


def result(path: Path, source: Source) -> Moved | Refined:
    """The command's result for this source.

    Unmoved vertices keep their exact coordinates. Raises `ExtensionError` for a damaged file.
    """
    table = read_ply(path)
    rows = np.stack([table.vertex[axis] for axis in "xyz"], axis=1)
    points = from_command(rows, source.proportions)
    names = table.vertex.dtype.names or ()
    height = np.zeros(len(rows), np.float32)
    if DISPLACEMENT in names:
        height = table.vertex[DISPLACEMENT]
    if not set(PLACE) <= set(names):
        return _joined(rows, points, height, table.faces)
    count = len(source.triangles)
    triangle = np.rint(table.vertex[PLACE[0]]).astype(np.int64)
    u, v = (table.vertex[name].astype(np.float64) for name in PLACE[1:])
    weights = np.stack([u, v, 1 - u - v], axis=1).clip(0, 1)
    if triangle.min() < 0 or triangle.max() >= count:
        raise ExtensionError(f"'{path}' is not the result of this object: run again.")

    corner = weights.argmax(1)
    vertex = source.triangles[triangle, corner]
    sent = to_command(source.points, source.proportions).astype(rows.dtype)[vertex]
    still = (weights.max(1) == 1) & (rows == sent).all(1)
    points[still] = source.points[vertex[still]]
    if len(table.faces) == count and len(rows) == 3 * count and (weights.max(1) == 1).all():
        moved = source.points.astype(np.float64)
        displacement = np.zeros(len(moved), np.float32)
        moved[vertex], displacement[vertex] = points, height
        return Moved(moved.astype(np.float32), displacement)
    return _joined(rows, points, height, table.faces, triangle, weights)


def _joined(
    rows: np.ndarray,
    points: np.ndarray,
    height: np.ndarray,
    faces: np.ndarray,
    triangle: np.ndarray | None = None,
    weights: np.ndarray | None = None,
) -> Refined:
    """One vertex for all rows at a position."""
    rows = np.ascontiguousarray(rows) + 0.0  # -0 is 0
    whole = rows.view(np.dtype((np.void, rows.dtype.itemsize * 3))).ravel()
    _, first, joined = np.unique(whole, return_index=True, return_inverse=True)
    # In the order of the file, whose neighbours are near.
    order = np.argsort(first)
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    first, joined = first[order], place[joined]
    return Refined(
        points[first].astype(np.float32), joined[faces], height[first], first, faces,
        triangle, weights,
    )  # fmt: skip
