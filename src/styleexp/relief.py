"""How high a mesh's relief is, without any neural network."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float, Int


def relief_height(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    normals: Float[np.ndarray, "vertices 3"],
    length: float,
) -> float:
    """Half the range (1st to 99th percentile) of the mesh over its own smoothed version.

    Smoothing is one implicit step of the graph Laplacian that flattens what is smaller than about
    ``length``, in the units of ``vertices``. The height is measured along the normals.
    """
    from scipy.sparse import coo_matrix, diags, identity
    from scipy.sparse.linalg import splu

    count = len(vertices)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    both = np.concatenate([edges, edges[:, ::-1]])
    adjacency = coo_matrix((np.ones(len(both)), (both[:, 0], both[:, 1])), (count, count)).tocsr()
    adjacency.data[:] = 1.0  # edges of two faces were counted twice
    degree = np.asarray(adjacency.sum(axis=1)).ravel().clip(min=1)
    laplacian = diags(degree) - adjacency
    edge = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1).mean()
    # On an even mesh the graph Laplacian is about 3/2 edge^2 times the true one, whose eigenvalue
    # for a wave of ``length`` is (2 pi / length)^2: such a wave is damped to a fifth.
    time = 4 * (length / (2 * np.pi * edge)) ** 2 / 1.5
    smooth = splu((identity(count) + time * laplacian).tocsc()).solve(np.ascontiguousarray(vertices))
    height = ((vertices - smooth) * normals).sum(axis=1)
    low, high = np.percentile(height, [1, 99])
    return float(high - low) / 2
