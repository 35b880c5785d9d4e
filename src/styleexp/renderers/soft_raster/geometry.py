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
    pixel (r, c) has its centre at ``(c + 0.5, r + 0.5)``. Dtype and device are those of ``like``;
    computed where the cameras are.
    """
    height, width = resolution
    rotation, translation, focal, center = (
        each.detach().to(like.dtype)
        for each in (cameras.rotation, cameras.translation, cameras.focal, cameras.center)
    )
    right, up, backward = torch.cat([rotation, translation[:, :, None]], dim=2).unbind(1)
    x = focal[:, :1] * right - (center[:, :1] + 1) * backward
    y = -focal[:, 1:] * up + (center[:, 1:] - 1) * backward
    found = torch.stack([0.5 * width * x, 0.5 * height * y, -backward])
    return found.to(like.device, non_blocking=True)


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
        ctx.count = vertices.shape[0]
        if vertices.device.type != "cpu":  # in few kernels
            first, second, third = _at(vertices.t().contiguous(), corners).unbind(1)
            to_second, to_third = second - first, third - first
            ctx.save_for_backward(corners, to_second, to_third)
            along, across = (torch.cat([each, each[:2]]) for each in (to_second, to_third))
            return along[1:4] * across[2:] - along[2:] * across[1:4]
        points = [
            [axis.index_select(0, corner) for axis in vertices.t().contiguous()]
            for corner in corners
        ]
        a = [second - first for first, second in zip(points[0], points[1], strict=True)]
        b = [third - first for first, third in zip(points[0], points[2], strict=True)]
        ctx.save_for_backward(corners, *a, *b)
        return torch.stack(_cross(a, b))

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        """Gradient of the cross product, summed into the corners."""
        corners, *edges = ctx.saved_tensors
        if grad.device.type != "cpu":
            to_second = torch.linalg.cross(edges[1], grad, dim=0)
            to_third = torch.linalg.cross(grad, edges[0], dim=0)
            to_corners = torch.stack([-to_second - to_third, to_second, to_third], 1)
            return _summed(to_corners, corners, ctx.count).t(), None
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
        if values.device.type != "cpu":
            return _summed(values[:, None].expand(3, 3, -1), corners, count)
        out = values.new_zeros(3, count)
        for row, value in zip(out, values, strict=True):
            for corner in corners:
                row.scatter_add_(0, corner, value)
        return out

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        """Each face collects the gradients of its corners."""
        (corners,) = ctx.saved_tensors
        if grad.device.type != "cpu":
            return _at(grad, corners).sum(1), None, None
        rows = grad.contiguous()
        out = [sum(row.index_select(0, corner) for corner in corners) for row in rows]
        return torch.stack(out), None, None


def _at(values: Float[Tensor, "3 n"], corners: Int[Tensor, "3 m"]) -> Float[Tensor, "3 3 m"]:
    """Values at each face's corners, (axis, corner, face), in one kernel."""
    return values.index_select(1, corners.reshape(-1)).unflatten(1, corners.shape)


def _summed(
    values: Float[Tensor, "3 3 m"], corners: Int[Tensor, "3 m"], count: int
) -> Float[Tensor, "3 n"]:
    """Sum of values (axis, corner, face) at ``count`` vertices, in few kernels."""
    out = values.new_zeros(values.shape[0], count)
    return out.index_add_(1, corners.reshape(-1), values.flatten(1))


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
