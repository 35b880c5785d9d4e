"""Bake a run's result into textures: of its own source, or of another mesh, such as the low-poly
mesh that it was refined from.

The height map holds the displacement along the mesh's smooth vertex normals. The normal map holds
the result's smooth normals in the tangent space of the mesh, in the convention of OpenGL, glTF and
Blender: red along u, green along v (up in the image), blue along the normal, each n / 2 + 1/2.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np

from styleexp.inputs.meshes import vertex_normals
from styleexp.runs.bake import texels
from styleexp.runs.bake.detail import MISSING as MISSING
from styleexp.runs.bake.detail import Detail, ahead
from styleexp.runs.bake.files import write as write
from styleexp.runs.bake.glb import glb as glb
from styleexp.runs.bake.low import Low as Low
from styleexp.runs.bake.low import coordinates as coordinates
from styleexp.runs.bake.low import has_coordinates as has_coordinates
from styleexp.runs.bake.low import low as low
from styleexp.runs.bake.low import unwrapped as unwrapped
from styleexp.runs.bake.tangents import in_frame, unit
from styleexp.runs.bake.texels import Texels
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

    from styleexp.inputs.meshes import Mesh

    Place = Callable[[Texels], tuple[np.ndarray, np.ndarray, np.ndarray]]
    """Height, face of the detailed surface (-1 for none) and barycentric coordinates in it."""

INSIDE = 1e-3
"""Barycentric distance to an edge below which a texel doesn't count as overlap."""
APART = 0.05
"""Median distance, in diagonals of the result, above which a mesh is not where the result is.
Reliefs reach 0.01."""
LOST = 1e-3
"""Fraction of texels without a value of their own that is worth a note."""
ROOM = 1.5
"""The cage's distance, in greatest distances of the result from the mesh."""
CAGES = (0.001, 0.1)
"""Least and greatest cage that is chosen so, in diagonals of the result."""


@dataclass(frozen=True)
class Maps:
    """Baked maps of shape (size, size), float32, first row at v = 1. Outside the islands, and where
    nothing was met, they have the value of the nearest texel that has one."""

    height: Float[np.ndarray, "size size"]
    """Displacement in the mesh's own units."""
    normal: Float[np.ndarray, "size size 3"]
    """Unit normals in the mesh's tangent space."""
    covered: Bool[np.ndarray, "size size"]
    """Texels whose centre a face covers and that have a value of their own."""
    overlap: float
    """Fraction of covered texels with several faces: mirrored or stacked islands."""
    occlusion: Float[np.ndarray, "size size"] | None = None
    """1 where the result is open, 0 where it is hidden."""
    curvature: Float[np.ndarray, "size size"] | None = None
    """Mean curvature of the result, in 1 / the mesh's own unit; convex is positive."""
    told: dict[str, Any] = field(default_factory=dict)
    """What ``bake.json`` says of the way it was baked."""


def bake(
    source: Mesh,
    displacement: Float[np.ndarray, " vertices"],
    vertices: Float[np.ndarray, "vertices 3"],
    size: int,
) -> Maps:
    """Bake ``displacement`` and the normals of ``vertices``, the result's, into the texture
    coordinates of the source, whose faces the result has.

    Raises `UserError` for a source without texture coordinates.
    """
    given = displacement[:, None].astype(np.float32)

    def same(each: Texels) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        height = _mix(given, source.faces[each.face], each.weights)[:, 0]
        return height, each.face, each.weights

    normals = vertex_normals(vertices, source.faces)
    drawn, covered, overlap, _ = _drawn(low(source), source.faces, normals, same, size)
    return Maps(drawn[..., 0], drawn[..., 1:4], covered, overlap)


def baked(
    mesh: Mesh, detail: Mesh, size: int, distance: float | None = None, unwrap: bool = False
) -> tuple[Low, Maps, list[str]]:
    """Bake a detailed surface onto a mesh in the same place, see `bake_onto`. ``distance`` is the
    cage's (None: see `cage`). ``unwrap`` makes new texture coordinates, as a mesh without gets in
    any case. Returns the mesh that was baked to, its maps, and notes for the user.

    Raises `UserError` if the mesh is somewhere else, or Embree or xatlas is missing.
    """
    check_rays()
    room, notes = cage(mesh, detail.vertices, detail.faces), []
    if unwrap or not has_coordinates(mesh):
        if not unwrap:
            notes.append(
                f"'{mesh.name}' has no texture coordinates: unwrapped it, see result_low.glb."
            )
        elif mesh.carrier and any(m.baseColorTexture is not None for m in mesh.carrier.materials):
            notes.append("left out the textures, which belong to the replaced texture coordinates.")
        mesh = unwrapped(mesh)
    target = low(mesh)
    room = room if distance is None else distance
    maps = bake_onto(target, detail.vertices, detail.faces, size, room)
    if (lost := maps.told["filled_from_neighbours"]) > LOST:
        notes.append(
            f"{lost:.1%} of the texels have nothing of the result within {room:.3g} "
            "and were filled from their neighbours (--cage changes the distance)."
        )
    return target, maps, notes


def check_rays() -> None:
    """Raise `UserError` if Embree is missing."""
    if find_spec("embreex") is None:
        raise UserError(MISSING)


def warnings(mesh: Mesh, maps: Maps) -> list[str]:
    """What is wrong with a mesh's texture coordinates or winding, for the user."""
    found = []
    if maps.overlap > 0.01:
        found.append(
            f"{maps.overlap:.0%} of the texture is shared by several faces (mirrored, "
            "stacked or tiled islands) and keeps only the last face's relief. Unwrap without "
            "overlaps to keep all."
        )
    if mesh.carrier is not None and mesh.carrier.flipped.any():
        found.append(
            "faces of the source's file point inwards, but the maps assume outward "
            "normals (in Blender: Mesh > Normals > Recalculate Outside)."
        )
    return found


def cage(
    mesh: Mesh,
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
) -> float:
    """How far from a mesh to look for a detailed surface, in the mesh's units.

    Raises `UserError` if the mesh is somewhere else, or beyond single precision.
    """
    low, detail = Detail(mesh.vertices, mesh.faces), Detail(vertices, faces)
    if not 1e-30 < min(low.extent, detail.extent) <= max(low.extent, detail.extent) < 1e30:
        raise UserError(
            f"'{mesh.name}' is {low.extent:.3g} large, which maps can't hold: scale the mesh."
        )
    diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    probes = np.concatenate([mesh.vertices, mesh.vertices[mesh.faces].mean(axis=1)])
    apart = float(np.median(detail.distances(detail.own(probes)))) * detail.extent
    if apart > APART * diagonal:
        places = []
        for each in (low, detail):
            x, y, z = each.middle
            places.append(f"{each.extent:.4g} large at ({x:.4g}, {y:.4g}, {z:.4g})")
        raise UserError(
            f"'{mesh.name}' is not where the result is: half of it is more than {apart:.3g} away "
            f"({places[0]}, the result {places[1]}): give a mesh in the same place and units."
        )
    least, most = (each * diagonal for each in CAGES)
    return float(np.clip(ROOM * low.distances(low.own(vertices)).max() * low.extent, least, most))


def bake_onto(
    target: Low,
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    size: int,
    cage: float,
) -> Maps:
    """Bake a detailed surface, ``vertices`` and ``faces``, into the texture coordinates of another
    mesh, `low` of it, in the same place.

    From every texel's point on the mesh a ray goes along its smooth normal, outwards and inwards,
    up to the distance ``cage``, in the mesh's units, to the surface that faces the same way. Where
    none does, the nearest point of the surface within that distance counts.

    Raises `UserError` if Embree is missing.
    """
    mesh, detail = target.mesh, Detail(vertices, faces)
    reach = cage / detail.extent
    columns = np.column_stack([detail.normals, detail.occlusion(), detail.curvature()])
    ends = np.column_stack([detail.own(mesh.vertices), target.smooth]).astype(np.float32)
    nearest: list[int] = []

    def met(each: Texels) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        base = _mix(ends, mesh.faces[each.face], each.weights)
        points, along = base[:, :3], unit(base[:, 3:])
        height, face, weights = detail.along(points, along, reach)
        lost = np.flatnonzero(face < 0)
        if len(lost):
            near = detail.nearest(points[lost], along[lost], reach)
            height[lost], face[lost], weights[lost] = near
            nearest.append(int((near[1] >= 0).sum()))
        return height * np.float32(detail.extent), face, weights

    drawn, covered, overlap, missed = _drawn(target, faces, columns, met, size)
    told = {
        "cage": cage,
        "normals": "the file's own" if target.own else "smooth",
        "nearest_instead_of_ray": sum(nearest) / max(1, missed + int(covered.sum())),
        "filled_from_neighbours": missed / max(1, missed + int(covered.sum())),
    }
    maps = (drawn[..., 0], drawn[..., 1:4], covered, overlap, drawn[..., 4], drawn[..., 5])
    return Maps(*maps, told)


def _drawn(
    target: Low,
    faces: Int[np.ndarray, "faces 3"],
    columns: Float[np.ndarray, "vertices width"],
    place: Place,
    size: int,
) -> tuple[Float[np.ndarray, "size size channels"], Bool[np.ndarray, "size size"], float, int]:
    """Draw the height, the normal (3) and further values that a detailed surface has where
    ``place`` finds it; also return which texels have values of their own, the fraction covered
    several times, and the number where nothing was found.

    ``columns`` are the normal (3) and the further values at the vertices of ``faces``.
    """
    columns = columns.astype(np.float32)
    frames = np.concatenate([target.normals, target.tangents], axis=2).reshape(-1, 6)
    frames, sign = frames.astype(np.float32), target.sign.astype(np.float32)

    def values(each: Texels) -> tuple[Texels, np.ndarray, np.ndarray]:
        height, face, weights = place(each)
        found = _mix(columns, faces[face], weights)
        corner = 3 * each.face[:, None] + np.arange(3)
        frame = _mix(frames, corner, each.weights)
        normal = in_frame(unit(found[:, :3]), frame[:, 3:], frame[:, :3], sign[each.face])
        return each, face >= 0, np.column_stack([height, normal, found[:, 3:]])

    drawn = np.zeros((size * size, 1 + columns.shape[1]), np.float32)
    known, taken = np.zeros(size * size, bool), np.zeros(size * size, np.uint16)
    seen = np.zeros(size * size, bool)
    for each, hit, value in ahead(values, texels.covered(target.uv, size)):
        drawn[each.at[hit]] = value[hit]
        known[each.at[hit]] = True
        seen[each.at] = True
        deep = each.weights.min(axis=1) > INSIDE
        np.add.at(taken, each.at[deep], 1)
    if not known.any():
        reason = "its texture coordinates have no area; unwrap it again."
        if seen.any():
            reason = "none of its surface lies within reach of the result; give a larger --cage."
        raise UserError(
            f"no pixel of {size} x {size} lies on a face of '{target.mesh.name}': {reason}"
        )
    overlap = float((taken > 1).sum() / max(1, (taken > 0).sum()))
    missed = int((seen & ~known).sum())
    picture, covered = drawn.reshape(size, size, -1), known.reshape(size, size)
    texels.fill(covered, picture)
    return picture, covered, overlap, missed


def _mix(
    values: Float[np.ndarray, "rows width"],
    of: Int[np.ndarray, "n 3"],
    weights: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "n width"]:
    """Values (rows, width) interpolated between three rows each."""
    mixed = weights[:, :1] * values[of[:, 0]]
    mixed += weights[:, 1:2] * values[of[:, 1]]
    mixed += weights[:, 2:] * values[of[:, 2]]
    return mixed
