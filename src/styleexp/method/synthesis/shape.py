"""Decompose a style mesh into a smooth shape and a relief."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import (
    binary_fill_holes,
    distance_transform_edt,
    gaussian_filter,
    map_coordinates,
)
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from styleexp.inputs import measured, meshes
from styleexp.method.relief import heat_smoother, smoother
from styleexp.method.synthesis.exemplar import MeshExemplar
from styleexp.method.synthesis.walk import Sheet
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jaxtyping import Float, Int

LENGTHS = (0.5, 0.25, 0.125, 0.0625)
"""Candidate lengths, in radii, below which features are relief when smoothing along the surface.
The longest that separates shape and relief is used, see `_along_itself`. The last is never tried
itself."""
SMOOTH = 0.35
"""Minimum ratio of heights above a surface smoothed half as far to those above the fully smoothed
one. It is 1 for a relief finer than both, and 1/4 for a shape that only bends. Below this there is
no relief."""
FLAT = 1e-4
"""Standard deviation of heights, in radii, below which there is no relief."""
BLUR = 0.24
"""Blur of the grid that separates shape and relief, as a fraction of the length."""
CELLS = 112
"""Grid cells along the longest side."""
REACHES = (0.0, 0.15, 0.3, 0.6)
"""Candidate radii for closing gaps of up to twice that width; the smallest that leaves few handles
is used."""
MOST_HANDLES = 2
"""Number of handles above which a mesh is a lattice, whose struts can't be flattened by smoothing
along the surface."""
COARSE = 0.04
"""Mean edge length, in radii, above which the whole style is refined, because patches are taken at
vertices; in other styles, only edges longer than two and a half times this are."""
USUAL = (0.25, 2.0)
"""Range of the mean square slope around a vertex that counts as the pattern, relative to the upper
quartile: below it is a flat base or a bare face, above it a rim or an ear."""


def exemplar_of(mesh: meshes.Mesh, length: float | None = None) -> MeshExemplar | None:
    """The relief of a style mesh, or None. ``length``, in radii, separates relief and shape
    (``style.relief_length``); None: estimated.

    A single surface with few handles is smoothed along itself. With many components, inner faces or
    struts, the outer surface is extracted on a grid.
    """
    given = {"vertices": mesh.vertices, "faces": mesh.faces}
    found = measured.kept("relief", given, str(length), lambda: _arrays(_parted(mesh, length)))
    if not found:
        return None
    sheet = Sheet(found["vertices"], found["faces"], found["normals"])
    return MeshExemplar(sheet, found["height"], found["usual"])


def _parted(mesh: meshes.Mesh, length: float | None) -> MeshExemplar | None:
    unit = meshes.normalisation(mesh.vertices).apply(mesh.vertices)
    mesh = _seen(meshes.Mesh(mesh.name, unit, mesh.faces))
    if len(_parts(mesh)) == 1 and _handles(mesh.faces) <= MOST_HANDLES:
        return _along_itself(mesh, length)
    return _outside(mesh, length or LENGTHS[0])


def _arrays(exemplar: MeshExemplar | None) -> measured.Arrays:
    """An exemplar's arrays, to be kept; none without relief."""
    if exemplar is None:
        return {}
    return {name: each for name, each in exemplar.arrays().items() if name != "extent"}


def _along_itself(mesh: meshes.Mesh, length: float | None) -> MeshExemplar | None:
    """Smooth the surface by one implicit step of heat flow, and measure the height above it.

    Chooses the length at which the heights change least when it is halved: a relief's energy has a
    plateau there, whereas a bend's grows with the square.
    """
    coarse = meshes.mean_edge_length(mesh.vertices, mesh.faces) > COARSE
    mesh = meshes.refine(mesh, COARSE if coarse else 2.5 * COARSE)
    lengths = LENGTHS if length is None else (length, length / 2)
    parted = _smoothed(mesh, lengths)
    energy = np.array([np.average(h**2, weights=sheet.areas) ** 0.5 for sheet, h in parted])
    kept = energy[1:] / energy[:-1].clip(min=1e-12)
    best = int(kept.argmax())
    if energy[best] < FLAT or (length is None and kept[best] < SMOOTH):
        return None
    return _exemplar(*parted[best], lengths[best])


def _smoothed(
    mesh: meshes.Mesh, lengths: Sequence[float]
) -> list[tuple[Sheet, Float[np.ndarray, " vertices"]]]:
    """The surface smoothed by each length, and the heights above it. The Laplacian is cotangent,
    not the graph Laplacian, so that a non-uniform mesh of a smooth ball has no relief."""
    vertices = mesh.vertices
    parted = []
    for length in lengths:
        base = heat_smoother(vertices, mesh.faces, length)(vertices)
        normals = meshes.vertex_normals(base, mesh.faces)
        height = ((vertices - base) * normals).sum(axis=1)
        # Smoothing also moves vertices sideways, off steep walls; the height must stay below its
        # vertex.
        base = vertices - height[:, None] * normals
        parted.append((Sheet(base, mesh.faces, normals), height - height.mean()))
    return parted


def _exemplar(sheet: Sheet, height: Float[np.ndarray, " vertices"], length: float) -> MeshExemplar:
    """Make an exemplar, with the vertices of usual relief marked."""
    # As wide as a panel between struts, which belongs to the pattern.
    around = smoother(sheet.vertices, sheet.faces, 0.7 * length)
    energy = around(_steepness(sheet, height))
    order = energy.argsort()
    share = sheet.areas[order].cumsum()
    high = energy[order[np.searchsorted(share, 0.75 * share[-1])]]
    usual = (energy > USUAL[0] * high) & (energy < USUAL[1] * high)
    return MeshExemplar(sheet, height - np.average(height, weights=sheet.areas * usual), usual)


def _steepness(
    sheet: Sheet, height: Float[np.ndarray, " vertices"]
) -> Float[np.ndarray, " vertices"]:
    """Mean square slope of the faces around each vertex, from the surface's own normals."""
    raised = sheet.vertices + height[:, None] * sheet.normals
    normals = meshes.vertex_normals(raised, sheet.faces)
    return ((normals - sheet.normals) ** 2).sum(axis=1)


def _parts(mesh: meshes.Mesh) -> list[np.ndarray]:
    """Faces of each connected component, largest first, without those with less than a thousandth
    of the faces."""
    count = len(mesh.vertices)
    a, b = mesh.faces[:, :2].T, mesh.faces[:, 1:].T
    rows, columns = np.concatenate([a[0], b[0]]), np.concatenate([a[1], b[1]])
    graph = coo_matrix((np.ones(len(rows)), (rows, columns)), (count, count))
    label = connected_components(graph, directed=False)[1][mesh.faces[:, 0]]
    order = label.argsort(kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(label[order])) + 1)
    parts = [part for part in parts if len(part) > len(mesh.faces) / 1000]

    def extent(part: np.ndarray) -> float:
        return float(np.linalg.norm(np.ptp(mesh.vertices[mesh.faces[part].ravel()], axis=0)))

    return sorted(parts, key=extent, reverse=True)


def _seen(mesh: meshes.Mesh) -> meshes.Mesh:
    """Remove components inside the largest one, such as the inner side of a shell."""
    import gpytoolbox

    parts = _parts(mesh)
    hull = mesh.faces[parts[0]]
    kept = [parts[0]]
    for part in parts[1:]:
        points = mesh.vertices[np.unique(mesh.faces[part])]
        wound = np.abs(gpytoolbox.fast_winding_number(points, mesh.vertices, hull))
        if wound.min() < 0.9:
            kept.append(part)
    used, faces = np.unique(mesh.faces[np.concatenate(kept)], return_inverse=True)
    return meshes.Mesh(mesh.name, mesh.vertices[used], faces.reshape(-1, 3))


def _handles(faces: Int[np.ndarray, "faces 3"]) -> float:
    """Genus of a closed surface; a lower value for an open one."""
    return 1 - (len(np.unique(faces)) - len(meshes.edges_of(faces)) + len(faces)) / 2


def _outside(mesh: meshes.Mesh, length: float) -> MeshExemplar | None:
    """Shape and relief from the winding number on a grid: the half level of the blurred grid is the
    shape, and the outermost crossing of the sharp grid, along the shape's normals, is the
    height."""
    import gpytoolbox

    vertices, blur = mesh.vertices, BLUR * length
    margin = 3 * blur + REACHES[-1]
    low, high = vertices.min(0) - margin, vertices.max(0) + margin
    cell = float(np.ptp(vertices, axis=0).max() + 6 * blur) / CELLS
    counts = np.ceil((high - low) / cell).astype(int) + 1
    inner = [slice(int(REACHES[-1] / cell), int(n - REACHES[-1] / cell)) for n in counts]
    axes = [low[k] + cell * np.arange(counts[k]) for k in range(3)]
    some = np.meshgrid(*(axis[part] for axis, part in zip(axes, inner, strict=True)), indexing="ij")
    full = np.zeros(counts)
    wound = gpytoolbox.fast_winding_number(
        np.stack([each.ravel() for each in some], axis=1), vertices, mesh.faces
    )
    full[*inner] = np.clip(wound, 0, 1).reshape(some[0].shape)
    # In the order of `marching_cubes`: x varies fastest.
    x, y, z = np.meshgrid(*axes, indexing="ij")
    points = np.stack([each.ravel(order="F") for each in (x, y, z)], axis=1)
    for reach in REACHES:
        soft = gaussian_filter(_closed(full, reach / cell), blur / cell)
        if soft.max() <= 0.5:
            continue
        base, faces = gpytoolbox.marching_cubes(
            -soft.ravel(order="F"), points, *(int(c) for c in counts), isovalue=-0.5
        )
        base, faces = _welded(base, faces)
        if _handles(faces) <= MOST_HANDLES:
            break
    else:
        raise UserError(
            f"the style '{mesh.name}' consists mostly of holes and has no outer surface to take a "
            "relief from: give one with smaller holes."
        )
    places = ((base - low) / cell).T
    slope = np.stack([map_coordinates(each, places, order=1) for each in np.gradient(soft)], axis=1)
    outward = -slope / np.linalg.norm(slope, axis=1, keepdims=True).clip(min=1e-9)
    if _volume(base, faces) < 0:
        faces = faces[:, ::-1]
    height = _outermost(full, places, outward, 2.5 * blur / cell) * cell
    if height.std() < FLAT:
        return None
    return _exemplar(Sheet(base, np.ascontiguousarray(faces)), height, length)


def _closed(full: Float[np.ndarray, "x y z"], reach: float) -> Float[np.ndarray, "x y z"]:
    """Morphological closing by a ball of this radius, in cells."""
    if reach == 0:
        return full
    near = binary_fill_holes(distance_transform_edt(full < 0.5) <= reach)
    return (distance_transform_edt(near) > reach).astype(float)


def _outermost(
    full: Float[np.ndarray, "x y z"],
    places: Float[np.ndarray, "3 vertices"],
    outward: Float[np.ndarray, "vertices 3"],
    reach: float,
) -> Float[np.ndarray, " vertices"]:
    """Position along ``outward``, within ``reach`` either way, of the outermost half-full point, in
    cells; if there is none, as in a through hole, the minimum over all other points."""
    height = np.full(places.shape[1], -reach)
    found = np.zeros(len(height), dtype=bool)
    steps = np.linspace(reach, -reach, 81)
    before = np.zeros(len(height))
    for far, near in zip(np.r_[reach, steps[:-1]], steps, strict=True):
        here = map_coordinates(full, places + near * outward.T, order=1)
        hit = ~found & (here >= 0.5) & (before < 0.5)
        share = (0.5 - before[hit]) / (here[hit] - before[hit])
        height[hit] = far + (near - far) * share
        found |= hit
        before = here
    if found.any():
        height[~found] = np.percentile(height[found], 1)
    return height


def _welded(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    places, inverse = np.unique(np.round(vertices, 9), axis=0, return_inverse=True)
    faces = inverse.ravel()[faces]
    sound = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    return places, faces[sound]


def _volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float((a * np.cross(b, c)).sum() / 6)
