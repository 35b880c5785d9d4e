"""A surface at several subdivision levels, with frames and neighbours of its faces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from styleexp.inputs.meshes import vertex_normals

if TYPE_CHECKING:
    from collections.abc import Callable

    from jaxtyping import Float, Int
    from torch import Tensor


@dataclass(frozen=True)
class Level:
    """One level: a uniform triangle mesh. Edge k of a face goes from corner k to corner k + 1 (mod
    3)."""

    base: Float[Tensor, "vertices 3"]
    """The surface without its texture."""
    faces: Int[Tensor, "faces 3"]
    neighbours: Int[Tensor, "faces 3"]
    """The face across each edge; the face itself at a border."""
    opposite: Int[Tensor, "faces 3"]
    """The vertex across each edge; the face's own third vertex at a border."""
    frames: Float[Tensor, "faces corners xyz 3"]
    """Orthonormal frame of the base at each corner: along its edge, across it, outward."""
    parents: Int[Tensor, "vertices 2"] | None
    """The two vertices of the level below whose edge a vertex splits, or the same vertex twice if
    it existed there; None at the lowest level."""


def pyramid(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    levels: int,
    project: Callable[[np.ndarray], np.ndarray],
    device: torch.device,
) -> list[Level]:
    """Subdivide a coarse mesh repeatedly, each face into four; ``project`` moves new vertices onto
    the true surface."""
    import gpytoolbox

    built = [_level(vertices, faces, None, device)]
    for _ in range(levels - 1):
        vertices, faces, matrix = gpytoolbox.subdivide(
            vertices, faces, method="upsample", iters=1, return_matrix=True
        )
        vertices, faces = project(vertices), faces.astype(np.int64)
        matrix = matrix.tocsr()
        ends = [matrix.indices[matrix.indptr[:-1]], matrix.indices[matrix.indptr[1:] - 1]]
        built.append(_level(vertices, faces, np.stack(ends, axis=1).astype(np.int64), device))
    return built


def upsample(
    level: Level, coarse: Float[Tensor, "coarse channels"]
) -> Float[Tensor, "fine channels"]:
    """Interpolate values of the level below at this level's vertices."""
    assert level.parents is not None
    return coarse[level.parents].mean(1)


def restrict(
    level: Level, fine: Float[Tensor, "fine channels"]
) -> Float[Tensor, "coarse channels"]:
    """Restrict values to the level below: a weighted mean of each vertex and, with weight 1/2, its
    new neighbours."""
    assert level.parents is not None
    count = int(level.parents.max()) + 1
    ends, ones = level.parents.reshape(-1), torch.ones_like(fine[:, :1])
    total, weight = (
        each.new_zeros(count, each.shape[1]).index_add(0, ends, each.repeat_interleave(2, 0))
        for each in (fine, ones)
    )
    return total / weight


def _level(
    vertices: np.ndarray, faces: np.ndarray, parents: np.ndarray | None, device: torch.device
) -> Level:
    neighbours, opposite = adjacency(faces, len(vertices))
    corners = vertices[faces]
    along = np.roll(corners, -1, axis=1) - corners
    normal = np.cross(along[:, 0], along[:, 1])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    # A zero-area face has no normal: use its vertices' normal.
    lost = vertex_normals(vertices, faces)[faces].mean(axis=1)
    normal = np.where(length > 1e-12, normal / np.maximum(length, 1e-12), lost)
    x = along - (along * normal[:, None]).sum(-1, keepdims=True) * normal[:, None]
    x /= np.maximum(np.linalg.norm(x, axis=-1, keepdims=True), 1e-12)
    z = np.broadcast_to(normal[:, None], x.shape)
    frames = np.stack([x, np.cross(z, x), z], axis=2)
    return Level(
        torch.from_numpy(vertices).float().to(device),
        torch.from_numpy(faces).to(device),
        torch.from_numpy(neighbours).to(device),
        torch.from_numpy(opposite).to(device),
        torch.from_numpy(frames).float().to(device),
        None if parents is None else torch.from_numpy(parents).to(device),
    )


def adjacency(
    faces: Int[np.ndarray, "faces 3"], count: int
) -> tuple[Int[np.ndarray, "faces 3"], Int[np.ndarray, "faces 3"]]:
    """Faces and vertices across each edge of an oriented manifold mesh: see `Level`."""
    tail, head = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    key, twin = tail * count + head, head * count + tail
    order = np.argsort(key)
    at = order[np.searchsorted(key[order], twin).clip(max=len(key) - 1)]
    inner = key[at] == twin
    own = np.arange(faces.size)
    edge = np.where(inner, at, own)
    opposite = faces[edge // 3, (edge % 3 + 2) % 3]
    return (edge // 3).reshape(-1, 3), opposite.reshape(-1, 3)
