"""Height and frequency of a mesh's or an image's relief, without neural networks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from jaxtyping import Float, Int


def mesh_relief(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    normals: Float[np.ndarray, "vertices 3"],
    length: float,
) -> Float[np.ndarray, " vertices"]:
    """Height of each vertex above the smoothed mesh, along its normal.

    Features smaller than about ``length``, in the units of ``vertices``, count as relief; see
    ``smoother``. The heights have zero mean.
    """
    smooth = smoother(vertices, faces, length)(vertices)
    height = ((vertices - smooth) * normals).sum(axis=1)
    return height - height.mean()


def smoother(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"], length: float
) -> Callable[[np.ndarray], np.ndarray]:
    """Return a low-pass filter for per-vertex values, (vertices,) or (vertices, columns).

    One implicit step of the graph Laplacian, which flattens features smaller than about ``length``.
    """
    from scipy.sparse import coo_matrix, diags
    from scipy.sparse.linalg import cg

    count = len(vertices)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    both = np.concatenate([edges, edges[:, ::-1]])
    adjacency = coo_matrix((np.ones(len(both)), (both[:, 0], both[:, 1])), (count, count)).tocsr()
    adjacency.data[:] = 1.0  # edges shared by two faces were counted twice
    degree = np.asarray(adjacency.sum(axis=1)).ravel().clip(min=1)
    edge = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1).mean()
    # On a uniform mesh the graph Laplacian is about 3/2 edge^2 times the true one, whose eigenvalue
    # for a wave of ``length`` is (2 pi / length)^2: such a wave is damped to a fifth.
    time = 4 * (length / (2 * np.pi * edge)) ** 2 / 1.5
    matrix = diags(1 + time * degree) - time * adjacency
    inverse = diags(1 / (1 + time * degree))

    def smooth(values: np.ndarray) -> np.ndarray:
        columns = np.asarray(values, dtype=np.float64).reshape(count, -1).T
        found = [cg(matrix, each, each, rtol=1e-9, M=inverse)[0] for each in columns]
        return np.stack(found, axis=1).reshape(np.shape(values))

    # A factorisation would take fifty times as long on a fine mesh.
    return smooth


def heat_smoother(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"], length: float
) -> Callable[[np.ndarray], np.ndarray]:
    """Like `smoother`, by an implicit step of heat flow with the cotangent Laplacian: on the flat
    it keeps linear functions whatever the triangles, where the graph Laplacian leaves ripples."""
    import gpytoolbox
    from scipy.sparse import diags
    from scipy.sparse.linalg import cg

    count = len(vertices)
    laplacian = gpytoolbox.cotangent_laplacian(vertices, faces)
    laplacian.data = np.nan_to_num(laplacian.data, posinf=0.0, neginf=0.0)  # from zero-area faces
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    third = np.linalg.norm(cross, axis=1) / 6
    area = np.bincount(faces.ravel(), np.repeat(third, 3), minlength=count)
    mass = area.clip(min=1e-9 * area.mean())
    time = 4 * (length / (2 * np.pi)) ** 2
    matrix = (diags(mass) + time * laplacian).tocsr()
    inverse = diags(1 / matrix.diagonal())

    def smooth(values: np.ndarray) -> np.ndarray:
        columns = np.asarray(values, dtype=np.float64).reshape(count, -1).T
        found = [cg(matrix, mass * each, each, rtol=1e-8, M=inverse)[0] for each in columns]
        return np.stack(found, axis=1).reshape(np.shape(values))

    return smooth


def half_range(height: Float[np.ndarray, " vertices"]) -> float:
    """Half the distance between the 1st and the 99th percentile."""
    low, high = np.percentile(height, [1, 99])
    return float(high - low) / 2


def mesh_frequency(
    height: Float[np.ndarray, " vertices"],
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
) -> float:
    """Frequency of a height on a mesh, in cycles per unit length: RMS slope / RMS height / 2 pi,
    which is exact for a sine wave."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    cross = np.cross(b - a, c - a)
    double = np.linalg.norm(cross, axis=1).clip(min=1e-30)
    normal = cross / double[:, None]
    ha, hb, hc = (height[faces[:, i]][:, None] for i in range(3))
    # Gradient of a linear function on a triangle.
    rotated = ha * (c - b) + hb * (a - c) + hc * (b - a)
    slope = np.linalg.norm(np.cross(normal, rotated), axis=1) / double
    mean_square = (double * (ha**2 + hb**2 + hc**2)[:, 0] / 3).sum()
    return _frequency((double * slope**2).sum(), mean_square)


def picture_frequency(picture: Float[np.ndarray, "height width"]) -> float:
    """Frequency of an image's tone, in cycles per longer side; see `mesh_frequency`."""
    tone = picture - picture.mean()
    rows, columns = np.gradient(tone)
    frequency = _frequency((rows**2 + columns**2).sum(), (tone**2).sum())
    return frequency * max(picture.shape)


def _frequency(square_slope: float, square_height: float) -> float:
    return float(np.sqrt(square_slope / max(square_height, 1e-30)) / (2 * np.pi))
