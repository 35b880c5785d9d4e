"""The mesh classes, and basic quantities."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int, UInt8


@dataclass(frozen=True)
class Carrier:
    """Everything in a mesh file besides positions, in the file's own rows.

    A row is one combination of position, uv, normal and colour; rows on a seam share a vertex.
    """

    corners: Int[np.ndarray, "faces 3"]
    """Rows of each face, with the file's winding."""
    rows: Int[np.ndarray, " rows"]
    """Welded vertex of each row."""
    flipped: Bool[np.ndarray, " faces"]
    """Faces whose winding is reversed in `Mesh.faces`."""
    precision: float = 0.0
    """Distance between positions that rounding alone can cause, in the file's units."""
    uv: Float[np.ndarray, "rows 2"] | None = None
    """Texture coordinates; v points up, as in OBJ and PLY (glTF's points down)."""
    normals: Float[np.ndarray, "rows 3"] | None = None
    """Normals of a glTF or PLY file. They only determine which corners are smooth together."""
    colors: UInt8[np.ndarray, "rows 4"] | None = None
    parts: tuple[str, ...] = ("mesh",)
    face_part: Int[np.ndarray, " faces"] | None = None
    materials: tuple[Any, ...] = ()
    """trimesh ``PBRMaterial`` objects, with names."""
    face_material: Int[np.ndarray, " faces"] | None = None
    """Index of each face's material; -1 for none."""
    mtl: str = ""
    """Text of an OBJ file's material library, so that saving as OBJ keeps all its lines."""
    labels: dict[str, tuple[tuple[str, ...], np.ndarray]] = field(default_factory=dict)
    """Contents of an OBJ file's ``g`` and ``s`` lines: the texts, and each face's index into them,
    -1 before the first."""
    objects: bool = True
    """Whether an OBJ file has ``o`` lines; otherwise its groups are its parts."""
    shades: Float[np.ndarray, "rows 3"] | None = None
    """An OBJ file's vertex colours as stored; NaN for vertices without."""
    textures: dict[str, bytes] = field(default_factory=dict)
    """Image files, keyed by their names in ``mtl``."""
    face_colors: UInt8[np.ndarray, "faces 4"] | None = None
    attributes: dict[str, Float[np.ndarray, "rows width"]] = field(default_factory=dict)
    """Custom vertex attributes: a PLY's properties, or a glTF's ``_NAME`` (stored without the
    ``_``, with vectors rotated by the node's transform)."""
    ply: Any = None
    """A PLY file's `styleexp.inputs.meshes.ply_meshes.Table`."""
    document: Any = None
    """A glTF file's `styleexp.inputs.meshes.gltf.Document`."""


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh for optimisation, with everything needed to save it in its original form."""

    name: str
    vertices: Float[np.ndarray, "vertices 3"]
    """float64, one vertex per position, in the input's own frame and scale."""
    faces: Int[np.ndarray, "faces 3"]
    """int64, in the file's order, counter-clockwise seen from outside."""
    repairs: tuple[str, ...] = ()
    """One sentence for each repair or omission."""
    carrier: Carrier | None = None


def at_vertices(
    mesh: Mesh, column: Float[np.ndarray, "rows width"]
) -> Float[np.ndarray, "vertices width"]:
    """Average per-row values of a mesh's carrier at each vertex."""
    rows = np.arange(len(mesh.vertices)) if mesh.carrier is None else mesh.carrier.rows
    sums = [np.bincount(rows, each, minlength=len(mesh.vertices)) for each in column.T]
    counts = np.bincount(rows, minlength=len(mesh.vertices)).clip(min=1)
    return np.stack(sums, axis=1) / counts[:, None]


@dataclass(frozen=True)
class Normalisation:
    """Similarity transform to the unit sphere: ``apply(v) = (v - center) / scale`` (Sec. 4.1)."""

    center: Float[np.ndarray, " 3"]
    scale: float
    """Maximum distance of a vertex from the centre, in the input's units."""

    def apply(self, vertices: Float[np.ndarray, "vertices 3"]) -> Float[np.ndarray, "vertices 3"]:
        """Map from the input's frame to the unit sphere."""
        return (vertices - self.center) / self.scale

    def invert(self, vertices: Float[np.ndarray, "vertices 3"]) -> Float[np.ndarray, "vertices 3"]:
        """Map from the unit sphere to the input's frame."""
        return vertices * self.scale + self.center


def normalisation(vertices: Float[np.ndarray, "vertices 3"]) -> Normalisation:
    """Centre at the vertex mean and scale the farthest vertex to distance 1 (Sec. 4.1)."""
    vertices = np.asarray(vertices, dtype=np.float64)
    center = vertices.mean(axis=0)
    scale = float(np.linalg.norm(vertices - center, axis=1).max())
    if not np.isfinite(scale) or scale <= 0.0:
        raise UserError("the mesh has no extent or non-finite vertices: it cannot be normalised.")
    return Normalisation(center, scale)


def face_areas(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Float[np.ndarray, " faces"]:
    """Area of each face, in squared units of ``vertices``."""
    return 0.5 * np.linalg.norm(_crosses(vertices, faces), axis=1)


def vertex_normals(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    groups: Int[np.ndarray, "faces 3"] | None = None,
) -> Float[np.ndarray, "vertices 3"]:
    """Unit vertex normals, area-weighted.

    Zero-area faces contribute nothing. A vertex whose normal cancels out, or without faces, gets
    the direction from the vertices' mean to itself, so that every normal is finite and has length
    1.

    ``groups`` are the smoothing groups of corners, so that a vertex at a hard edge has several
    normals; the result then has one row per group.
    """
    vertices = points = np.asarray(vertices, dtype=np.float64)
    if groups is None:
        groups = faces
    else:
        points = np.zeros((int(groups.max()) + 1, 3))
        points[groups] = vertices[faces]
    extent = float(np.ptp(vertices, axis=0).max()) or 1.0
    # Scale to unit extent, so that squared coordinates neither underflow nor overflow.
    crosses = np.repeat(_crosses(vertices / extent, faces), 3, axis=0)
    sums = [np.bincount(groups.ravel(), crosses[:, k], minlength=len(points)) for k in range(3)]
    normals = np.stack(sums, axis=1)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    lost = length[:, 0] < 1e-18
    if lost.any():
        outward = points[lost] - vertices.mean(axis=0)
        reach = np.linalg.norm(outward, axis=1, keepdims=True)
        up = np.array([0.0, 1.0, 0.0])
        normals[lost] = np.where(reach > 1e-12 * extent, outward / np.maximum(reach, 1e-300), up)
        length[lost] = 1.0
    return normals / length


def edges_of(faces: Int[np.ndarray, "faces 3"]) -> Int[np.ndarray, "edges 2"]:
    """The edges, each once, its lower vertex first, in ascending order."""
    count = int(faces.max(initial=-1)) + 1
    after = np.roll(faces, -1, axis=1)
    keys = np.minimum(faces, after).astype(np.int64) * count + np.maximum(faces, after)
    keys = np.sort(keys, axis=None)  # quicker than np.unique, which hashes first
    keys = keys[np.diff(keys, prepend=-1) > 0]
    return np.stack(np.divmod(keys, max(count, 1)), axis=1)


def mean_edge_length(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> float:
    """Mean length of the edges, each counted once."""
    a, b = edges_of(faces).T
    return float(np.linalg.norm(vertices[a] - vertices[b], axis=1).mean())


def _crosses(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)
