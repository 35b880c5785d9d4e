"""Light on the visible surface: the differentiable intensities of the covered pixels.

The light is turned into the world once, so that normals need not be turned into every camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
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
        return InterpolateAndLight.apply(
            self.points,
            self.normals,
            self.corners,
            visible,
            self.light,
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
    the corners of the faces (3, F), the n covered pixels, the lights (lights, views, 3), and the
    two constants of the shading. Returns the intensities (lights, n).

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
        visible: Visible,
        light: Tensor,
        albedo: float,
        ambient: float,
    ) -> Tensor:
        """Weights, normal, light."""
        ctx.shapes = points.shape, normals.shape
        ctx.rest = visible, albedo, ambient
        ctx.known = []
        out = points.new_empty(len(light), len(visible.pixel))
        for part in _parts(visible):
            known = _lit_pixels(points, normals, corners, visible, light, part)
            if any(ctx.needs_input_grad):
                ctx.known.append(known)
            *_, raw = known
            for row, each in zip(out[:, part], raw, strict=True):
                torch.add(each, ambient, out=row).mul_(albedo).clamp_(0, 1)
        return out

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        """Back through light, normalisation and weights to positions and normals."""
        visible, albedo, ambient = ctx.rest
        to_points, to_normals = (grad.new_zeros(shape) for shape in ctx.shapes)
        point_rows, normal_rows = to_points.view(3, -1).unbind(), to_normals.unbind()
        for part, known in zip(_parts(visible), ctx.known, strict=True):
            seen, lights, normal, inverse, lit = known
            to_normal = [torch.zeros_like(inverse) for _ in range(3)]
            along = torch.zeros_like(inverse)
            for each, axes, towards in zip(lit, lights, grad[:, part], strict=True):
                raw = (each + ambient).mul_(albedo)
                towards = torch.ops.aten.hardtanh_backward(towards, raw, 0.0, 1.0)
                along.addcmul_(towards, each)
                for into, axis in zip(to_normal, axes, strict=True):
                    into.addcmul_(towards, axis)
            # Along the normal itself there is no change: normalising removes it.
            inverse = inverse * albedo
            for into, axis in zip(to_normal, normal, strict=True):
                into.addcmul_(axis, along, value=-1).mul_(inverse)
            to_weight = [_dot(to_normal, each) for each in seen.normals]
            for i in range(3):
                j, k = (i + 1) % 3, (i + 2) % 3
                for into, axis in zip(normal_rows, to_normal, strict=True):
                    into.scatter_add_(0, seen.corners[i], axis * seen.weights[i])
                # The vertex enters the weights of the other two.
                to_right = _cross(to_weight[j], seen.down[k], to_weight[k], seen.down[j])
                to_down = _cross(to_weight[k], seen.right[j], to_weight[j], seen.right[k])
                point_rows[0].scatter_add_(0, seen.index[i], to_right)
                point_rows[1].scatter_add_(0, seen.index[i], to_down)
                to_w = to_right.mul_(seen.column).addcmul_(to_down, seen.row).neg_()
                point_rows[2].scatter_add_(0, seen.index[i], to_w)
        return to_points, to_normals, None, None, None, None, None


_AT_ONCE = 1 << 15
"""Pixels that are shaded at once, so that what is between fits the cache."""


def _parts(visible: Visible) -> list[slice]:
    return [slice(i, i + _AT_ONCE) for i in range(0, len(visible.pixel), _AT_ONCE)]


@dataclass(frozen=True)
class _Seen:
    """What n pixels see: of each corner of their faces one array."""

    column: Float[Tensor, " n"]
    """Centre of the pixel."""
    row: Float[Tensor, " n"]
    corners: list[Int[Tensor, " n"]]
    index: list[Int[Tensor, " n"]]
    """Of the corner in the flattened (views, V)."""
    right: list[Float[Tensor, " n"]]
    """Offset from the pixel's ray."""
    down: list[Float[Tensor, " n"]]
    weights: list[Float[Tensor, " n"]]
    normals: list[list[Float[Tensor, " n"]]]


def _lit_pixels(
    points: Tensor, normals: Tensor, corners: Tensor, visible: Visible, light: Tensor, part: slice
) -> tuple[_Seen, list[list[Tensor]], list[Tensor], Tensor, list[Tensor]]:
    """Of a part of the pixels: what they see, the lights' axes, the unit normal, the inverse of its
    length before, and its product with each light."""
    height, width = visible.face_ids.shape[1:]
    view, face = visible.view[part], visible.face[part]
    within = visible.pixel[part] - view * (height * width)
    # Looked up: dividing integers takes ten times as long.
    centers = [torch.arange(size, device=view.device).to(points) + 0.5 for size in (width, height)]
    column = centers[0].repeat(height).index_select(0, within)
    row = centers[1].repeat_interleave(width).index_select(0, within)
    x, y, w = points.view(3, -1).unbind()
    first = view * points.shape[2]
    own = [corner.index_select(0, face) for corner in corners]
    index = [corner + first for corner in own]
    right, down = [], []
    for each in index:
        depth = w.index_select(0, each)
        right.append(x.index_select(0, each).addcmul_(column, depth, value=-1))
        down.append(y.index_select(0, each).addcmul_(row, depth, value=-1))
    weights = [_cross(down[j], right[k], right[j], down[k]) for j, k in ((1, 2), (2, 0), (0, 1))]
    at_corners = [[axis.index_select(0, each) for axis in normals] for each in own]
    normal = [_dot(weights, each) for each in zip(*at_corners, strict=True)]
    squared = _dot(normal, normal)
    inverse = torch.where(squared > 0, squared, 1.0).rsqrt_()
    for axis in normal:
        axis.mul_(inverse)
    lights = [[axis.index_select(0, view) for axis in each.t().contiguous()] for each in light]
    lit = [_dot(normal, each) for each in lights]
    seen = _Seen(column, row, own, index, right, down, weights, at_corners)
    return seen, lights, normal, inverse, lit


def _dot(a: Sequence[Tensor], b: Sequence[Tensor]) -> Tensor:
    """``a[0] b[0] + a[1] b[1] + a[2] b[2]``."""
    return (a[0] * b[0]).addcmul_(a[1], b[1]).addcmul_(a[2], b[2])


def _cross(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> Tensor:
    """``a b - c d``."""
    return (a * b).addcmul_(c, d, value=-1)
