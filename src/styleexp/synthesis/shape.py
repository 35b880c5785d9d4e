"""Any style mesh told apart into a smooth shape and a relief on it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import (
    binary_fill_holes,
    distance_transform_edt,
    gaussian_filter,
    map_coordinates,
)
from scipy.sparse import coo_matrix, diags
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import cg

from styleexp import meshes
from styleexp.errors import UserError
from styleexp.relief import smoother
from styleexp.synthesis.exemplar import MeshExemplar
from styleexp.synthesis.walk import Sheet

if TYPE_CHECKING:
    from jaxtyping import Float, Int

LENGTHS = (0.5, 0.25, 0.125, 0.0625)
"""Radii: what is smaller belongs to the relief, where a surface is smoothed along itself; the
longest that parts them is taken, see `_along_itself`. All but the last are tried."""
SMOOTH = 0.35
"""Heights over a surface smoothed half as far, in those over one smoothed as far: of a relief finer
than both they are the same, of a shape that only bends a quarter. Below this there is no relief."""
FLAT = 1e-4
"""Deviation of heights, in radii, that is no relief."""
BLUR = 0.24
"""Where shape and relief are told apart on a grid it is blurred by this share of the length."""
CELLS = 112
"""Of that grid, along the longest side."""
REACHES = (0.0, 0.15, 0.3, 0.6)
"""Radii: gaps in the outside up to twice as wide are closed; the least that leaves few handles."""
MOST_HANDLES = 2
"""With more of them a mesh is a lattice, whose struts no smoothing along the surface flattens."""
COARSE = 0.04
"""A style with longer edges on average, in radii, is refined, as patches are taken at vertices; of
others edges two and a half times as long."""
USUAL = (0.25, 2.0)
"""Mean square slope of the heights around a vertex, in shares of what a quarter of the surface
exceeds, for it to be of the pattern: less is a flat base or a bare face, more a rim or an ear."""


def exemplar_of(mesh: meshes.Mesh, length: float | None = None) -> MeshExemplar | None:
    """The relief of a style mesh; None where it has none. ``length``, in radii, parts relief and
    shape (``style.relief_length``); None finds it.

    One surface without many handles is smoothed along itself. Many components, inner faces, struts:
    the outside of the whole counts, as seen on a grid.
    """
    unit = meshes.normalisation(mesh.vertices).apply(mesh.vertices)
    mesh = _seen(meshes.Mesh(mesh.name, unit, mesh.faces))
    if len(_parts(mesh)) == 1 and _handles(mesh.faces) <= MOST_HANDLES:
        return _along_itself(mesh, length)
    return _outside(mesh, length or LENGTHS[0])


def _along_itself(mesh: meshes.Mesh, length: float | None) -> MeshExemplar | None:
    """The surface smoothed by one implicit step of heat flow, and the height over it.

    Of several lengths the one with the least change of the heights to half of it: the energy of a
    relief has a plateau there, that of a bend grows with the square.
    """
    coarse = meshes.mean_edge_length(mesh.vertices, mesh.faces) > COARSE
    mesh = meshes.refine(mesh, COARSE if coarse else 2.5 * COARSE)
    lengths = LENGTHS if length is None else (length, length / 2)
    parted = [_smoothed(mesh, each) for each in lengths]
    energy = np.array([np.average(h**2, weights=sheet.areas) ** 0.5 for sheet, h in parted])
    kept = energy[1:] / energy[:-1].clip(min=1e-12)
    best = int(kept.argmax())
    if energy[best] < FLAT or (length is None and kept[best] < SMOOTH):
        return None
    return _exemplar(*parted[best], lengths[best])


def _smoothed(mesh: meshes.Mesh, length: float) -> tuple[Sheet, Float[np.ndarray, " vertices"]]:
    """The cotangent Laplacian, and not the graph's, as an uneven mesh of a smooth ball has no
    relief."""
    import gpytoolbox

    vertices = mesh.vertices
    laplacian = gpytoolbox.cotangent_laplacian(vertices, mesh.faces)
    laplacian.data = np.nan_to_num(laplacian.data, posinf=0.0, neginf=0.0)  # of flat faces
    area = Sheet(vertices, mesh.faces).areas
    mass = area.clip(min=1e-9 * area.mean())
    # A wave of this length is damped to a fifth, as by `relief.smoother`.
    time = 4 * (length / (2 * np.pi)) ** 2
    matrix = (diags(mass) + time * laplacian).tocsr()
    inverse = diags(1 / matrix.diagonal())
    columns = [cg(matrix, mass * each, each, rtol=1e-8, M=inverse)[0] for each in vertices.T]
    base = np.stack(columns, axis=1)
    normals = meshes.vertex_normals(base, mesh.faces)
    height = ((vertices - base) * normals).sum(axis=1)
    # Smoothing draws vertices sideways, too, off steep walls: each height belongs below its vertex.
    base = vertices - height[:, None] * normals
    return Sheet(base, mesh.faces, normals), height - height.mean()


def _exemplar(sheet: Sheet, height: Float[np.ndarray, " vertices"], length: float) -> MeshExemplar:
    """With the parts where the heights are as usual told from those where they are not."""
    # As wide as a panel between struts, which is of the pattern.
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
    """Mean square slope of the faces round each vertex: by the normals of the surface itself."""
    raised = sheet.vertices + height[:, None] * sheet.normals
    normals = meshes.vertex_normals(raised, sheet.faces)
    return ((normals - sheet.normals) ** 2).sum(axis=1)


def _parts(mesh: meshes.Mesh) -> list[np.ndarray]:
    """The faces of each surface that hangs together, the largest first, those with less than a
    thousandth of the faces left out."""
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
    """Without the components that lie inside the largest one, such as the inner side of a shell."""
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
    """Genus of a closed surface; of an open one less."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    count = len(np.unique(edges, axis=0))
    return 1 - (len(np.unique(faces)) - count + len(faces)) / 2


def _outside(mesh: meshes.Mesh, length: float) -> MeshExemplar | None:
    """Shape and relief by the winding number on a grid: blurred, its half level is the shape; the
    outermost crossing of the sharp one, along the shape's normals, is the height."""
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
    # In the order that `marching_cubes` wants: x fastest.
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
            f"the style '{mesh.name}' has no outside that a relief could lie on, it is all holes: "
            "give one with smaller holes."
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
    """Where a ball of this radius, in cells, can't get from outside without touching the full."""
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
    """How far along ``outward``, at most ``reach`` either way, the grid is last half full; where it
    is nowhere, as in a hole through it, the least that it is elsewhere. In cells."""
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
