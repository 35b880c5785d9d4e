"""Any style mesh told apart into a smooth shape and a relief on it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.sparse import coo_matrix, diags
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import cg

from styleexp import meshes
from styleexp.synthesis.exemplar import MeshExemplar
from styleexp.synthesis.walk import Sheet

if TYPE_CHECKING:
    from jaxtyping import Float

LENGTH = 0.5
"""Radii: what is smaller belongs to the relief, where a surface is smoothed along itself."""
BLUR = 0.12
"""Radii: what is smaller belongs to the relief, where shape and relief are told apart on a grid."""
CELLS = 112
"""Of that grid, along the longest side."""
MOST_HANDLES = 2
"""With more of them a mesh is a lattice, whose struts no smoothing along the surface flattens."""


def exemplar_of(mesh: meshes.Mesh) -> MeshExemplar:
    """The relief of a style mesh.

    One surface without many handles is smoothed along itself. Many components, inner faces, struts:
    the outside of the whole counts, as seen on a grid.
    """
    if _components(mesh) == 1 and _handles(mesh) <= MOST_HANDLES:
        return _along_itself(mesh)
    return _outside(mesh)


def _along_itself(mesh: meshes.Mesh) -> MeshExemplar:
    """The surface smoothed by one implicit step of heat flow, and the height over it.

    The cotangent Laplacian, and not the graph's, as an uneven mesh of a smooth ball has no relief.
    """
    import gpytoolbox

    vertices = meshes.normalisation(mesh.vertices).apply(mesh.vertices)
    laplacian = gpytoolbox.cotangent_laplacian(vertices, mesh.faces)
    laplacian.data = np.nan_to_num(laplacian.data, posinf=0.0, neginf=0.0)  # of flat faces
    area = Sheet(vertices, mesh.faces).areas
    mass = area.clip(min=1e-9 * area.mean())
    # A wave of LENGTH is damped to a fifth, as by `relief.smoother`.
    time = 4 * (LENGTH / (2 * np.pi)) ** 2
    matrix = (diags(mass) + time * laplacian).tocsr()
    inverse = diags(1 / matrix.diagonal())
    columns = [cg(matrix, mass * each, each, rtol=1e-8, M=inverse)[0] for each in vertices.T]
    base = np.stack(columns, axis=1)
    normals = meshes.vertex_normals(base, mesh.faces)
    height = ((vertices - base) * normals).sum(axis=1)
    # Smoothing draws vertices sideways, too, off steep walls: each height belongs below its vertex.
    base = vertices - height[:, None] * normals
    return MeshExemplar(Sheet(base, mesh.faces, normals), height - height.mean())


def _components(mesh: meshes.Mesh) -> int:
    """Surfaces that hang together, those with less than a thousandth of the faces left out."""
    count = len(mesh.vertices)
    a, b = mesh.faces[:, :2].T, mesh.faces[:, 1:].T
    rows, columns = np.concatenate([a[0], b[0]]), np.concatenate([a[1], b[1]])
    graph = coo_matrix((np.ones(len(rows)), (rows, columns)), (count, count))
    label = connected_components(graph, directed=False)[1]
    sizes = np.bincount(label[mesh.faces[:, 0]])
    return int((sizes > len(mesh.faces) / 1000).sum())


def _handles(mesh: meshes.Mesh) -> float:
    """Genus of a closed surface; of an open one less."""
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    count = len(np.unique(edges[:, 0] * len(mesh.vertices) + edges[:, 1]))
    used = len(np.unique(mesh.faces))
    return 1 - (used - count + len(mesh.faces)) / 2


def _outside(mesh: meshes.Mesh) -> MeshExemplar:
    """Shape and relief by the winding number on a grid: blurred, its half level is the shape; the
    outermost crossing of the sharp one, along the shape's normals, is the height."""
    import gpytoolbox

    vertices = meshes.normalisation(mesh.vertices).apply(mesh.vertices)
    low, high = vertices.min(0) - 3 * BLUR, vertices.max(0) + 3 * BLUR
    cell = float((high - low).max()) / CELLS
    counts = np.ceil((high - low) / cell).astype(int) + 1
    axes = [low[k] + cell * np.arange(counts[k]) for k in range(3)]
    x, y, z = np.meshgrid(*axes, indexing="ij")
    # In the order that `marching_cubes` wants: x fastest.
    points = np.stack([each.ravel(order="F") for each in (x, y, z)], axis=1)
    wound = gpytoolbox.fast_winding_number(points, vertices, mesh.faces)
    full = np.clip(wound, 0, 1).reshape(counts, order="F")
    soft = gaussian_filter(full, BLUR / cell)
    base, faces = gpytoolbox.marching_cubes(
        -soft.ravel(order="F"), points, *(int(c) for c in counts), isovalue=-0.5
    )
    base, faces = _welded(base, faces)
    places = ((base - low) / cell).T
    slope = np.stack([map_coordinates(each, places, order=1) for each in np.gradient(soft)], axis=1)
    outward = -slope / np.linalg.norm(slope, axis=1, keepdims=True).clip(min=1e-9)
    if _volume(base, faces) < 0:
        faces = faces[:, ::-1]
    height = _outermost(full, places, outward, 2.5 * BLUR / cell) * cell
    return MeshExemplar(Sheet(base, np.ascontiguousarray(faces)), height - height.mean())


def _outermost(
    full: Float[np.ndarray, "x y z"],
    places: Float[np.ndarray, "3 vertices"],
    outward: Float[np.ndarray, "vertices 3"],
    reach: float,
) -> Float[np.ndarray, " vertices"]:
    """How far along ``outward``, at most ``reach`` either way, the grid is last half full; where it
    is nowhere, as in a hole through it, ``reach`` inwards. In cells."""
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
    return height


def _welded(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    places, inverse = np.unique(np.round(vertices, 9), axis=0, return_inverse=True)
    faces = inverse.ravel()[faces]
    sound = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    return places, faces[sound]


def _volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float((a * np.cross(b, c)).sum() / 6)
