"""Meshes: load, check, repair, normalise, remesh, and save in the input's own frame.

A file and an optimiser want different things of a mesh. The optimiser wants one vertex per point of
the surface, so that a displacement cannot tear it open; a file keeps several wherever a texture,
an edge or a colour has a seam. `load_mesh` welds by position and remembers the file's own rows,
materials and nodes in a `Carrier`; `save_mesh` puts moved vertices back into them::

    file rows (position, uv, normal, colour)  ── weld ──►  Mesh.vertices  ── optimise ──┐
              ▲                                                                         │
              └─────────────────────────── un-weld (Carrier.rows) ◄─────────────────────┘

The readers of OBJ, PLY, OFF and glTF are our own. trimesh groups OBJ faces by material and polygons
by their number of corners, reads a binary PLY with mixed polygons as junk, and drops a glTF file's
skins, animations and extensions; here the faces must stay in the file's order. It reads STL.

Coordinates are float64 in the file's frame and scale, a glTF scene's in its world frame. Faces wind
counter-clockwise seen from outside.
"""

from __future__ import annotations

import base64
import contextlib
import copy
import io
import json
import os
import re
import struct
import urllib.parse
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from styleexp.errors import UserError

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

READABLE = (".obj", ".ply", ".stl", ".off", ".glb", ".gltf")
WRITABLE = (".ply", ".obj", ".glb")

# Beyond this squares of coordinates overflow a double.
_LARGEST = 1e100
_SMALLEST = 1e-100
# Points nearer to each other than this share of the extent are one vertex. It forgives the rounding
# of a node's transform (1e-16), and is far below what float32 files can tell apart (6e-8).
_WELD = 1e-9


@dataclass(frozen=True)
class Material:
    """What a surface looks like, as far as OBJ and glTF can both say it."""

    name: str
    color: tuple[float, float, float, float] = (0.8, 0.8, 0.8, 1.0)
    """Red, green, blue, alpha in [0, 1], as the file gives them (no colour-space conversion)."""
    texture: str | None = None
    """Key into `Carrier.textures`: the base colour image."""
    mtl: tuple[str, ...] = ()
    """The material's own lines of an MTL file, so that saving as OBJ loses none of them."""


@dataclass(frozen=True)
class GltfSource:
    """A glTF file kept whole, so that saving as GLB changes positions and normals only."""

    document: dict[str, Any]
    buffers: tuple[bytes, ...]
    instances: tuple[GltfInstance, ...]
    row_of: Int[np.ndarray, " file_rows"]
    """`Carrier` row of each row of all instances' POSITION accessors, -1 where no face uses it."""


@dataclass(frozen=True)
class GltfInstance:
    """One primitive of one node: the rows ``start .. start + count`` of the scene."""

    node: int
    mesh: int
    primitive: int
    start: int
    count: int
    matrix: Float[np.ndarray, "4 4"]
    """Local to world."""


@dataclass(frozen=True)
class Carrier:
    """What a file knows about its mesh beyond positions, in the file's own rows.

    A row is one combination of position, uv, normal and colour; rows on a seam share a vertex.
    """

    corners: Int[np.ndarray, "faces 3"]
    """Rows of each face, in the file's own winding."""
    rows: Int[np.ndarray, " rows"]
    """Welded vertex of each row."""
    flipped: Bool[np.ndarray, " faces"]
    """Faces that `Mesh.faces` winds the other way round."""
    uv: Float[np.ndarray, "rows 2"] | None = None
    """v points up, as in OBJ and PLY; glTF's points down."""
    normals: Float[np.ndarray, "rows 3"] | None = None
    """The file's normals: they say which corners are smooth together, not where they point now."""
    colors: Float[np.ndarray, "rows 4"] | None = None
    parts: tuple[str, ...] = ("mesh",)
    face_part: Int[np.ndarray, " faces"] | None = None
    materials: tuple[Material, ...] = ()
    face_material: Int[np.ndarray, " faces"] | None = None
    """-1 where a face has none."""
    textures: dict[str, bytes] = field(default_factory=dict)
    """Image files by the name that materials and `mtl` lines use."""
    gltf: GltfSource | None = None


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh for the optimiser, with what is needed to save it as it came."""

    name: str
    vertices: Float[np.ndarray, "vertices 3"]
    """float64, one per position, in the input's own frame and scale."""
    faces: Int[np.ndarray, "faces 3"]
    """int64, in the file's order, counter-clockwise seen from outside."""
    repairs: tuple[str, ...] = ()
    """One readable sentence for each thing that was repaired or left out."""
    carrier: Carrier | None = None


@dataclass(frozen=True)
class Normalisation:
    """The similarity into the unit sphere: ``apply(v) = (v - center) / scale`` (Sec. 4.1)."""

    center: Float[np.ndarray, " 3"]
    scale: float
    """Largest distance of a vertex from the centre, in the input's units."""

    def apply(self, vertices: Float[np.ndarray, "vertices 3"]) -> Float[np.ndarray, "vertices 3"]:
        """From the input's frame into the unit sphere."""
        return (vertices - self.center) / self.scale

    def invert(self, vertices: Float[np.ndarray, "vertices 3"]) -> Float[np.ndarray, "vertices 3"]:
        """From the unit sphere back into the input's frame."""
        return vertices * self.scale + self.center


def normalisation(vertices: Float[np.ndarray, "vertices 3"]) -> Normalisation:
    """Centre at the vertex mean, scale so that the farthest vertex has distance 1 (Sec. 4.1)."""
    vertices = np.asarray(vertices, dtype=np.float64)
    center = vertices.mean(axis=0)
    scale = float(np.linalg.norm(vertices - center, axis=1).max())
    if not np.isfinite(scale) or scale <= 0.0:
        raise UserError("the mesh has no extent or non-finite vertices: it cannot be normalised.")
    return Normalisation(center, scale)


def face_areas(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Float[np.ndarray, " faces"]:
    """Area of each face, in squared units of the vertices."""
    return 0.5 * np.linalg.norm(_face_crosses(vertices, faces), axis=1)


def vertex_normals(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Float[np.ndarray, "vertices 3"]:
    """Unit vertex normals, the faces' weighted by area.

    Faces without area add nothing. A vertex whose normal cancels out or that no face uses gets the
    direction from the vertices' mean to it, so that every normal is finite and of length 1.
    """
    vertices = np.asarray(vertices, dtype=np.float64)
    return _grouped_normals(vertices, faces, faces, vertices)


def mean_edge_length(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> float:
    """Mean length of the edges, each counted once."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges = np.unique(edges[:, 0] * len(vertices) + edges[:, 1])
    ends = vertices[np.stack([edges // len(vertices), edges % len(vertices)], axis=1)]
    return float(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).mean())


def _face_crosses(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def _grouped_normals(
    vertices: np.ndarray, faces: np.ndarray, groups: np.ndarray, group_points: np.ndarray
) -> np.ndarray:
    """Unit normals of groups of corners: ``groups`` (faces, 3) numbers the rows of the result."""
    extent = float(np.ptp(vertices, axis=0).max()) if len(vertices) else 1.0
    # Unit extent, so that squares of tiny or huge coordinates neither vanish nor overflow.
    crosses = _face_crosses(vertices / (extent or 1.0), faces)
    normals = np.stack(
        [
            np.bincount(groups.ravel(), np.repeat(crosses[:, k], 3), minlength=len(group_points))
            for k in range(3)
        ],
        axis=1,
    )
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    lost = length[:, 0] < 1e-18
    if lost.any():
        outward = group_points[lost] - vertices.mean(axis=0)
        reach = np.linalg.norm(outward, axis=1, keepdims=True)
        up = np.array([0.0, 1.0, 0.0])
        normals[lost] = np.where(reach > 1e-12 * extent, outward / np.maximum(reach, 1e-300), up)
        length[lost] = 1.0
    return normals / length


# ---------------------------------------------------------------------------------------- loading


@dataclass
class _Soup:
    """What a reader found: polygons as runs of corners, before welding."""

    positions: np.ndarray  # (n, 3)
    counts: np.ndarray  # (polygons,) corners of each
    corners: np.ndarray  # (sum of counts,) into positions
    uv: np.ndarray | None = None
    corner_uv: np.ndarray | None = None  # into uv, -1 for none
    normals: np.ndarray | None = None
    corner_normal: np.ndarray | None = None
    colors: np.ndarray | None = None  # (m, 4) in [0, 1]
    corner_color: np.ndarray | None = None
    parts: tuple[str, ...] = ("mesh",)
    polygon_part: np.ndarray | None = None
    materials: tuple[Material, ...] = ()
    polygon_material: np.ndarray | None = None
    textures: dict[str, bytes] = field(default_factory=dict)
    gltf: tuple[dict[str, Any], tuple[bytes, ...], tuple[GltfInstance, ...]] | None = None
    notes: list[str] = field(default_factory=list)


def load_mesh(path: str | os.PathLike[str]) -> Mesh:
    """Load an OBJ, PLY, STL, OFF, GLB or glTF file as one welded triangle mesh.

    Quads and n-gons are triangulated in place, so faces keep the file's order. Vertices at one
    position become one; vertices that no face uses are left out. All geometries of a glTF scene are
    joined in world space. Parts whose faces point inwards, or disagree among themselves, are turned
    for the optimisation and saved with the file's own winding. Open, non-manifold and
    multi-component meshes are accepted, degenerate faces are kept.

    Raises `UserError`, one sentence with the file's name and a remedy, for anything that is not a
    mesh with a surface.
    """
    path = Path(path)
    reader = _READERS.get(path.suffix.lower())
    if path.is_dir():
        raise UserError(f"'{path}' is a folder: give a mesh file ({_list(READABLE)}).")
    if reader is None:
        what = f"ends in '{path.suffix}'" if path.suffix else "has no extension"
        raise UserError(f"'{path}' {what}: supported mesh files are {_list(READABLE)}.")
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise UserError(f"'{path}' does not exist: check the path of the mesh.") from None
    except PermissionError:
        raise UserError(f"'{path}' may not be read: change the file's permissions.") from None
    except OSError as error:
        raise UserError(f"'{path}' cannot be read ({error.strerror or error}).") from None
    if not data.strip():
        raise UserError(f"'{path}' is empty: export the mesh again.")
    try:
        # Junk may hold numbers that overflow on the way; the checks below speak about them.
        with np.errstate(all="ignore"):
            soup = reader(data, path)
    except _Problem as problem:
        raise UserError(f"'{path}' {problem}") from None
    except (MemoryError, KeyboardInterrupt):
        raise
    except Exception as error:
        kind = path.suffix.lower()[1:].upper()
        detail = " ".join(str(error).split())[:120]
        raise UserError(
            f"'{path}' is not a readable {kind} file ({type(error).__name__}: {detail}): "
            "export the mesh again."
        ) from None
    try:
        return _weld(soup, path.stem)
    except _Problem as problem:
        raise UserError(f"'{path}' {problem}") from None


class _Problem(Exception):
    """A fault of the file, as the end of a sentence that begins with its name."""


def _list(extensions: Iterable[str]) -> str:
    return ", ".join(extensions)


def _plural(count: int, one: str, many: str) -> str:
    return f"{count} {one if count == 1 else many}"


def _weld(soup: _Soup, name: str) -> Mesh:
    """From a reader's polygons to a checked, welded, outward `Mesh`."""
    repairs = list(soup.notes)
    positions = np.asarray(soup.positions, dtype=np.float64).reshape(-1, 3)
    if len(soup.counts) == 0:
        what = "is a point cloud" if len(positions) else "holds no mesh"
        raise _Problem(f"{what}: it has no faces; reconstruct or export a surface first.")
    if soup.corners.min() < 0 or soup.corners.max() >= len(positions):
        bad = int(soup.corners.max()) if soup.corners.max() >= len(positions) else "a negative one"
        raise _Problem(
            f"has a face that refers to vertex {bad} (from 0), but there are only "
            f"{len(positions)} vertices: export the mesh again."
        )
    small = soup.counts < 3
    if small.any():
        number = _plural(int(small.sum()), "face", "faces")
        repairs.append(f"left out {number} with fewer than three corners")

    used = np.zeros(len(positions), dtype=bool)
    used[soup.corners] = True
    points = positions[used]
    if not np.isfinite(points).all():
        count = int((~np.isfinite(points).all(axis=1)).sum())
        raise _Problem(
            f"has {_plural(count, 'vertex', 'vertices')} with NaN or infinite coordinates: "
            "repair it in a mesh editor."
        )
    extent = float(np.ptp(points, axis=0).max())
    if np.abs(points).max() > _LARGEST:
        raise _Problem(f"has coordinates beyond {_LARGEST:g}: scale the mesh down.")
    if extent <= 0.0:
        raise _Problem("has no extent, all its vertices coincide: export the mesh again.")
    if extent < _SMALLEST:
        raise _Problem(f"is smaller than {_SMALLEST:g}: scale the mesh up.")

    triangles, owner = _triangulate(soup.counts, positions[soup.corners] / extent)
    if len(triangles) == 0:
        raise _Problem("has no face with three corners: export the mesh again.")
    quads, others = int((soup.counts == 4).sum()), int((soup.counts > 4).sum())
    if quads:
        repairs.append(f"triangulated {_plural(quads, 'quad', 'quads')}")
    if others:
        larger = _plural(others, "polygon", "polygons")
        repairs.append(f"triangulated {larger} of more than four corners")

    # Weld: first appearance gives a vertex its place and position, so an order without duplicates
    # stays as it was.
    grid = np.round((points - points.min(axis=0)) / (extent * _WELD)).astype(np.int64)
    _, first, inverse = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first, kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    vertices = points[first[order]]
    vertex_of = np.full(len(positions), -1, dtype=np.int64)
    vertex_of[used] = rank[inverse.ravel()]
    if len(points) > len(vertices):
        number = _plural(len(points) - len(vertices), "duplicate vertex", "duplicate vertices")
        repairs.append(f"welded {number}")
    if not used.all():
        number = _plural(int((~used).sum()), "vertex", "vertices")
        repairs.append(f"left out {number} that no face uses")

    file_faces = vertex_of[soup.corners[triangles]]
    areas = face_areas((vertices - vertices.mean(axis=0)) / extent, file_faces)
    degenerate = int((areas <= 1e-20).sum())
    if degenerate == len(file_faces):
        raise _Problem("has only degenerate faces, without any area: export the mesh again.")
    if degenerate:
        number = _plural(degenerate, "degenerate face", "degenerate faces")
        repairs.append(f"ignored {number} for the normals")

    flipped, note = _inside_out((vertices - vertices.mean(axis=0)) / extent, file_faces)
    if note:
        repairs.append(note)
    faces = file_faces.copy()
    faces[flipped] = faces[flipped][:, ::-1]

    carrier = _carrier(soup, triangles, owner, file_faces, flipped, len(vertices))
    return Mesh(name, vertices, np.ascontiguousarray(faces), tuple(repairs), carrier)


def _carrier(
    soup: _Soup,
    triangles: np.ndarray,
    owner: np.ndarray,
    file_faces: np.ndarray,
    flipped: np.ndarray,
    vertex_count: int,
) -> Carrier:
    """Number the file's rows: distinct (vertex, uv, normal, colour), sorted by vertex."""
    if soup.gltf is None:  # glTF's rows are its accessors' rows
        soup.uv, soup.corner_uv = _shared(soup.uv, soup.corner_uv)
        soup.normals, soup.corner_normal = _shared(soup.normals, soup.corner_normal)
        if soup.corner_normal is not None and _only_flat(soup, triangles, file_faces, vertex_count):
            soup.normals = soup.corner_normal = None
    tables = [
        (soup.uv, soup.corner_uv),
        (soup.normals, soup.corner_normal),
        (soup.colors, soup.corner_color),
    ]
    keys = [file_faces.ravel()]
    for values, index in tables:
        if values is not None and index is not None:
            keys.append(index[triangles].ravel())
    if len(keys) == 1:
        corners, rows = file_faces, np.arange(vertex_count)
        attributes: list[np.ndarray | None] = [None, None, None]
    else:
        _, first, inverse = np.unique(
            np.stack(keys, axis=1), axis=0, return_index=True, return_inverse=True
        )
        corners, rows = inverse.reshape(-1, 3), keys[0][first]
        attributes = []
        for values, index in tables:
            if values is None or index is None:
                attributes.append(None)
                continue
            chosen = index[triangles].ravel()[first]
            filler = np.zeros((1, values.shape[1]))
            attributes.append(np.concatenate([values, filler])[chosen])  # -1 is the filler
    gltf = None
    if soup.gltf is not None:
        document, buffers, instances = soup.gltf
        row_of = np.full(len(soup.positions), -1, dtype=np.int64)
        row_of[soup.corners[triangles].ravel()] = corners.ravel()
        gltf = GltfSource(document, buffers, instances, row_of)
    return Carrier(
        corners=corners,
        rows=rows,
        flipped=flipped,
        uv=attributes[0],
        normals=attributes[1],
        colors=attributes[2],
        parts=soup.parts,
        face_part=None if soup.polygon_part is None else soup.polygon_part[owner],
        materials=soup.materials,
        face_material=None if soup.polygon_material is None else soup.polygon_material[owner],
        textures=soup.textures,
        gltf=gltf,
    )


def _shared(
    values: np.ndarray | None, index: np.ndarray | None
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Merge equal rows, so that a file that repeats them at each corner gets no seams by it."""
    if values is None or index is None:
        return None, None
    unique, inverse = np.unique(values, axis=0, return_inverse=True)
    return unique, np.where(index >= 0, inverse.ravel()[index], -1)


def _only_flat(soup: _Soup, triangles: np.ndarray, faces: np.ndarray, vertex_count: int) -> bool:
    """Whether the normals are just those of the faces of a densely sampled smooth surface.

    Many exporters write them; they would triple the rows and make the result look faceted.
    """
    assert soup.normals is not None
    assert soup.corner_normal is not None
    corner = soup.corner_normal[triangles]
    if (corner < 0).any():
        return False
    groups = len(np.unique(faces.ravel() * len(soup.normals) + corner.ravel()))
    if groups < 0.9 * faces.size:
        return False
    crosses = np.repeat(_unit_rows(soup.normals)[corner[:, 0]], 3, axis=0)
    sums = np.zeros((vertex_count, 3))
    np.add.at(sums, faces.ravel(), crosses)
    smooth = _unit_rows(sums)[faces.ravel()]
    return bool(np.median(np.einsum("ij,ij->i", smooth, crosses)) > 0.9)


def _unit_rows(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0, length, 1.0)


def _triangulate(counts: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of polygons, in the polygons' order.

    ``counts`` (polygons,) and ``points`` (sum of counts, 3) are runs of corners. Returns triangles
    (t, 3) into the corners and the polygon (t,) that each came from. Quads are cut along the
    diagonal that stays inside; larger polygons from one corner if that is sound, else by ears.
    """
    start = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int64)
    threes = np.flatnonzero(counts == 3)
    triangles = [start[threes, None] + np.arange(3)]
    owners = [threes]

    fours = np.flatnonzero(counts == 4)
    if len(fours):
        corner = start[fours, None] + np.arange(4)
        a, b, c, d = (points[corner[:, k]] for k in range(4))
        # Cut along 0-2 unless its two halves face apart, then along 1-3.
        apart = np.einsum("ij,ij->i", np.cross(b - a, c - a), np.cross(c - a, d - a)) < 0
        along_02, along_13 = [[0, 1, 2], [0, 2, 3]], [[1, 2, 3], [1, 3, 0]]
        pattern = np.where(apart[:, None, None], along_13, along_02)
        triangles.append(np.take_along_axis(corner[:, None, :], pattern, axis=2).reshape(-1, 3))
        owners.append(np.repeat(fours, 2))

    for polygon in np.flatnonzero(counts > 4):
        span = slice(start[polygon], start[polygon] + counts[polygon])
        cut = start[polygon] + _cut_polygon(points[span])
        triangles.append(cut)
        owners.append(np.full(len(cut), polygon))

    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    return np.concatenate(triangles)[order].astype(np.int64), owner[order]


def _cut_polygon(points: np.ndarray) -> np.ndarray:
    """Triangles (n - 2, 3) of one polygon (n, 3)."""
    n = len(points)
    fan = np.stack([np.zeros(n - 2, int), np.arange(1, n - 1), np.arange(2, n)], axis=1)
    crosses = _face_crosses(points, fan)
    normal = crosses.sum(axis=0)
    if (crosses @ normal >= 0).all():
        return fan
    axes = np.delete(np.arange(3), np.argmax(np.abs(normal)))
    flat = points[:, axes] * np.array([np.sign(normal[np.argmax(np.abs(normal))]), 1.0])
    if np.argmax(np.abs(normal)) == 1:
        flat = flat * np.array([-1.0, 1.0])  # (x, z) is left-handed seen along y

    def turn(i: int, j: int, k: int) -> float:
        (ax, ay), (bx, by), (cx, cy) = flat[i], flat[j], flat[k]
        return float((bx - ax) * (cy - ay) - (by - ay) * (cx - ax))

    left, ears = list(range(n)), []
    while len(left) > 3:
        for k in range(len(left)):
            i, j, m = left[k - 1], left[k], left[(k + 1) % len(left)]
            inside = (
                turn(i, j, p) >= 0 and turn(j, m, p) >= 0 and turn(m, i, p) >= 0
                for p in left
                if p not in (i, j, m)
            )
            if turn(i, j, m) > 0 and not any(inside):
                break
        else:
            k = 1  # self-intersecting: any ear is as good
            i, j, m = left[0], left[1], left[2]
        ears.append((i, j, m))
        left.pop(k)
    return np.array([*ears, tuple(left)])


def _inside_out(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, str | None]:
    """Which faces (faces,) to turn so that components agree with themselves and point outwards."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    n = len(faces)
    flipped = np.zeros(n, dtype=bool)
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    forward = edges[:, 0] < edges[:, 1]
    key = edges.min(axis=1) * len(vertices) + edges.max(axis=1)
    key = np.where(edges[:, 0] == edges[:, 1], -1 - np.arange(len(key)), key)  # no edge at all
    order = np.argsort(key, kind="stable")
    _, first, count = np.unique(key[order], return_index=True, return_counts=True)
    pairs = first[count == 2]
    left, right = order[pairs], order[pairs + 1]
    f, g, same = left // 3, right // 3, forward[left] != forward[right]

    # Each face twice, as it is and turned: neighbours are joined the way that makes them agree.
    # Components of this graph come in mirror pairs unless the surface is one-sided.
    a = np.concatenate([f, f + n])
    b = np.concatenate([np.where(same, g, g + n), np.where(same, g + n, g)])
    graph = coo_matrix((np.ones(len(a), dtype=bool), (a, b)), shape=(2 * n, 2 * n))
    _, label = connected_components(graph, directed=False)
    as_is, turned = label[:n], label[n:]
    one_sided = as_is == turned
    component = np.minimum(as_is, turned)
    _, component = np.unique(component, return_inverse=True)
    total = int(component.max()) + 1

    # Of the two ways to wind a component take the file's more frequent one ...
    votes = np.bincount(component, np.where(as_is < turned, 1.0, -1.0), minlength=total)
    flipped = ((as_is < turned) != (votes >= 0)[component]) & ~one_sided
    disagreeing = int(flipped.sum())

    # ... then turn closed components whose volume is negative, unless they bound a cavity.
    turned_faces = np.where(flipped[:, None], faces[:, ::-1], faces)
    p, q, r = (vertices[turned_faces[:, k]] for k in range(3))
    volume = np.bincount(component, np.einsum("ij,ij->i", p, np.cross(q, r)) / 6, minlength=total)
    is_open = np.zeros(total, dtype=bool)
    odd = np.repeat(count % 2 == 1, count) & (key[order] >= 0)
    is_open[component[order[odd] // 3]] = True
    inward = ~is_open & (volume < -1e-12)
    if inward.any():
        low = np.full((total, 3), np.inf)
        high = np.full((total, 3), -np.inf)
        np.minimum.at(low, component, np.minimum(np.minimum(p, q), r))
        np.maximum.at(high, component, np.maximum(np.maximum(p, q), r))
        for c in np.flatnonzero(inward):
            around = (low < low[c]).all(axis=1) & (high > high[c]).all(axis=1) & (volume > 0)
            if around.any():
                inward[c] = False
        flipped ^= inward[component]
    notes = []
    if disagreeing:
        number = _plural(disagreeing, "face", "faces")
        notes.append(f"turned {number} that disagreed with their neighbours")
    if inward.any():
        which = "the mesh" if inward.all() else _plural(int(inward.sum()), "part", "parts")
        notes.append(f"turned {which} inside out, because the faces pointed inwards")
    if not notes:
        return flipped, None
    return flipped, " and ".join(notes) + " (saved files keep the input's winding)"


# ---------------------------------------------------------------------------------------- readers


def _text(data: bytes) -> str:
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    if "\0" in text:
        raise _Problem("is binary where text was expected: export the mesh again.")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _bare(name: str) -> str:
    """The file's name without folders, be they written the Unix or the Windows way."""
    return re.split(r"[/\\]", name)[-1]


def _beside(path: Path, name: str) -> Path | None:
    """The file that ``name`` in ``path`` refers to, if there is one.

    Files made elsewhere often hold an absolute or a Windows path: then the bare name is tried.
    """
    for candidate in (name, name.replace("\\", "/"), re.split(r"[\\/]", name)[-1]):
        try:
            found = path.parent / candidate
            if candidate and found.is_file():
                return found
        except (OSError, ValueError):
            continue
    return None


def _read_obj(data: bytes, path: Path) -> _Soup:
    positions: list[list[str]] = []
    uv: list[list[str]] = []
    normals: list[list[str]] = []
    corners: list[tuple[int, int, int]] = []
    counts: list[int] = []
    polygon_part: list[int] = []
    polygon_material: list[int] = []
    libraries: list[str] = []
    parts: dict[str, int] = {}
    materials: dict[str, int] = {}
    part, material = path.stem, -1

    def index(text: str, given: int, number: int) -> int:
        # 1-based; negative ones count back from the last line given so far.
        value = int(text)
        if value == 0:
            raise _Problem(f"has index 0 in line {number}, but OBJ counts from 1: export it again.")
        return value - 1 if value > 0 else given + value

    for number, line in enumerate(_text(data).replace("\\\n", " ").split("\n"), 1):
        words = line.split()
        if not words:
            continue
        match words[0]:
            case "v":
                positions.append(words[1:])
            case "vt":
                uv.append(words[1:3])
            case "vn":
                normals.append(words[1:4])
            case "f":
                at = words.index("#") if "#" in words else len(words)
                for word in words[1:at]:
                    p, t, n = [*word.split("/"), "", ""][:3]
                    corner = index(p, len(positions), number)
                    if corner < 0:
                        raise _Problem(
                            f"has a face in line {number} that refers to vertex {p}, before the "
                            "first one: export the mesh again."
                        )
                    corners.append(
                        (
                            corner,
                            index(t, len(uv), number) if t else -1,
                            index(n, len(normals), number) if n else -1,
                        )
                    )
                counts.append(at - 1)
                polygon_part.append(parts.setdefault(part, len(parts)))
                polygon_material.append(material)
            case "o" | "g":
                part = line.split(None, 1)[1].strip() if len(words) > 1 else path.stem
            case "usemtl":
                name = line.split(None, 1)[1].strip() if len(words) > 1 else ""
                material = materials.setdefault(name, len(materials))
            case "mtllib":
                libraries.append(line.split(None, 1)[1].strip() if len(words) > 1 else "")

    notes: list[str] = []
    table, textures = _read_mtl(path, libraries, notes)
    index_array = np.array(corners, dtype=np.int64).reshape(-1, 3)
    place, colors = _obj_vertices(positions)
    soup = _Soup(
        place,
        np.array(counts, dtype=np.int64),
        index_array[:, 0],
        colors=colors,
        corner_color=None if colors is None else index_array[:, 0],
        parts=tuple(parts) or (path.stem,),
        polygon_part=np.array(polygon_part, dtype=np.int64),
        textures=textures,
        notes=notes,
    )
    if materials:
        soup.materials = tuple(table.get(name, Material(name)) for name in materials)
        soup.polygon_material = np.array(polygon_material, dtype=np.int64)
    for column, lines, values, name in (
        (1, uv, "uv", "corner_uv"),
        (2, normals, "normals", "corner_normal"),
    ):
        chosen = index_array[:, column]
        if not (chosen >= 0).any():
            continue
        width = column + 1
        if chosen.max() >= len(lines) or chosen.min() < -1:
            notes.append(f"left out the {values}, because faces refer to some that do not exist")
            continue
        rows = [[*words, "0", "0", "0"][:width] for words in lines]
        setattr(soup, values, np.array(rows, dtype=np.float64).reshape(-1, width))
        setattr(soup, name, chosen)
    return soup


def _obj_vertices(rows: list[list[str]]) -> tuple[np.ndarray, np.ndarray | None]:
    """Positions (n, 3), and colours (n, 4) where every line gives ``x y z r g b``."""
    widths = {len(row) for row in rows}
    if len(widths) == 1 and min(widths) >= 3:
        table = np.array(rows, dtype=np.float64)
    else:
        cut = [row[: row.index("#")] if "#" in row else row for row in rows]
        if any(len(row) < 3 for row in cut):
            raise _Problem("has a vertex with fewer than three coordinates: export it again.")
        widths = {min(len(row) for row in cut)} if cut else {3}
        table = np.array([row[: min(widths)] for row in cut], dtype=np.float64).reshape(
            -1, min(widths)
        )
    if table.shape[1] < 6:
        return table[:, :3], None
    colors = table[:, 3:6] / (255.0 if table[:, 3:6].max() > 1.0 else 1.0)
    return table[:, :3], np.column_stack([colors, np.ones(len(colors))])


def _read_mtl(
    path: Path, libraries: list[str], notes: list[str]
) -> tuple[dict[str, Material], dict[str, bytes]]:
    """The materials and the images of an OBJ's libraries; what is missing goes into ``notes``."""
    found: dict[str, Material] = {}
    textures: dict[str, bytes] = {}
    for library in libraries:
        # One line may name several libraries, or one whose name has spaces.
        names = [library] if _beside(path, library) else library.split()
        for name in names:
            file = _beside(path, name)
            if file is None:
                notes.append(f"did not find the material library '{name}', saved without it")
                continue
            block: list[str] = []
            for line in [*_text(file.read_bytes()).split("\n"), "newmtl"]:
                words = line.split()
                if words and words[0].lower() == "newmtl":
                    if block:
                        material = _material_of(block, file, textures, notes)
                        found[material.name] = material
                    block = [line.strip()]
                elif words and block and not words[0].startswith("#"):
                    block.append(line.strip())
    return found, textures


def _is_map(line: str) -> bool:
    key = line.split(None, 1)[0].lower()
    return key.startswith("map_") or key in ("bump", "disp", "decal", "refl", "norm")


def _map_name(line: str) -> str:
    """The file that a ``map_`` line names, after options such as ``-s 1 1 1`` or ``-bm 0.5``."""
    words = line.split(None, 1)[1] if len(line.split(None, 1)) > 1 else ""
    option = re.compile(r"^-[a-zA-Z]+(\s+(on|off|[-+.\d]+[-+.\deE]*|[rgbmlz](?=\s)|sphere))*\s+")
    while match := option.match(words):
        words = words[match.end() :]
    return words.strip()


def _material_of(
    block: list[str], file: Path, textures: dict[str, bytes], notes: list[str]
) -> Material:
    name = block[0].split(None, 1)[1].strip() if len(block[0].split(None, 1)) > 1 else ""
    color, texture, lines = [0.8, 0.8, 0.8, 1.0], None, [block[0]]
    for line in block[1:]:
        words = line.split()
        key = words[0].lower()
        with contextlib.suppress(ValueError):
            if key == "kd" and len(words) >= 4:
                color[:3] = [float(word) for word in words[1:4]]
            elif key == "d":
                color[3] = float(words[-1])
            elif key == "tr":
                color[3] = 1.0 - float(words[-1])
        if _is_map(line):
            wanted = _map_name(line)
            image = _beside(file, wanted)
            if image is None:
                notes.append(f"did not find the texture '{wanted}', saved without it")
                continue
            textures.setdefault(wanted, image.read_bytes())
            if key == "map_kd":
                texture = wanted
        lines.append(line)
    return Material(name, (color[0], color[1], color[2], color[3]), texture, tuple(lines))


_PLY_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}


@dataclass
class _PlyElement:
    name: str
    count: int
    properties: list[tuple[str, str, str | None]] = field(default_factory=list)
    """(name, type, type of the length, or None if it is no list)."""
    scalars: dict[str, np.ndarray] = field(default_factory=dict)
    lists: dict[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    """(lengths, values one after the other)."""


def _read_ply(data: bytes, path: Path) -> _Soup:
    end = re.search(rb"\bend_header[ \t]*(\r\n|\n|\r)", data)
    if not data.startswith(b"ply") or end is None:
        raise _Problem("is not a PLY file, its header is missing: export the mesh again.")
    style, texture, elements = "", None, []
    for line in data[: end.start()].decode("latin-1").splitlines():
        words = line.split()
        match words:
            case ["format", style, *_]:
                pass
            case ["comment", tag, *_] if tag.lower() == "texturefile":
                texture = _texture_name(line)
            case ["element", name, count]:
                elements.append(_PlyElement(name, int(count)))
            case ["property", "list", length, kind, name]:
                elements[-1].properties.append((name, _PLY_TYPES[kind], _PLY_TYPES[length]))
            case ["property", kind, name]:
                elements[-1].properties.append((name, _PLY_TYPES[kind], None))
    body = data[end.end() :]
    if any(element.count < 0 for element in elements):
        raise _Problem("has a negative count in its header: export the mesh again.")
    if style == "ascii":
        _read_ply_ascii(body, elements)
    elif style in ("binary_little_endian", "binary_big_endian"):
        _read_ply_binary(body, elements, "<" if "little" in style else ">")
    else:
        raise _Problem(f"has the unknown PLY format '{style}': export the mesh again.")

    by_name = {element.name: element for element in elements}
    vertex = by_name.get("vertex", _PlyElement("vertex", 0))
    face = by_name.get("face", _PlyElement("face", 0))
    if "tristrips" in by_name and not face.lists:
        raise _Problem("stores triangle strips: export it with faces, or as OBJ.")
    if vertex.count and not {"x", "y", "z"} <= set(vertex.scalars):
        raise _Problem("has vertices without x, y and z: export the mesh again.")
    positions = (
        np.stack([vertex.scalars[axis].astype(np.float64) for axis in "xyz"], axis=1)
        if vertex.count
        else np.zeros((0, 3))
    )
    none = (np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))
    counts, corners = face.lists.get("vertex_indices", face.lists.get("vertex_index", none))
    corners = corners.astype(np.int64)
    soup = _Soup(positions, counts.astype(np.int64), corners, parts=(path.stem,))
    soup.colors = _ply_colors(vertex)
    if soup.colors is not None:
        soup.corner_color = corners
    elif (face_colors := _ply_colors(face)) is not None:
        soup.colors, index = np.unique(face_colors, axis=0, return_inverse=True)
        soup.corner_color = np.repeat(index.ravel(), counts)
    for u, v in (("texture_u", "texture_v"), ("s", "t"), ("u", "v")):
        if u in vertex.scalars and v in vertex.scalars:
            soup.uv = np.stack([vertex.scalars[u], vertex.scalars[v]], axis=1).astype(np.float64)
            soup.corner_uv = corners
            break
    lengths, values = face.lists.get("texcoord", none)
    if len(lengths) and (lengths == 2 * counts).all():
        soup.uv, index = np.unique(
            values.reshape(-1, 2).astype(np.float64), axis=0, return_inverse=True
        )
        soup.corner_uv = index.ravel()
    if texture is not None and soup.uv is not None:
        image = _beside(path, texture)
        if image is None:
            soup.notes.append(f"did not find the texture '{texture}', saved without it")
        else:
            soup.textures = {texture: image.read_bytes()}
            soup.materials = (Material("material", (1.0, 1.0, 1.0, 1.0), texture),)
            soup.polygon_material = np.zeros(len(counts), dtype=np.int64)
    return soup


def _texture_name(line: str) -> str:
    """What follows ``comment TextureFile``."""
    return line.strip().split(None, 2)[2].strip() if len(line.split()) > 2 else ""


def _ply_colors(element: _PlyElement) -> np.ndarray | None:
    if not {"red", "green", "blue"} <= set(element.scalars):
        return None
    names = ["red", "green", "blue"] + (["alpha"] if "alpha" in element.scalars else [])
    columns = [element.scalars[name] for name in names]
    columns = [c / 255.0 if c.dtype.kind in "iu" else c.astype(float) for c in columns]
    return np.stack([*columns, np.ones(element.count)][:4], axis=1)


def _read_ply_ascii(body: bytes, elements: list[_PlyElement]) -> None:
    words = body.split()
    at = 0
    for element in elements:
        kinds = element.properties
        if not any(length for _, _, length in kinds):
            table = np.array(words[at : at + element.count * len(kinds)], dtype=np.float64)
            table = table.reshape(element.count, len(kinds))
            at += table.size
            for column, (name, kind, _) in zip(table.T, kinds, strict=True):
                element.scalars[name] = column.astype(kind)
            continue
        scalars: dict[str, list[float]] = {name: [] for name, _, length in kinds if not length}
        lists: dict[str, tuple[list[int], list[float]]] = {
            name: ([], []) for name, _, length in kinds if length
        }
        for _ in range(element.count):
            for name, _, length in kinds:
                if not length:
                    scalars[name].append(float(words[at]))
                    at += 1
                    continue
                count = int(words[at])
                lists[name][0].append(count)
                lists[name][1].extend(float(word) for word in words[at + 1 : at + 1 + count])
                if at + 1 + count > len(words):
                    raise _Problem("ends too early: export the mesh again.")
                at += 1 + count
        for name, kind, length in kinds:
            if length:
                counts, values = lists[name]
                element.lists[name] = (np.array(counts, dtype=np.int64), np.array(values, kind))
            else:
                element.scalars[name] = np.array(scalars[name]).astype(kind)


def _read_ply_binary(body: bytes, elements: list[_PlyElement], order: str) -> None:
    at = 0
    for element in elements:
        if element.count == 0:
            continue
        # If every list is as long as its first one, the element is an array of records.
        sizes, probe = [], at
        for _, kind, length in element.properties:
            size = 1
            if length:
                size = int(np.frombuffer(body, order + length, 1, probe)[0])
                probe += np.dtype(length).itemsize
            sizes.append(size)
            probe += size * np.dtype(kind).itemsize
        fields: list[tuple[Any, ...]] = []
        for k, (_, kind, length) in enumerate(element.properties):
            if length:
                fields.append((f"n{k}", order + length))
            fields.append((f"v{k}", order + kind, (max(sizes[k], 0),)))
        record = np.dtype(fields)
        listed = [k for k, (_, _, length) in enumerate(element.properties) if length]
        if len(body) - at >= record.itemsize * element.count:
            table = np.frombuffer(body, record, element.count, at)
            if all((table[f"n{k}"] == sizes[k]).all() for k in listed):
                for k, (name, kind, length) in enumerate(element.properties):
                    values = table[f"v{k}"].astype(kind)
                    if length:
                        element.lists[name] = (np.full(element.count, sizes[k]), values.ravel())
                    else:
                        element.scalars[name] = values[:, 0]
                at += record.itemsize * element.count
                continue
        if not listed:
            raise _Problem("ends too early: export the mesh again.")
        at = _read_ply_rows(body, element, order, at)


def _read_ply_rows(body: bytes, element: _PlyElement, order: str, at: int) -> int:
    """Lists of differing lengths: one row after the other. Returns where the next one begins."""
    columns: dict[str, list[np.ndarray]] = {name: [] for name, _, _ in element.properties}
    kinds = [
        (name, np.dtype(order + kind), np.dtype(order + length) if length else None)
        for name, kind, length in element.properties
    ]
    for _ in range(element.count):
        for name, kind, length in kinds:
            count = 1
            if length is not None:
                count = int(np.frombuffer(body, length, 1, at)[0])
                at += length.itemsize
            columns[name].append(np.frombuffer(body, kind, count, at))
            at += count * kind.itemsize
    for name, kind, length in kinds:
        values = np.concatenate(columns[name]).astype(kind.newbyteorder("="))
        if length is None:
            element.scalars[name] = values
        else:
            element.lists[name] = (np.array([len(row) for row in columns[name]]), values)
    return at


def _read_off(data: bytes, path: Path) -> _Soup:
    lines = (line.split("#", 1)[0].split() for line in _text(data).split("\n"))
    rows = [words for words in lines if words]
    if not rows or not re.fullmatch(r"(ST)?C?N?OFF", rows[0][0].upper()):
        raise _Problem("is not an OFF file, its first line is not 'OFF': export the mesh again.")
    kind = rows[0][0].upper()
    if "BINARY" in (word.upper() for word in rows[0]):
        raise _Problem("is a binary OFF file: export it as text, or as PLY.")
    head = rows[0][1:] or rows[1]
    rows = rows[1:] if rows[0][1:] else rows[2:]
    vertex_count, face_count = int(head[0]), int(head[1])
    if vertex_count < 0 or face_count < 0 or len(rows) < vertex_count + face_count:
        raise _Problem("ends too early: export the mesh again.")
    table = [[float(word) for word in row] for row in rows[:vertex_count]]
    if any(len(row) < 3 for row in table):
        raise _Problem("has a vertex with fewer than three coordinates: export the mesh again.")
    polygons = rows[vertex_count : vertex_count + face_count]
    counts = np.array([int(row[0]) for row in polygons], dtype=np.int64)
    if any(len(row) <= count for row, count in zip(polygons, counts, strict=True)):
        raise _Problem("has a face with too few indices: export the mesh again.")
    corners = [int(w) for row, n in zip(polygons, counts, strict=True) for w in row[1 : n + 1]]
    positions = np.array([row[:3] for row in table], dtype=np.float64).reshape(-1, 3)
    soup = _Soup(positions, counts, np.array(corners, dtype=np.int64), parts=(path.stem,))
    skip = 6 if "N" in kind.replace("OFF", "") else 3
    if "C" in kind and table and min(len(row) for row in table) >= skip + 3:
        colors = np.array([[*row[skip : skip + 4], 255.0][:4] for row in table])
        if (colors[:, :3] <= 1.0).all():
            colors[:, :3] *= 255.0
        if colors[:, 3].max() <= 1.0:
            colors[:, 3] *= 255.0
        soup.colors, soup.corner_color = colors / 255.0, soup.corners
    return soup


def _read_stl(data: bytes, path: Path) -> _Soup:
    import trimesh

    loaded = trimesh.load(io.BytesIO(data), file_type="stl", process=False)
    solids = list(loaded.geometry.items()) if hasattr(loaded, "geometry") else [("", loaded)]
    positions: list[np.ndarray] = []
    part: list[np.ndarray] = []
    names: list[str] = []
    for name, solid in solids:
        triangles = np.asarray(solid.vertices)[np.asarray(solid.faces)]
        positions.append(triangles.reshape(-1, 3))
        part.append(np.full(len(triangles), len(names), dtype=np.int64))
        names.append(name or path.stem)
    points = np.concatenate(positions) if positions else np.zeros((0, 3))
    # An STL repeats every corner; welding them is no repair worth a word, so it is done here.
    unique, first, inverse = np.unique(points, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first, kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return _Soup(
        unique[order],
        np.full(len(points) // 3, 3, dtype=np.int64),
        rank[inverse.ravel()],
        parts=tuple(names) or (path.stem,),
        polygon_part=np.concatenate(part) if part else None,
    )


_GLTF_TYPES = {5120: "i1", 5121: "u1", 5122: "i2", 5123: "u2", 5125: "u4", 5126: "f4"}
_GLTF_SIZES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_GLTF_COMPRESSED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression")


def _read_gltf(data: bytes, path: Path) -> _Soup:
    document, binary = _split_glb(data) if data[:4] == b"glTF" else (json.loads(_text(data)), None)
    if not isinstance(document, dict) or "asset" not in document:
        raise _Problem("is not a glTF file: export the mesh again.")
    packed = [name for name in _GLTF_COMPRESSED if name in document.get("extensionsRequired", ())]
    if packed:
        raise _Problem(f"is compressed with {packed[0]}: export it without compression.")
    buffers = []
    for k, buffer in enumerate(document.get("buffers", ())):
        content = _uri(buffer["uri"], path) if "uri" in buffer else binary if k == 0 else None
        if content is None:
            what = buffer.get("uri", "its binary chunk")
            raise _Problem(f"needs the buffer '{what}', which is missing: put it beside the file.")
        if len(content) < buffer["byteLength"]:
            raise _Problem("ends too early, a buffer is cut off: export the mesh again.")
        buffers.append(content)

    soup = _Soup(np.zeros((0, 3)), np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))
    _gltf_materials(soup, document, buffers, path)
    instances: list[GltfInstance] = []
    parts: list[str] = []
    columns: dict[str, list[np.ndarray]] = {
        key: [] for key in ("position", "uv", "normal", "color", "face", "part", "material")
    }
    present = dict.fromkeys(("uv", "normal", "color"), False)
    start = skipped = 0
    for node, matrix in _gltf_nodes(document):
        at = document["nodes"][node].get("mesh")
        if at is None:
            continue
        described = document["meshes"][at]
        label = document["nodes"][node].get("name") or described.get("name") or f"part{len(parts)}"
        for k, primitive in enumerate(described["primitives"]):
            attributes = primitive["attributes"]
            if "POSITION" not in attributes or primitive.get("mode", 4) not in (4, 5, 6):
                skipped += 1
                continue
            local = _accessor(document, buffers, attributes["POSITION"])
            count = len(local)
            columns["position"].append(local @ matrix[:3, :3].T + matrix[:3, 3])
            # -1 marks rows without the attribute, so that primitives may differ in what they have.
            for key, attribute, width in (
                ("uv", "TEXCOORD_0", 2),
                ("normal", "NORMAL", 3),
                ("color", "COLOR_0", 4),
            ):
                values = np.full((count, width), np.nan)
                if attribute in attributes:
                    given = _accessor(document, buffers, attributes[attribute])
                    if key == "color" and given.shape[1] == 3:
                        given = np.column_stack([given, np.ones(count)])
                    values = given.reshape(count, width)
                    present[key] = True
                columns[key].append(values)
            if "indices" in primitive:
                index = _accessor(document, buffers, primitive["indices"]).astype(np.int64).ravel()
            else:
                index = np.arange(count)
            if index.size and index.max() >= count:
                raise _Problem(
                    f"has a face that refers to vertex {index.max()} (from 0) of {count}: "
                    "export the mesh again."
                )
            faces = _gltf_faces(index, primitive.get("mode", 4))
            if np.linalg.det(matrix[:3, :3]) < 0:
                faces = faces[:, ::-1]  # the specification: a mirrored node winds the other way
            columns["face"].append(faces + start)
            columns["part"].append(np.full(len(faces), len(parts)))
            columns["material"].append(np.full(len(faces), primitive.get("material", -1)))
            instances.append(GltfInstance(node, at, k, start, count, matrix))
            start += count
        parts.append(label)

    if skipped:
        soup.notes.append(f"left out {_plural(skipped, 'primitive', 'primitives')} without faces")
    if not instances:
        return soup
    joined = {key: np.concatenate(values) for key, values in columns.items() if values}
    joined["normal"] = _unit(joined["normal"], instances)
    soup.positions, soup.corners = joined["position"], joined["face"].ravel()
    soup.counts = np.full(len(joined["face"]), 3, dtype=np.int64)
    soup.parts, soup.polygon_part = tuple(parts), joined["part"]
    if soup.materials:
        soup.polygon_material = joined["material"]
    joined["uv"][:, 1] = 1.0 - joined["uv"][:, 1]
    corner = {
        key: np.where(np.isnan(joined[key][soup.corners, 0]), -1, soup.corners) for key in present
    }
    if present["uv"]:
        soup.uv, soup.corner_uv = joined["uv"], corner["uv"]
    if present["normal"]:
        soup.normals, soup.corner_normal = joined["normal"], corner["normal"]
    if present["color"]:
        soup.colors, soup.corner_color = joined["color"], corner["color"]
    for image in document.get("images", ()):
        # Saved as GLB everything lies in the one file.
        if "uri" in image and (content := _uri(image["uri"], path)) is not None:
            image["styleexp_bytes"] = content
    soup.gltf = (document, tuple(buffers), tuple(instances))
    return soup


def _unit(normals: np.ndarray, instances: list[GltfInstance]) -> np.ndarray:
    """Local normals of all instances' rows as unit normals in the world."""
    world = np.full_like(normals, np.nan)
    for one in instances:
        rows = slice(one.start, one.start + one.count)
        with contextlib.suppress(np.linalg.LinAlgError):
            turned = normals[rows] @ np.linalg.inv(one.matrix[:3, :3])
            world[rows] = _unit_rows(turned)
    return world


def _split_glb(data: bytes) -> tuple[dict[str, Any], bytes | None]:
    at, document, binary = 12, None, None
    while at + 8 <= len(data):
        length, kind = struct.unpack_from("<I4s", data, at)
        chunk = data[at + 8 : at + 8 + length]
        if len(chunk) < length:
            raise _Problem("ends too early: export the mesh again.")
        if kind == b"JSON":
            document = json.loads(chunk.decode("utf-8"))
        elif kind == b"BIN\0" and binary is None:
            binary = chunk
        at += 8 + length
    if document is None:
        raise _Problem("holds no glTF document (version 2 is supported): export the mesh again.")
    return document, binary


def _uri(uri: str, path: Path) -> bytes | None:
    if uri.startswith("data:"):
        return base64.b64decode(uri.split(",", 1)[1])
    file = _beside(path, urllib.parse.unquote(uri)) or _beside(path, uri)
    return file.read_bytes() if file else None


def _gltf_nodes(document: dict[str, Any]) -> Iterator[tuple[int, np.ndarray]]:
    """Nodes of the default scene in depth-first order, with their local-to-world matrices."""
    nodes = document.get("nodes", [])
    scenes = document.get("scenes", [])
    if scenes:
        roots = scenes[document.get("scene", 0)].get("nodes", [])
    else:
        children = {child for node in nodes for child in node.get("children", ())}
        roots = [k for k in range(len(nodes)) if k not in children]
    stack = [(root, np.eye(4)) for root in reversed(roots)]
    seen: set[int] = set()
    while stack:
        k, parent = stack.pop()
        if k in seen:
            raise _Problem("has a node with two parents: export the mesh again.")
        seen.add(k)
        world = parent @ _gltf_matrix(nodes[k])
        yield k, world
        stack.extend((child, world) for child in reversed(nodes[k].get("children", [])))


def _gltf_matrix(node: dict[str, Any]) -> np.ndarray:
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    x, y, z, w = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
    matrix = np.eye(4)
    matrix[:3, :3] = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    ) * np.array(node.get("scale", (1.0, 1.0, 1.0)))
    matrix[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return matrix


def _accessor(document: dict[str, Any], buffers: list[bytes], index: int) -> np.ndarray:
    """An accessor as float64 (count, width), integers scaled where they are normalised."""
    accessor = document["accessors"][index]
    count, width = accessor["count"], _GLTF_SIZES[accessor["type"]]
    kind = np.dtype("<" + _GLTF_TYPES[accessor["componentType"]])

    def view(holder: dict[str, Any], rows: int, columns: int, dtype: np.dtype) -> np.ndarray:
        described = document["bufferViews"][holder["bufferView"]]
        content = buffers[described["buffer"]]
        offset = described.get("byteOffset", 0) + holder.get("byteOffset", 0)
        size = columns * dtype.itemsize
        stride = described.get("byteStride", size)
        if rows < 0 or (rows and offset + (rows - 1) * stride + size > len(content)):
            raise _Problem("ends too early, an accessor reaches past its buffer: export it again.")
        return np.ndarray((rows, columns), dtype, content, offset, (stride, dtype.itemsize))

    values = np.zeros((count, width), dtype=kind)
    if "bufferView" in accessor:
        values = view(accessor, count, width, kind).copy()
    if sparse := accessor.get("sparse"):
        where = np.dtype("<" + _GLTF_TYPES[sparse["indices"]["componentType"]])
        rows = view(sparse["indices"], sparse["count"], 1, where).ravel()
        values[rows] = view(sparse["values"], sparse["count"], width, kind)
    result = values.astype(np.float64)
    if accessor.get("normalized") and kind.kind in "iu":
        result = np.maximum(result / np.iinfo(kind).max, -1.0)
    return result


def _gltf_faces(index: np.ndarray, mode: int) -> np.ndarray:
    if mode == 4:
        return index[: len(index) // 3 * 3].reshape(-1, 3)
    if len(index) < 3:
        return np.zeros((0, 3), dtype=np.int64)
    if mode == 6:
        return np.stack([np.full(len(index) - 2, index[0]), index[1:-1], index[2:]], axis=1)
    faces = np.stack([index[:-2], index[1:-1], index[2:]], axis=1)
    faces[1::2] = faces[1::2][:, [1, 0, 2]]
    return faces


def _gltf_materials(
    soup: _Soup, document: dict[str, Any], buffers: list[bytes], path: Path
) -> None:
    """Fill in the materials and base colour images, for saving in other formats."""
    materials = []
    for k, described in enumerate(document.get("materials", ())):
        surface = described.get("pbrMetallicRoughness", {})
        color = tuple(float(c) for c in surface.get("baseColorFactor", (1.0, 1.0, 1.0, 1.0)))
        key = None
        if "baseColorTexture" in surface:
            texture = document["textures"][surface["baseColorTexture"]["index"]]
            source = texture.get("source")
            for extension in texture.get("extensions", {}).values():
                source = extension.get("source", source) if source is None else source
            image = document["images"][source] if source is not None else {}
            content, wanted = None, image.get("uri", "")
            if "uri" in image:
                content = _uri(wanted, path)
                if content is None:
                    note = f"did not find the texture '{wanted}', saved without it"
                    if note not in soup.notes:
                        soup.notes.append(note)
            elif "bufferView" in image:
                view = document["bufferViews"][image["bufferView"]]
                begin = view.get("byteOffset", 0)
                content = buffers[view["buffer"]][begin : begin + view["byteLength"]]
            if content is not None:
                kind = image.get("mimeType", "") or (wanted[5:15] if wanted[:5] == "data:" else "")
                suffix = ".jpg" if "jp" in kind or content[:2] == b"\xff\xd8" else ".png"
                plain = "" if wanted.startswith("data:") else urllib.parse.unquote(wanted)
                key = plain or (image.get("name") or f"image{source}")
                if not Path(key).suffix:
                    key += suffix
                if soup.textures.setdefault(key, content) != content:
                    key = f"{source}_{key}"
                    soup.textures[key] = content
        name = described.get("name") or f"material{k}"
        materials.append(Material(name, (color[0], color[1], color[2], color[3]), key))
    soup.materials = tuple(materials)


_READERS: dict[str, Callable[[bytes, Path], _Soup]] = {
    ".obj": _read_obj,
    ".ply": _read_ply,
    ".stl": _read_stl,
    ".off": _read_off,
    ".glb": _read_gltf,
    ".gltf": _read_gltf,
}


# --------------------------------------------------------------------------------------- remeshing


def remesh(mesh: Mesh, target_vertices: int) -> Mesh:
    """Make a coarse mesh dense: about ``target_vertices`` even triangles' vertices on its surface.

    Botsch and Kobbelt's remesher from gpytoolbox, the surface re-projected onto the input. A mesh
    that already has as many vertices comes back as it is. One that the remesher cannot take
    (non-manifold, or it fails) is divided uniformly instead, each face into four, until it has as
    many. Either way ``repairs`` says what was done; attributes, materials and parts are lost.
    """
    before = len(mesh.vertices)
    if before >= target_vertices:
        note = f"not remeshed: it has {before} vertices already"
        return replace(mesh, repairs=(*mesh.repairs, note))
    frame = normalisation(mesh.vertices)
    points = frame.apply(mesh.vertices)
    reason = _unfit(points, mesh.faces)
    result = None if reason else _botsch(points, mesh.faces, target_vertices)
    if result is None:
        reason = reason or "the remesher failed"
        vertices, faces, times = points, mesh.faces, 0
        while len(vertices) < target_vertices:
            vertices, faces = _subdivide(vertices, faces)
            times += 1
        how = f"divided each face into {4**times} because {reason}"
    else:
        vertices, faces, creases = result
        how = "remeshed evenly, creases kept" if creases else "remeshed evenly"
    note = f"{how}: {before} to {len(vertices)} vertices"
    carrier = mesh.carrier
    if carrier is not None and (
        carrier.uv is not None or carrier.colors is not None or carrier.materials
    ):
        note += "; texture coordinates, colours and materials are not kept"
    return Mesh(mesh.name, frame.invert(vertices), faces, (*mesh.repairs, note))


def _edge_counts(faces: np.ndarray, vertex_count: int) -> np.ndarray:
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    return np.unique(edges[:, 0] * vertex_count + edges[:, 1], return_counts=True)[1]


def _unfit(points: np.ndarray, faces: np.ndarray) -> str | None:
    """Why the remesher, which trusts its input, must not be given this mesh."""
    if _edge_counts(faces, len(points)).max() > 2:
        return "it is not manifold (an edge has more than two faces)"
    if (face_areas(points, faces) < 1e-14).any():
        return "it has degenerate faces"
    # The faces around a vertex must be one fan.
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    corner = np.arange(faces.size).reshape(-1, 3)
    edge_corner = corner[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    ends = faces.ravel()[edge_corner]
    swap = ends[:, 0] > ends[:, 1]
    ends[swap], edge_corner[swap] = ends[swap][:, ::-1], edge_corner[swap][:, ::-1]
    key = ends[:, 0] * len(points) + ends[:, 1]
    order = np.argsort(key, kind="stable")
    pair = np.flatnonzero(key[order][1:] == key[order][:-1])
    a = edge_corner[order[pair]].ravel()
    b = edge_corner[order[pair + 1]].ravel()
    graph = coo_matrix((np.ones(len(a), dtype=bool), (a, b)), shape=(faces.size, faces.size))
    fans = connected_components(graph, directed=False)[0]
    if fans != len(np.unique(faces)):
        return "it is not manifold (a vertex joins several sheets)"
    return None


def _botsch(
    points: np.ndarray, faces: np.ndarray, target: int
) -> tuple[np.ndarray, np.ndarray, bool] | None:
    """Vertices, faces and whether creases were kept; None where the remesher fails."""
    import gpytoolbox

    def run(length: float, creases: bool) -> tuple[np.ndarray, np.ndarray]:
        vertices, new_faces = gpytoolbox.remesh_botsch(
            points,
            faces.astype(np.int32),
            5,
            length,
            True,
            detect_feature_edges=creases,
            feature_dihedral_threshold=60.0,
        )
        if len(new_faces) == 0 or not np.isfinite(vertices).all():
            raise ValueError("nothing left")
        return np.asarray(vertices, dtype=np.float64), np.asarray(new_faces, dtype=np.int64)

    # Even triangles of edge h: area sqrt(3)/4 h² each, half as many vertices as faces.
    length = float(np.sqrt(2.0 * face_areas(points, faces).sum() / (np.sqrt(3.0) * target)))
    try:
        best, result = length, run(length, False)
        for _ in range(3):
            ratio = len(result[0]) / target
            if 0.9 < ratio < 1.1:
                break
            # Edges from 4/5 to 4/3 of the length stay: near the input's own it reacts little.
            length *= ratio**0.75
            other = run(length, False)
            if abs(np.log(len(other[0]) / target)) < abs(np.log(ratio)):
                best, result = length, other
    except Exception:
        return None
    # Kept creases suit machined shapes; on organic ones they often cost slivers or many vertices.
    with contextlib.suppress(Exception):
        creased = run(best, True)
        areas = face_areas(*creased)
        even = areas.min() > 0.02 * areas.mean() and _unfit(*creased) is None
        if even and len(creased[0]) < 1.3 * target:
            return *creased, True
    return *result, False


def _subdivide(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each face into four at the middles of its edges; its children stay together."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    unique, inverse = np.unique(edges[:, 0] * len(vertices) + edges[:, 1], return_inverse=True)
    ends = np.stack([unique // len(vertices), unique % len(vertices)], axis=1)
    middle = len(vertices) + inverse.reshape(-1, 3)
    (a, b, c), (ab, bc, ca) = faces.T, middle.T
    children = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)
    return np.concatenate([vertices, vertices[ends].mean(axis=1)]), children


# ------------------------------------------------------------------------------------------ saving


def save_mesh(
    mesh: Mesh,
    vertices: Float[np.ndarray, "vertices 3"],
    path: str | os.PathLike[str],
    displacement: Float[np.ndarray, " vertices"] | None = None,
) -> None:
    """Write a mesh with its vertices moved, as PLY (binary), OBJ or GLB by ``path``'s extension.

    ``vertices`` replace `Mesh.vertices`, in the same frame. The file's own rows come back: texture
    coordinates with their seams, materials and images, colours, part names, winding. Normals are
    computed anew, with the input's hard edges: always for GLB, for OBJ if the input had some.

    - PLY: one object; a texture only if there is just one. ``displacement`` becomes the float
      vertex property ``displacement``, in whatever unit it is given.
    - OBJ: the faces' order with materials interleaved as they were. Materials and images are
      written beside it, named after it: ``out.obj``, ``out.mtl``, ``out_wood.png``.
    - GLB: from a glTF file all of it, with only positions and normals changed (tangents go, being
      derived). Otherwise a node for each part, its faces grouped by material.

    Every file is replaced in one step, so an interrupted run leaves no half of one. Raises
    `UserError` if the place cannot be written, the extension is unknown or values are not finite.
    """
    path = Path(path)
    vertices = np.asarray(vertices, dtype=np.float64)
    if vertices.shape != mesh.vertices.shape:
        raise ValueError(f"expected vertices of shape {mesh.vertices.shape}, got {vertices.shape}")
    if not np.isfinite(vertices).all():
        raise UserError(
            f"'{path}' was not written, the result has NaN or infinite vertices: the run diverged, "
            "lower the learning rate."
        )
    writer = _WRITERS.get(path.suffix.lower())
    if writer is None:
        raise UserError(f"'{path}' cannot be written: supported are {_list(WRITABLE)}.")
    carrier = mesh.carrier or Carrier(
        mesh.faces, np.arange(len(vertices)), np.zeros(len(mesh.faces), bool), parts=(mesh.name,)
    )
    try:
        files = writer(carrier, vertices, path, displacement)
    except _Problem as problem:
        raise UserError(f"'{path}' {problem}") from None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for (
            name,
            content,
        ) in files.items():  # the mesh itself comes last, when all it needs is there
            _write_atomically(path.with_name(name), content)
    except OSError as error:
        raise UserError(f"'{path}' cannot be written ({error.strerror or error}).") from None


def _write_atomically(path: Path, content: bytes) -> None:
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_bytes(content)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _row_normals(carrier: Carrier, vertices: np.ndarray) -> np.ndarray:
    """Unit normals (rows, 3), smooth across the corners that the file's normals call smooth."""
    groups = carrier.rows
    if carrier.normals is not None:
        rounded = np.round(np.nan_to_num(carrier.normals) * 50).astype(np.int64)
        key = np.column_stack([carrier.rows, rounded])
        _, groups = np.unique(key, axis=0, return_inverse=True)
        groups = groups.ravel()
    points = np.zeros((int(groups.max()) + 1, 3))
    points[groups] = vertices[carrier.rows]
    return _grouped_normals(
        vertices, carrier.rows[carrier.corners], groups[carrier.corners], points
    )[groups]


def _distinct(*columns: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Distinct combinations of rows: the first row of each, and each row's combination."""
    table = np.column_stack([column for column in columns if column is not None])
    _, first, inverse = np.unique(table, axis=0, return_index=True, return_inverse=True)
    return first, inverse.ravel()


def _side_names(carrier: Carrier, path: Path) -> dict[str, str]:
    """Names for the images beside ``path``, all beginning with its own."""
    names: dict[str, str] = {}
    for key in carrier.textures:
        wanted = f"{path.stem}_{_bare(key)}"
        while wanted in names.values():
            wanted = f"{Path(wanted).stem}_{Path(wanted).suffix}"
        names[key] = wanted
    return names


def _write_ply(
    carrier: Carrier, vertices: np.ndarray, path: Path, displacement: np.ndarray | None
) -> dict[str, bytes]:
    first, combined = _distinct(carrier.rows, carrier.uv, carrier.colors)
    vertex = carrier.rows[first]
    points = vertices[vertex]
    with np.errstate(over="ignore"):
        lost = np.abs(points.astype(np.float32) - points).max()
    exact = lost < 1e-6 * float(np.ptp(points, axis=0).max())
    kind, word = ("<f4", "float") if exact else ("<f8", "double")

    fields: list[tuple[str, str, str, np.ndarray]] = [
        (axis, kind, word, points[:, k]) for k, axis in enumerate("xyz")
    ]
    if carrier.uv is not None:
        fields += [(a, "<f4", "float", carrier.uv[first, k]) for k, a in enumerate("st")]
    if carrier.colors is not None:
        bytes_ = np.round(np.clip(carrier.colors[first], 0, 1) * 255)
        fields += [
            (name, "u1", "uchar", bytes_[:, k])
            for k, name in enumerate(("red", "green", "blue", "alpha"))
        ]
    if displacement is not None:
        if np.shape(displacement) != (len(vertices),):
            raise ValueError(
                f"expected {len(vertices)} displacements, not {np.shape(displacement)}"
            )
        fields.append(("displacement", "<f4", "float", np.asarray(displacement)[vertex]))
    rows = np.empty(len(first), dtype=[(name, kind) for name, kind, _, _ in fields])
    for name, _, _, values in fields:
        rows[name] = values
    faces = np.empty(len(carrier.corners), dtype=[("n", "u1"), ("v", "<i4", (3,))])
    faces["n"], faces["v"] = 3, combined[carrier.corners]

    files: dict[str, bytes] = {}
    header = ["ply", "format binary_little_endian 1.0", "comment written by styleexp"]
    used = {material.texture for material in carrier.materials if material.texture}
    if carrier.uv is not None and len(used) == 1:
        key = next(iter(used))
        name = _side_names(carrier, path)[key]
        files[name] = carrier.textures[key]
        header.append(f"comment TextureFile {name}")
    header.append(f"element vertex {len(rows)}")
    header += [f"property {word} {name}" for name, _, word, _ in fields]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    files[path.name] = ("\n".join(header) + "\n").encode() + rows.tobytes() + faces.tobytes()
    return files


def _write_obj(
    carrier: Carrier, vertices: np.ndarray, path: Path, displacement: np.ndarray | None
) -> dict[str, bytes]:
    files: dict[str, bytes] = {}
    out = ["# written by styleexp"]
    if carrier.materials:
        names = _side_names(carrier, path)
        files.update({names[key]: content for key, content in carrier.textures.items()})
        files[f"{path.stem}.mtl"] = _mtl_text(carrier, names).encode()
        out.append(f"mtllib {path.stem}.mtl")

    first, index = _distinct(carrier.rows, carrier.colors)
    table = vertices[carrier.rows[first]]
    if carrier.colors is not None:
        table = np.column_stack([table, carrier.colors[first, :3]])
    if carrier.colors is None:  # every vertex, in the mesh's order
        index, table = carrier.rows, vertices
    out += _lines("v", table, 12)
    words = [index + 1]
    if carrier.uv is not None:
        first, index = _distinct(carrier.uv)
        out += _lines("vt", carrier.uv[first], 9)
        words.append(index + 1)
    if carrier.normals is not None:
        normals = _row_normals(carrier, vertices)
        first, index = _distinct(normals)
        out += _lines("vn", normals[first], 7)
        words.append(index + 1)
    separator = "//" if carrier.uv is None else "/"
    corner = [separator.join(map(str, row)) for row in np.stack(words, axis=1).tolist()]

    n = len(carrier.corners)
    part = carrier.face_part if carrier.face_part is not None else np.zeros(n, dtype=np.int64)
    material = carrier.face_material if carrier.face_material is not None else np.full(n, -1)
    turns = np.flatnonzero((np.diff(part) != 0) | (np.diff(material) != 0)) + 1
    now_part = now_material = -1
    for run in np.split(np.arange(n), turns):
        if part[run[0]] != now_part:
            now_part = part[run[0]]
            out.append(f"o {carrier.parts[now_part]}")
        if material[run[0]] != now_material and material[run[0]] >= 0:
            now_material = material[run[0]]
            out.append(f"usemtl {carrier.materials[now_material].name}")
        for a, b, c in carrier.corners[run].tolist():
            out.append(f"f {corner[a]} {corner[b]} {corner[c]}")
    files[path.name] = ("\n".join(out) + "\n").encode()
    return files


def _lines(word: str, table: np.ndarray, digits: int) -> list[str]:
    pattern = " ".join([word, *[f"%.{digits}g"] * table.shape[1]])
    return [pattern % tuple(row) for row in table.tolist()]


def _mtl_text(carrier: Carrier, names: dict[str, str]) -> str:
    out = ["# written by styleexp"]
    for material in carrier.materials:
        for line in material.mtl:
            key = _map_name(line) if _is_map(line) else None
            out.append(line[: line.rindex(key)] + names[key] if key in names else line)
        if not material.mtl:
            red, green, blue, alpha = material.color
            out += [f"newmtl {material.name}", f"Kd {red:g} {green:g} {blue:g}", f"d {alpha:g}"]
            if material.texture:
                out.append(f"map_Kd {names[material.texture]}")
        out.append("")
    return "\n".join(out)


def _write_glb(
    carrier: Carrier, vertices: np.ndarray, path: Path, displacement: np.ndarray | None
) -> dict[str, bytes]:
    builder = _GlbBuilder()
    if carrier.gltf is not None:
        _patch_gltf(builder, carrier, carrier.gltf, vertices)
    else:
        _build_gltf(builder, carrier, vertices)
    return {path.name: builder.finish()}


class _GlbBuilder:
    """A glTF document and its one binary chunk, to which arrays and images are appended."""

    def __init__(self, document: dict[str, Any] | None = None) -> None:
        self.document: dict[str, Any] = document or {"asset": {"version": "2.0"}}
        self.document["asset"]["generator"] = "styleexp"
        self.binary = bytearray()

    def view(self, content: bytes, target: int | None = None) -> int:
        """Append bytes; the index of their new buffer view."""
        self.binary += b"\0" * (-len(self.binary) % 4)
        view = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(content)}
        if target:
            view["target"] = target
        self.binary += content
        views = self.document.setdefault("bufferViews", [])
        views.append(view)
        return len(views) - 1

    def accessor(self, values: np.ndarray, bounds: bool = False, normalized: bool = False) -> int:
        """Append an array, float32, uint8 (n, width) or uint32 (n,); the index of its accessor."""
        width = 1 if values.ndim == 1 else values.shape[1]
        name = next(k for k, v in _GLTF_SIZES.items() if v == width)
        code = next(k for k, v in _GLTF_TYPES.items() if v == values.dtype.str[1:])
        view = self.view(values.tobytes(), 34963 if values.ndim == 1 else 34962)
        accessor = {"bufferView": view, "componentType": code, "count": len(values), "type": name}
        if bounds:
            accessor["min"] = [float(x) for x in values.min(axis=0)]
            accessor["max"] = [float(x) for x in values.max(axis=0)]
        if normalized:
            accessor["normalized"] = True
        accessors = self.document.setdefault("accessors", [])
        accessors.append(accessor)
        return len(accessors) - 1

    def finish(self) -> bytes:
        """The file."""
        self.binary += b"\0" * (-len(self.binary) % 4)
        self.document["buffers"] = [{"byteLength": len(self.binary)}]
        text = json.dumps(self.document, ensure_ascii=False, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        total = 12 + 8 + len(text) + 8 + len(self.binary)
        head = struct.pack("<4sII", b"glTF", 2, total) + struct.pack("<I4s", len(text), b"JSON")
        return head + text + struct.pack("<I4s", len(self.binary), b"BIN\0") + bytes(self.binary)


def _single(values: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore"):
        result = values.astype("<f4")
    if not np.isfinite(result).all():
        raise _Problem("cannot hold such large coordinates: save as PLY or scale the mesh down.")
    return result


def _patch_gltf(
    builder: _GlbBuilder, carrier: Carrier, source: GltfSource, vertices: np.ndarray
) -> None:
    """The input's document with new positions and normals, everything else as it was."""
    document = copy.deepcopy(source.document)
    builder.document = document
    offsets, buffers = [], list(source.buffers)
    for content in buffers:
        builder.binary += b"\0" * (-len(builder.binary) % 4)
        offsets.append(len(builder.binary))
        builder.binary += content
    for view in document.get("bufferViews", ()):
        view["byteOffset"] = view.get("byteOffset", 0) + offsets[view["buffer"]]
        view["buffer"] = 0
    for image in document.get("images", ()):
        if (content := image.pop("styleexp_bytes", None)) is not None:
            jpeg = content[:2] == b"\xff\xd8"
            image.setdefault("mimeType", "image/jpeg" if jpeg else "image/png")
            del image["uri"]
            image["bufferView"] = builder.view(content)

    normals = _row_normals(carrier, vertices)
    used_by: dict[int, int] = {}
    own_mesh: dict[int, int] = {}
    for one in source.instances:
        # A mesh that several nodes show becomes one mesh for each: they now differ.
        if used_by.setdefault(one.mesh, one.node) != one.node and one.node not in own_mesh:
            document["meshes"].append(copy.deepcopy(source.document["meshes"][one.mesh]))
            own_mesh[one.node] = len(document["meshes"]) - 1
            document["nodes"][one.node]["mesh"] = own_mesh[one.node]
        mesh = document["meshes"][own_mesh.get(one.node, one.mesh)]
        attributes = mesh["primitives"][one.primitive]["attributes"]
        row = source.row_of[one.start : one.start + one.count]
        used = row >= 0
        local = _accessor(source.document, buffers, attributes["POSITION"])
        inverse = np.linalg.inv(one.matrix)
        moved = vertices[carrier.rows[row[used]]]
        local[used] = moved @ inverse[:3, :3].T + inverse[:3, 3]
        if "NORMAL" in attributes:
            turned = _accessor(source.document, buffers, attributes["NORMAL"])
            turned[used] = normals[row[used]] @ one.matrix[:3, :3]
            attributes["NORMAL"] = builder.accessor(_single(_unit_rows(turned)))
        attributes["POSITION"] = builder.accessor(_single(local), bounds=True)
        attributes.pop("TANGENT", None)


def _build_gltf(builder: _GlbBuilder, carrier: Carrier, vertices: np.ndarray) -> None:
    """A new document: a node for each part, a primitive for each of its materials."""
    document = builder.document
    document.update(scene=0, scenes=[{"nodes": []}], nodes=[], meshes=[])
    images: dict[str, int] = {}
    for material in carrier.materials:
        white = (1.0, 1.0, 1.0, material.color[3])  # glTF multiplies the two, MTL viewers do not
        surface: dict[str, Any] = {
            "baseColorFactor": list(white if material.texture else material.color),
            "metallicFactor": 0.0,
            "roughnessFactor": 1.0,
        }
        if material.texture is not None:
            if material.texture not in images:
                content, mime = _web_image(carrier.textures[material.texture], material.texture)
                name = _bare(material.texture)
                described = {"bufferView": builder.view(content), "mimeType": mime, "name": name}
                document.setdefault("images", []).append(described)
                images[material.texture] = len(document["images"]) - 1
                document.setdefault("textures", []).append({"source": images[material.texture]})
            surface["baseColorTexture"] = {"index": images[material.texture]}
        entry: dict[str, Any] = {"name": material.name, "pbrMetallicRoughness": surface}
        if material.color[3] < 1.0:
            entry["alphaMode"] = "BLEND"
        document.setdefault("materials", []).append(entry)

    n = len(carrier.corners)
    normals = _row_normals(carrier, vertices)
    part = carrier.face_part if carrier.face_part is not None else np.zeros(n, dtype=np.int64)
    material_of = carrier.face_material if carrier.face_material is not None else np.full(n, -1)
    for p, name in enumerate(carrier.parts):
        primitives = []
        for chosen in np.unique(material_of[part == p]):
            corners = carrier.corners[(part == p) & (material_of == chosen)]
            rows, index = np.unique(corners, return_inverse=True)
            attributes = {
                "POSITION": builder.accessor(_single(vertices[carrier.rows[rows]]), bounds=True),
                "NORMAL": builder.accessor(_single(normals[rows])),
            }
            if carrier.uv is not None:
                uv = carrier.uv[rows] * np.array([1.0, -1.0]) + np.array([0.0, 1.0])
                attributes["TEXCOORD_0"] = builder.accessor(_single(uv))
            if carrier.colors is not None:
                bytes_ = np.round(np.clip(carrier.colors[rows], 0, 1) * 255).astype("u1")
                attributes["COLOR_0"] = builder.accessor(bytes_, normalized=True)
            primitive = {
                "attributes": attributes,
                "indices": builder.accessor(index.ravel().astype("<u4")),
            }
            if chosen >= 0:
                primitive["material"] = int(chosen)
            primitives.append(primitive)
        if primitives:
            document["meshes"].append({"name": name, "primitives": primitives})
            document["nodes"].append({"name": name, "mesh": len(document["meshes"]) - 1})
            document["scenes"][0]["nodes"].append(len(document["nodes"]) - 1)


def _web_image(content: bytes, name: str) -> tuple[bytes, str]:
    """An image as glTF may hold it, PNG or JPEG, unchanged if it is one already."""
    if content[:2] == b"\xff\xd8":
        return content, "image/jpeg"
    if content[:4] == b"\x89PNG":
        return content, "image/png"
    from PIL import Image

    try:
        image = Image.open(io.BytesIO(content))
        out = io.BytesIO()
        image.convert("RGBA" if "A" in image.getbands() else "RGB").save(out, "PNG")
    except Exception:
        raise _Problem(
            f"cannot hold the texture '{name}', which is no known image: save as OBJ."
        ) from None
    return out.getvalue(), "image/png"


_WRITERS: dict[str, Callable[[Carrier, np.ndarray, Path, np.ndarray | None], dict[str, bytes]]] = {
    ".ply": _write_ply,
    ".obj": _write_obj,
    ".glb": _write_glb,
}
