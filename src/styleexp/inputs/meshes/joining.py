"""Merge vertices that differ only by rounding."""

from __future__ import annotations

import numpy as np

SHARE = 0.25
"""Maximum merge distance as a fraction of a vertex's shortest edge, so that no edge can
collapse."""
NEIGHBOURS = 32


def exact(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First row of each distinct position, and each row's position index, in order of
    appearance."""
    _, first, inverse = np.unique(points + 0.0, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    return first[order], np.argsort(order)[inverse.ravel()]


def near(points: np.ndarray, faces: np.ndarray, distance: float) -> np.ndarray:
    """For each of n distinct points (n, 3), the index of the first point it merges with, (n,).

    Only ends of open edges are merged, never closed surfaces, so the two sides of a thin part stay
    separate. Points farther apart than a fraction of the local shortest edge are not merged.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    n = len(points)
    result = np.arange(n)
    ends = np.unique(open_edges(faces))
    if distance <= 0.0 or len(ends) < 2:
        return result
    reach = np.minimum(distance, SHARE * _shortest(points, faces)[ends])
    # Only the nearest few: a dense cluster would have too many pairs.
    k = min(NEIGHBOURS, len(ends))
    apart, other = cKDTree(points[ends]).query(
        points[ends], k=k, distance_upper_bound=distance * (1 + 1e-9)
    )
    one, which = np.nonzero(np.isfinite(apart) & (other < len(ends)))
    two = other[one, which]
    close = apart[one, which] <= np.minimum(reach[one], reach[two]) * (1 + 1e-9)
    one, two = ends[one[close]], ends[two[close]]
    graph = coo_matrix((np.ones(len(one), bool), (one, two)), shape=(n, n))
    _, label = connected_components(graph, directed=False)
    # A chain of merges may connect both ends of an edge.
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges = edges[edges[:, 0] != edges[:, 1]]
    collapsed = label[edges[label[edges[:, 0]] == label[edges[:, 1]], 0]]
    first = np.full(label.max() + 1, n)
    np.minimum.at(first, label, result)
    return np.where(np.isin(label, collapsed), result, first[label])


def nearly_closed(points: np.ndarray, faces: np.ndarray, distance: float) -> tuple[int, float]:
    """Number of open edges that nearly coincide with another one, and their maximum gap.

    Counts edges whose ends are within ``distance`` of another's and that are several times longer.
    """
    from scipy.spatial import cKDTree

    edges = open_edges(faces)
    a, b = points[edges[:, 0]], points[edges[:, 1]]
    long = np.linalg.norm(a - b, axis=1) > distance / SHARE
    a, b = a[long], b[long]
    if distance <= 0.0 or len(a) < 2:
        return 0, 0.0
    middles = (a + b) / 2
    _, other = cKDTree(middles).query(
        middles, k=min(8, len(a)), distance_upper_bound=distance * (1 + 1e-9)
    )
    one, which = np.nonzero(other < len(a))
    two = other[one, which]
    one, two = one[one != two], two[one != two]

    def apart(c: np.ndarray, d: np.ndarray) -> np.ndarray:
        ends = (np.linalg.norm(a[one] - c, axis=1), np.linalg.norm(b[one] - d, axis=1))
        return np.maximum(*ends)

    gap = np.minimum(apart(a[two], b[two]), apart(b[two], a[two]))
    close = gap <= distance
    return len(np.unique(one[close])), float(gap[close].max(initial=0.0))


def open_edges(faces: np.ndarray) -> np.ndarray:
    """Edges with only one face, (edges, 2)."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges = edges[edges[:, 0] != edges[:, 1]]
    if not len(edges):
        return edges
    size = int(edges.max()) + 1
    keys, count = np.unique(edges[:, 0] * size + edges[:, 1], return_counts=True)
    keys = keys[count == 1]
    return np.stack([keys // size, keys % size], axis=1)


def _shortest(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Length of each point's shortest edge, (points,); infinite if it has none."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    edges = edges[edges[:, 0] != edges[:, 1]]
    length = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    result = np.full(len(points), np.inf)
    for k in range(2):
        np.minimum.at(result, edges[:, k], length)
    return result
