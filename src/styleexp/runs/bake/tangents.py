"""Tangents by MikkTSpace's rules (Mikkelsen 2008, http://www.mikktspace.com), which glTF, Blender
and game engines follow, so that a baked normal map is read with the tangents it was baked with."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float, Int


def tangents(
    points: Float[np.ndarray, "faces 3 3"],
    normals: Float[np.ndarray, "faces 3 3"],
    uv: Float[np.ndarray, "faces 3 2"],
) -> tuple[Float[np.ndarray, "faces 3 3"], Float[np.ndarray, " faces"]]:
    """Unit tangent (direction of u) at every corner, and each face's handedness: 1, or -1 where
    the texture is mirrored. The bitangent is handedness x normal x tangent (v points up).

    Corners of equal position, normal and texture coordinate share a tangent if their faces are
    connected by edges there and equally handed. It is the mean of the faces' directions of u, each
    projected onto the normal's plane and weighted by the face's angle in that plane. Faces without
    area in the texture take no part; in MikkTSpace, they connect others.
    """
    a, b, c = (points[:, k] for k in range(3))
    du, dv = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    area = du[:, 0] * dv[:, 1] - du[:, 1] * dv[:, 0]
    sign = np.where(area < 0, -1.0, 1.0)
    along = unit(((b - a) * dv[:, 1:] - (c - a) * du[:, 1:]) * sign[:, None])
    along[area == 0] = 0.0

    n = normals.reshape(-1, 3)
    here = points.reshape(-1, 3)
    ahead = _flat(np.roll(points, -1, axis=1).reshape(-1, 3) - here, n)
    back = _flat(np.roll(points, 1, axis=1).reshape(-1, 3) - here, n)
    angle = np.arccos(np.clip((ahead * back).sum(1), -1, 1))
    share = _flat(np.repeat(along, 3, axis=0), n) * angle[:, None]
    group = _groups(_welded(points, normals, uv), sign, area != 0)
    sums = [np.bincount(group, share[:, k])[group] for k in range(3)]
    return unit(np.stack(sums, axis=1)).reshape(-1, 3, 3), sign


def _flat(vectors: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Unit vectors (n, 3) in the planes of normals (n, 3)."""
    return unit(vectors - normals * (normals * vectors).sum(1, keepdims=True))


def _welded(points: np.ndarray, normals: np.ndarray, uv: np.ndarray) -> Int[np.ndarray, "faces 3"]:
    """An index of each corner, the same for corners that can't be told apart in a file."""
    table = np.concatenate([points, normals, uv], axis=2).reshape(-1, 8).astype(np.float32) + 0.0
    return np.unique(table, axis=0, return_inverse=True)[1].reshape(-1, 3)


def _groups(
    corner: Int[np.ndarray, "faces 3"], sign: np.ndarray, usable: np.ndarray
) -> Int[np.ndarray, " corners"]:
    """The group of each of the 3 x faces corners that share a tangent."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    start, end = corner.ravel(), np.roll(corner, -1, axis=1).ravel()
    number = np.arange(corner.size)
    follower = np.roll(number.reshape(-1, 3), -1, axis=1).ravel()
    key = np.minimum(start, end) * (corner.max() + 1) + np.maximum(start, end)
    order = np.lexsort((start > end, key))
    # An edge of two faces is run through once each way.
    one, two = order[:-1], order[1:]
    pair = (key[one] == key[two]) & (start[one] < end[one]) & (start[two] > end[two])
    f, g = one // 3, two // 3
    pair &= (sign[f] == sign[g]) & usable[f] & usable[g]
    one, two = one[pair], two[pair]
    ends = np.concatenate([one, follower[one]]), np.concatenate([follower[two], two])
    graph = coo_matrix((np.ones(len(ends[0]), bool), ends), shape=(len(number),) * 2)
    return connected_components(graph, directed=False)[1]


def in_frame(
    wanted: Float[np.ndarray, "n 3"],
    tangent: Float[np.ndarray, "n 3"],
    normal: Float[np.ndarray, "n 3"],
    sign: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "n 3"]:
    """Unit coordinates of ``wanted`` in the frames of tangent, sign x normal x tangent, and normal,
    which are interpolated and neither of unit length nor perpendicular, as in a shader.

    A direction below the surface is bent up to it: engines restore z as the positive root.
    """
    tt, nn, nt = (np.einsum("ni,ni->n", p, q) for p, q in
                  ((tangent, tangent), (normal, normal), (normal, tangent)))  # fmt: skip
    wt, wn = (np.einsum("ni,ni->n", wanted, each) for each in (tangent, normal))
    across = sign * np.einsum("ni,ni->n", wanted, np.cross(normal, tangent))
    # The inverse of the frame's matrix, times its determinant, which is never negative.
    found = np.stack([wt * nn - wn * nt, across, np.maximum(wn * tt - wt * nt, 0.0)], axis=1)
    length = np.linalg.norm(found, axis=1, keepdims=True)
    lost = length[:, 0] <= 1e-20
    found[lost], length[lost] = [0, 0, 1], 1
    return found / length


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors at length 1; zero stays zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)
