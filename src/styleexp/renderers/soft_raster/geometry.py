"""Projection and normals.

Data is stored as one array per coordinate ("structure of arrays"): in torch, gathers and scatters
along one dimension are several times faster than those of short rows.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from torch import Tensor

    from styleexp.renderers.base import Cameras

_TINY_SQUARED = 1e-25  # squared length under which a vector has no direction: the gradient of
# rsqrt overflows float32 below 2e-26


def pixel_projection(
    cameras: Cameras, resolution: tuple[int, int], like: Tensor
) -> Float[Tensor, "3 views 4"]:
    """Matrices that map world points ``(x, y, z, 1)`` to homogeneous pixels ``(column w, row w,
    w)``.

    ``w`` is the depth of ``RenderOutput.depth``; dividing by it gives pixel coordinates, where
    pixel (r, c) has its centre at ``(c + 0.5, r + 0.5)``. Dtype and device are those of ``like``.
    """
    height, width = resolution
    rotation, translation = (
        cameras.rotation.detach().to(like),
        cameras.translation.detach().to(like),
    )
    focal, center = cameras.focal.detach().to(like), cameras.center.detach().to(like)
    right, up, backward = torch.cat([rotation, translation[:, :, None]], dim=2).unbind(1)
    x = focal[:, :1] * right - (center[:, :1] + 1) * backward
    y = -focal[:, 1:] * up + (center[:, 1:] - 1) * backward
    return torch.stack([0.5 * width * x, 0.5 * height * y, -backward])


class Project(torch.autograd.Function):
    """Project vertices (V, 3) with ``pixel_projection`` matrices to homogeneous pixels (3, views,
    V).

    The forward pass is elementwise, so that a view's bits don't depend on the rest of the batch; a
    matrix product would select its kernel by batch size. The matrices get no gradient.
    """

    @staticmethod
    def forward(ctx: Any, vertices: Tensor, matrix: Tensor) -> Tensor:
        """Project every vertex to every view."""
        x, y, z = vertices.t().contiguous()
        columns = matrix.unsqueeze(-1)
        points = torch.addcmul(columns[:, :, 3], columns[:, :, 0], x)
        points.addcmul_(columns[:, :, 1], y).addcmul_(columns[:, :, 2], z)
        ctx.save_for_backward(matrix)
        return points

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        """Sum over views of each view's transposed matrix."""
        (matrix,) = ctx.saved_tensors
        rows = matrix[:, :, :3].reshape(-1, 3)
        return grad.reshape(rows.shape[0], -1).t() @ rows, None


class FaceNormals(torch.autograd.Function):
    """Area-weighted face normals (3, F) from vertices (V, 3) and corner indices (3, F).

    The length is twice the area; the direction is outward for counter-clockwise faces.
    """

    @staticmethod
    def forward(ctx: Any, vertices: Tensor, corners: Tensor) -> Tensor:
        """Cross product of two edges of every face."""
        points = [
            [axis.index_select(0, corner) for axis in vertices.t().contiguous()]
            for corner in corners
        ]
        a = [second - first for first, second in zip(points[0], points[1], strict=True)]
        b = [third - first for first, third in zip(points[0], points[2], strict=True)]
        ctx.save_for_backward(corners, *a, *b)
        ctx.count = vertices.shape[0]
        return torch.stack(_cross(a, b))

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        """Gradient of the cross product, summed into the corners."""
        corners, *edges = ctx.saved_tensors
        grads = grad.unbind(0)
        to_second, to_third = _cross(edges[3:], grads), _cross(grads, edges[:3])
        out = grad.new_zeros(3, ctx.count)
        for row, second, third in zip(out, to_second, to_third, strict=True):
            row.scatter_add_(0, corners[1], second).scatter_add_(0, corners[2], third)
            row.scatter_add_(0, corners[0], second.add_(third).neg_())
        return out.t(), None


class SumAtVertices(torch.autograd.Function):
    """Sum face values (3, F) at the vertices (3, V), given corner indices (3, F)."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, corners: Tensor, count: int) -> Tensor:
        """Add each face's value to its three corners."""
        ctx.save_for_backward(corners)
        out = values.new_zeros(3, count)
        for row, value in zip(out, values, strict=True):
            for corner in corners:
                row.scatter_add_(0, corner, value)
        return out

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        """Each face collects the gradients of its corners."""
        (corners,) = ctx.saved_tensors
        rows = grad.contiguous()
        out = [sum(row.index_select(0, corner) for corner in corners) for row in rows]
        return torch.stack(out), None, None


def unit(vectors: Float[Tensor, "3 n"]) -> Float[Tensor, "3 n"]:
    """Normalise vectors; those too short to have a direction become 0 and pass no gradient."""
    squared = (vectors * vectors).sum(0)
    has_direction = squared > _TINY_SQUARED
    scale = torch.where(has_direction, squared, 1.0).rsqrt()
    return vectors * torch.where(has_direction, scale, 0.0)


def vertex_normals(
    face_normals: Float[Tensor, "3 faces"], corners: Int[Tensor, "3 faces"], count: int
) -> Float[Tensor, "3 vertices"]:
    """Unit vertex normals, area-weighted."""
    return unit(SumAtVertices.apply(face_normals, corners, count))


def _cross(a: Any, b: Any) -> list[Tensor]:
    # Don't use `addcmul`, which rounds only once: a zero-area face has a normal of exactly zero
    # only if both products are rounded alike.
    return [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
