"""Light on the visible surface: the differentiable intensities of the covered pixels.

The light is turned into the world once, so that normals need not be turned into every camera.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from styleexp.renderers.soft_raster.geometry import unit, vertex_normals

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from torch import Tensor

    from styleexp.renderers.base import Cameras, Shading
    from styleexp.renderers.soft_raster.contour import Crossings
    from styleexp.renderers.soft_raster.raster import Visible


def world_light(
    cameras: Cameras, lights: Float[Tensor, "*lights views 3"], like: Tensor
) -> Float[Tensor, "*lights views 3"]:
    """Each view's light or lights, direction times strength, in world coordinates."""
    return (lights.detach().to(like)[..., None] * cameras.rotation.detach().to(like)).sum(-2)


class FlatSurface:
    """A surface with one normal a face; its area-weighted normals are given."""

    def __init__(
        self,
        face_normals: Float[Tensor, "3 faces"],
        light: Float[Tensor, "lights views 3"],
        shading: Shading,
    ) -> None:
        self.normals, self.light, self.shading = unit(face_normals), light, shading

    def at_pixels(self, visible: Visible) -> Float[Tensor, "lights winners"]:
        """Intensities of the covered pixels."""
        lit = self.light @ self.normals
        intensity = (self.shading.albedo * (self.shading.ambient + lit)).clamp(0, 1)
        index = visible.view * intensity.shape[2] + visible.face
        return torch.stack([PickOne.apply(one, index) for one in intensity])

    def at_crossings(self, crossings: Crossings) -> Float[Tensor, "lights n"]:
        """Intensities right at outlines; without gradients."""
        normal = self.normals.detach().index_select(1, crossings.face)
        return _lit(normal, crossings.view, self.light, self.shading)


class SmoothSurface:
    """A surface whose unit normals at vertices are interpolated over its faces."""

    def __init__(
        self,
        points: Float[Tensor, "3 views vertices"],
        face_normals: Float[Tensor, "3 faces"],
        corners: Int[Tensor, "3 faces"],
        light: Float[Tensor, "lights views 3"],
        shading: Shading,
    ) -> None:
        self.points, self.corners, self.light, self.shading = points, corners, light, shading
        self.normals = vertex_normals(face_normals, corners, points.shape[2])

    def at_pixels(self, visible: Visible) -> Float[Tensor, "lights winners"]:
        """Intensities of the covered pixels."""
        height, width = visible.face_ids.shape[1:]
        within = visible.pixel - visible.view * (height * width)
        row = within // width
        column = within - row * width
        return InterpolateAndLight.apply(
            self.points,
            self.normals,
            self.corners.index_select(1, visible.face),
            visible.view,
            torch.stack([column, row]).to(self.points.dtype) + 0.5,
            self.light.index_select(1, visible.view).transpose(1, 2),
            self.shading.albedo,
            self.shading.ambient,
        )

    def at_crossings(self, crossings: Crossings) -> Float[Tensor, "lights n"]:
        """Intensities right at outlines; without gradients."""
        flat, normals = self.points.detach().reshape(3, -1), self.normals.detach()
        first = crossings.view * self.points.shape[2]
        # How far each end is beside the pixels' line: the crossing divides the edge accordingly.
        axis = crossings.along_row.long()
        center = crossings.center.gather(0, axis[None])[0]
        sides, ends = [], []
        for index in (crossings.start, crossings.end):
            x, y, w = flat.index_select(1, index)
            sides.append(torch.where(crossings.along_row, y, x) - center * w)
            ends.append(normals.index_select(1, index - first))
        span = sides[0] - sides[1]
        share = torch.where(span == 0, 0.5, sides[0] / span).clamp(0, 1)
        normal = unit(torch.lerp(ends[0], ends[1], share))
        return _lit(normal, crossings.view, self.light, self.shading)


def _lit(normal: Tensor, view: Tensor, light: Tensor, shading: Shading) -> Tensor:
    lit = (normal * light.index_select(1, view).transpose(1, 2)).sum(1)
    return (shading.albedo * (shading.ambient + lit)).clamp(0, 1)


class PickOne(torch.autograd.Function):
    """``values.view(-1)[index]`` whose gradient is summed without sorting."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, index: Tensor) -> Tensor:
        """Gather."""
        ctx.save_for_backward(index)
        ctx.shape = values.shape
        return values.reshape(-1).index_select(0, index)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        """Scatter."""
        (index,) = ctx.saved_tensors
        out = grad.new_zeros(ctx.shape)
        out.view(-1).index_add_(0, index, grad)
        return out, None


class InterpolateAndLight(torch.autograd.Function):
    """Interpolate vertex normals at pixels and light them, in one step.

    The arguments are the homogeneous pixels (3, views, V) and unit normals (3, V) of the vertices,
    then, of n pixels, the three vertices (3, n), the view (n), the centre (2, n) and the lights
    (lights, 3, n), and the two constants of the shading. Returns the intensities (lights, n).

    The weight of a vertex is the cross product of the other two vertices' offsets from the pixel's
    ray, ``(x w - column w, y w - row w)``. That is the perspective-correct barycentric coordinate
    times a common factor, which normalising the normal removes; it needs no division by w and so
    holds for faces that reach behind the camera.
    """

    @staticmethod
    def forward(
        ctx: Any,
        points: Tensor,
        normals: Tensor,
        corners: Tensor,
        view: Tensor,
        center: Tensor,
        light: Tensor,
        albedo: float,
        ambient: float,
    ) -> Tensor:
        """Weights, normal, light."""
        views, count = points.shape[1:]
        flat = points.reshape(3, views * count)
        first = view * count
        right, down, corner_normals = [], [], []
        for corner in corners:
            index = first + corner
            w = flat[2].index_select(0, index)
            right.append(flat[0].index_select(0, index).addcmul_(center[0], w, value=-1))
            down.append(flat[1].index_select(0, index).addcmul_(center[1], w, value=-1))
            corner_normals.append(normals.index_select(1, corner))
        weights = [down[j] * right[k] - right[j] * down[k] for j, k in ((1, 2), (2, 0), (0, 1))]
        normal = weights[0] * corner_normals[0]
        for weight, corner_normal in zip(weights[1:], corner_normals[1:], strict=True):
            normal.addcmul_(weight, corner_normal)
        squared = (normal * normal).sum(0)
        inverse = torch.where(squared > 0, squared, 1.0).rsqrt()
        normal *= inverse
        lit = (normal * light).sum(1)
        raw = albedo * (ambient + lit)
        unclamped = (raw >= 0) & (raw <= 1)
        ctx.save_for_backward(
            corners,
            view,
            center,
            light,
            normal,
            lit,
            torch.where(unclamped, albedo * inverse, 0.0),
            *weights,
            *right,
            *down,
            *corner_normals,
        )
        ctx.shapes = points.shape, normals.shape
        return raw.clamp_(0, 1)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        """Back through light, normalisation and weights to positions and normals."""
        corners, view, center, light, normal, lit, scale, *rest = ctx.saved_tensors
        weights, right, down, corner_normals = rest[:3], rest[3:6], rest[6:9], rest[9:]
        points_shape, normals_shape = ctx.shapes
        # Along the normal itself there is no change: normalising removes it.
        towards = grad * scale
        to_normal = (light * towards[:, None]).sum(0)
        to_normal.addcmul_(normal, (lit * towards).sum(0), value=-1)
        to_normals = grad.new_zeros(normals_shape)
        to_points = grad.new_zeros(points_shape)
        flat = to_points.view(3, -1)
        to_weight = [(to_normal * corner_normal).sum(0) for corner_normal in corner_normals]
        first = view * points_shape[2]
        for i, corner in enumerate(corners):
            j, k = (i + 1) % 3, (i + 2) % 3
            share = to_normal * weights[i]
            for axis in range(3):
                to_normals[axis].index_add_(0, corner, share[axis])
            # The vertex enters the weights of the other two.
            to_right = to_weight[j] * down[k] - to_weight[k] * down[j]
            to_down = to_weight[k] * right[j] - to_weight[j] * right[k]
            index = first + corner
            flat[0].index_add_(0, index, to_right)
            flat[1].index_add_(0, index, to_down)
            flat[2].index_add_(0, index, center[0] * to_right + center[1] * to_down, alpha=-1)
        return to_points, to_normals, None, None, None, None, None, None
