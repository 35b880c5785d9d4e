"""Simplify a moved mesh, preserving its texture seams, materials, parts and attributes."""

from __future__ import annotations

import ctypes
from dataclasses import replace
from importlib.util import find_spec
from typing import TYPE_CHECKING

import numpy as np

from styleexp.inputs.meshes.flipping import groups
from styleexp.inputs.meshes.mesh import Carrier, Mesh
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

MISSING = "simplifying needs meshoptimizer: pip install 'styleexp[simplify]'."
TEXTURE = 0.5
"""Weight of a shift of the texture, in units of its side, against one of the surface, in units of
the mesh's largest extent."""
ABSOLUTE = 1 << 2
"""``meshopt_SimplifyErrorAbsolute``: errors aren't relative to the mesh's extent."""


def check() -> None:
    """Raise `UserError` if meshoptimizer is missing."""
    if find_spec("meshoptimizer") is None:
        raise UserError(MISSING)


def simplified(
    mesh: Mesh,
    vertices: Float[np.ndarray, "vertices 3"],
    faces: int,
    error: float,
) -> tuple[Mesh, Int[np.ndarray, " fewer"], float]:
    """Collapse edges of a mesh moved to ``vertices`` down to about ``faces`` faces, but for those
    that would move the surface by more than about ``error``, in the mesh's units.

    The vertices left over are some of the given ones, at their places, so that everything in the
    input's rows stays as it is; seams of texture coordinates and borders of materials and parts
    keep their course. Returns the simplified mesh, whose positions are still the unmoved ones, the
    indices of its vertices among the given ones, and the largest estimated distance, in the mesh's
    units. Edges are collapsed in the order of their quadric error (Garland and Heckbert 1997), by
    meshoptimizer; data of a PLY or glTF file that is tied to its own faces is dropped.

    Raises `UserError` if meshoptimizer is missing.
    """
    check()
    import meshoptimizer

    carrier = mesh.carrier or Carrier(
        mesh.faces, np.arange(len(vertices)), np.zeros(len(mesh.faces), bool), parts=(mesh.name,)
    )
    row, corners, first = _apart(carrier)
    outward = np.where(carrier.flipped[:, None], corners[:, ::-1], corners)
    extent = float(np.ptp(vertices, axis=0).max()) or 1.0
    places = (vertices - vertices.min(axis=0)) / extent
    indices = np.ascontiguousarray(outward, np.uint32).ravel()
    moved_by = np.zeros(1, np.float32)
    points = np.ascontiguousarray(places[carrier.rows[row]], np.float32)
    found = np.zeros_like(indices)
    given = (found, indices, points)
    options = {
        "target_index_count": 3 * faces,
        "options": ABSOLUTE,
        "result_error": moved_by,
    }
    if carrier.uv is None:
        count = meshoptimizer.simplify(*given, target_error=error / extent, **options)
    else:
        # The package leaves the types of this function's arguments to ctypes, which would take a
        # number for a C int.
        size = ctypes.c_size_t
        count = meshoptimizer.simplify_with_attributes(
            *given,
            np.ascontiguousarray(carrier.uv[row], np.float32),
            np.full(2, TEXTURE, np.float32),
            index_count=size(len(indices)),
            vertex_count=size(len(points)),
            vertex_positions_stride=size(12),
            vertex_attributes_stride=size(8),
            attribute_count=size(2),
            target_error=ctypes.c_float(error / extent),
            **options | {"target_index_count": size(3 * faces)},
        )
    left = found[:count].reshape(-1, 3).astype(np.int64)
    if not _doubled(mesh.faces).any():  # else it is a sheet with two sides
        left = left[~_doubled(carrier.rows[row[left]])]
    like = first[left[:, 0]]
    left = np.where(carrier.flipped[like][:, None], left[:, ::-1], left)
    kept_rows, corners = np.unique(left, return_inverse=True)
    of = row[kept_rows]
    kept, rows = np.unique(carrier.rows[of], return_inverse=True)
    small = _chosen(carrier, corners.reshape(-1, 3), rows, of, like)
    positions = small.rows[small.corners]
    positions = np.where(small.flipped[:, None], positions[:, ::-1], positions)
    result = Mesh(
        mesh.name, mesh.vertices[kept], np.ascontiguousarray(positions), mesh.repairs, small
    )
    return result, kept, float(moved_by[0]) * extent


def _doubled(faces: Int[np.ndarray, "faces 3"]) -> Bool[np.ndarray, " faces"]:
    """Faces of the same three vertices as another: the two sides of a flap, into which a collapse
    may fold the surface. Without both the surface is closed again."""
    _, of, count = np.unique(
        np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    return count[of.ravel()] > 1


def _apart(
    carrier: Carrier,
) -> tuple[Int[np.ndarray, " more"], Int[np.ndarray, "faces 3"], Int[np.ndarray, " more"]]:
    """Rows, corners and the first face of each row, where rows of faces of another material, part,
    group, colour or winding are others, so that a face's rows tell all of these."""
    group = groups(carrier)
    keys = carrier.corners * (int(group.max()) + 1) + group[:, None]
    _, first, corners = np.unique(keys, return_index=True, return_inverse=True)
    return carrier.corners.ravel()[first], corners.reshape(-1, 3), first // 3


def _chosen(
    carrier: Carrier,
    corners: Int[np.ndarray, "faces 3"],
    rows: Int[np.ndarray, " rows"],
    of: Int[np.ndarray, " rows"],
    like: Int[np.ndarray, " faces"],
) -> Carrier:
    """A carrier of these rows and of faces ``like`` the given ones."""

    def row(column: np.ndarray | None) -> np.ndarray | None:
        return None if column is None else column[of]

    def face(column: np.ndarray | None) -> np.ndarray | None:
        return None if column is None else column[like]

    return replace(
        carrier,
        corners=corners,
        rows=rows,
        flipped=carrier.flipped[like],
        uv=row(carrier.uv),
        normals=row(carrier.normals),
        colors=row(carrier.colors),
        shades=row(carrier.shades),
        attributes={name: each[of] for name, each in carrier.attributes.items()},
        face_part=face(carrier.face_part),
        face_material=face(carrier.face_material),
        face_colors=face(carrier.face_colors),
        labels={word: (texts, index[like]) for word, (texts, index) in carrier.labels.items()},
        ply=None,
        document=None,
    )
