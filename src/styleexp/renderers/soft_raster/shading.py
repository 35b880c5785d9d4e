"""Shading of the visible surface: differentiable intensities of the covered pixels.

The light is transformed to world space once, so that normals needn't be transformed to every
camera.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from styleexp.renderers.soft_raster.culling import positions
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
    """Each view's light or lights in world space, direction times strength."""
    rotation = cameras.rotation.detach().to(like.dtype)
    found = (lights.detach().to(rotation)[..., None] * rotation).sum(-2)
    return found.to(like.device, non_blocking=True)


class FlatSurface:
    """A surface with one normal per face, given as area-weighted normals."""

    def __init__(
        self,
        face_normals: Float[Tensor, "3 faces"],
        light: Float[Tensor, "lights views 3"],
        shading: Shading,
    ) -> None:
        self.normals, self.light, self.shading = unit(face_normals), light, shading

    def at_pixels(self, visible: Visible) -> Float[Tensor, "lights winners"]:
        """Intensities of the covered pixels."""
        # Not a matrix product: on some processors its last bit depends on how many views there are.
        lit = _dot(self.light.unsqueeze(-1).unbind(2), self.normals.unbind(0))
        intensity = (self.shading.albedo * (self.shading.ambient + lit)).clamp(0, 1)
        index = visible.view * intensity.shape[2] + visible.face
        return torch.stack([PickOne.apply(one, index) for one in intensity])

    def at_crossings(self, crossings: Crossings) -> Float[Tensor, "lights n"]:
        """Intensities right at outlines; without gradients."""
        normal = self.normals.detach().index_select(1, crossings.face)
        return _lit(normal, crossings.view, self.light, self.shading)


class SmoothSurface:
    """A surface with unit vertex normals, interpolated over faces."""

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
        if self.points.device.type != "cpu":
            return lit_directly(
                self.points, self.normals, self.corners, visible, self.light, self.shading
            )
        seen = faces_seen(self.points, self.corners, visible)
        matrices = NormalMatrices.apply(self.points, self.normals, seen)
        return LightPixels.apply(
            matrices, seen, visible, self.light, self.shading.albedo, self.shading.ambient
        )

    def at_crossings(self, crossings: Crossings) -> Float[Tensor, "lights n"]:
        """Intensities right at outlines; without gradients."""
        flat, normals = self.points.detach().reshape(3, -1), self.normals.detach()
        first = crossings.view * self.points.shape[2]
        # The ends' distances from the pixels' line give the position of the crossing on the edge.
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


def lit_directly(
    points: Float[Tensor, "3 views vertices"],
    normals: Float[Tensor, "3 vertices"],
    corners: Int[Tensor, "3 faces"],
    visible: Visible,
    light: Float[Tensor, "lights views 3"],
    shading: Shading,
) -> Float[Tensor, "lights winners"]:
    """Intensities of the covered pixels on a GPU: each pixel's normal from its own face's corners,
    weighted as in `NormalMatrices`, which share a face's work among its pixels. That would have the
    host wait for the number of faces, and launch ten times as many kernels."""
    height, width = visible.face_ids.shape[1:]
    at_corners = corners.index_select(1, visible.face)
    index = at_corners + visible.view * points.shape[2]
    x, y, w = points.flatten(1).index_select(1, index.view(-1)).unflatten(1, index.shape)
    row = visible.pixel // width
    column = visible.pixel - row * width
    right = torch.addcmul(x, column.to(w) + 0.5, w, value=-1)
    down = torch.addcmul(y, (row % height).to(w) + 0.5, w, value=-1)
    weights = right.roll(1, 0) * down.roll(-1, 0) - right.roll(-1, 0) * down.roll(1, 0)
    at = normals.index_select(1, at_corners.view(-1)).unflatten(1, at_corners.shape)
    normal = (at * weights).sum(1)
    squared = (normal * normal).sum(0)
    normal = normal * torch.where(squared > 0, squared, 1.0).rsqrt()
    lights = light.transpose(1, 2).index_select(2, visible.view)
    return (((lights * normal).sum(1) + shading.ambient) * shading.albedo).clamp(0, 1)


def _lit(normal: Tensor, view: Tensor, light: Tensor, shading: Shading) -> Tensor:
    lit = (normal * light.index_select(1, view).transpose(1, 2)).sum(1)
    return (shading.albedo * (shading.ambient + lit)).clamp(0, 1)


class PickOne(torch.autograd.Function):
    """``values.view(-1)[index]``, with a gradient that is summed without sorting."""

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


@dataclass(frozen=True)
class FacesSeen:
    """The m faces visible at any pixel, sorted by view."""

    corners: list[Int[Tensor, " m"]]
    index: list[Int[Tensor, " m"]]
    """Index of each corner into the flattened (views, V)."""
    column: Float[Tensor, " m"]
    """Centre of a pixel near the face, the origin of its matrix; coordinates relative to the frame
    would lose precision."""
    row: Float[Tensor, " m"]
    at_pixel: Int[Tensor, " winners"]
    """Index into these faces, per covered pixel."""


def faces_seen(
    points: Float[Tensor, "3 views vertices"], corners: Int[Tensor, "3 faces"], visible: Visible
) -> FacesSeen:
    """Collect the visible faces. Without gradients, because normals don't depend on the matrices'
    origins."""
    views, count = points.shape[1:]
    height, width = visible.face_ids.shape[1:]
    key = torch.add(visible.face, visible.view, alpha=corners.shape[1])
    marked = torch.zeros(views * corners.shape[1], dtype=torch.bool, device=key.device)
    marked.scatter_(0, key, True)
    view, face = positions(marked.view(views, -1))
    # Entries of invisible faces are never read.
    place = key.new_empty(marked.shape)
    own = torch.add(face, view, alpha=corners.shape[1])
    place.scatter_(0, own, torch.arange(len(own), device=key.device))
    at_corners = [corner.index_select(0, face) for corner in corners]
    index = [torch.add(corner, view, alpha=count) for corner in at_corners]
    x, y, w = points.detach().view(3, -1).unbind()
    depth = w.index_select(0, index[0])
    column, row = (
        (axis.index_select(0, index[0]) / depth).nan_to_num_(0.0).clamp_(0, size - 1).floor_() + 0.5
        for axis, size in ((x, width), (y, height))
    )
    return FacesSeen(at_corners, index, column, row, place.index_select(0, key))


class NormalMatrices(torch.autograd.Function):
    """Matrix from pixels to interpolated normals, for each visible face.

    Takes the vertices' homogeneous pixels (3, views, V) and unit normals (3, V), and the m faces.
    Returns (9, m): for each axis of the normal, its increments per column and per row, and its
    value at the face's own pixel. The length is arbitrary.

    A vertex's weight is the cross product of the other two vertices' offsets from the pixel's ray,
    ``(x w - column w, y w - row w)``. This is the perspective-correct barycentric coordinate up to
    a common factor, which normalising the normal removes. It needs no division by w, so it is also
    valid for faces that extend behind the camera. It is linear in the pixel, so the work shared by
    a face's pixels is done once.
    """

    @staticmethod
    def forward(ctx: Any, points: Tensor, normals: Tensor, seen: FacesSeen) -> Tensor:
        """Sum the corners' normals, times their weights."""
        ctx.seen, ctx.shapes = seen, (points.shape, normals.shape)
        ctx.known = []
        out = points.new_empty(9, len(seen.column))
        for part in _parts(seen.column):
            known = _at_corners(points, normals, seen, part)
            if any(ctx.needs_input_grad):
                ctx.known.append(known)
            _, weights, at_corners = known
            rows = iter(out[:, part])
            for axes in zip(*at_corners, strict=True):
                for along in zip(*weights, strict=True):
                    _dot(axes, along, out=next(rows))
        return out

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None]:
        """Propagate through the products to normals and positions."""
        seen: FacesSeen = ctx.seen
        to_points, to_normals = (grad.new_zeros(shape) for shape in ctx.shapes)
        point_rows = to_points.view(3, -1).unbind()
        for part, (offsets, weights, at_corners) in zip(
            _parts(seen.column), ctx.known, strict=True
        ):
            column, row = seen.column[part], seen.row[part]
            by_axis = grad[:, part].unflatten(0, (3, 3))
            by_pixel = by_axis.transpose(0, 1)
            to_weights = [[_dot(each, rows) for rows in by_pixel] for each in at_corners]
            for i in range(3):
                j, k = (i + 1) % 3, (i + 2) % 3
                own, index = seen.corners[i][part], seen.index[i][part]
                for into, rows in zip(to_normals, by_axis, strict=True):
                    into.scatter_add_(0, own, _dot(rows, weights[i]))
                # The vertex affects the weights of the other two.
                right, down, depth = _cross(
                    to_weights[k], offsets[j], plus=(offsets[k], to_weights[j])
                )
                depth.addcmul_(right, column, value=-1).addcmul_(down, row, value=-1)
                for into, each in zip(point_rows, (right, down, depth), strict=True):
                    into.scatter_add_(0, index, each)
        return to_points, to_normals, None


def _at_corners(
    points: Tensor, normals: Tensor, seen: FacesSeen, part: slice
) -> tuple[list[list[Tensor]], list[list[Tensor]], list[list[Tensor]]]:
    """For a slice of the faces, each corner's offset from the face's own pixel, its row of the
    matrix from pixels to weights, and its normal."""
    x, y, w = points.view(3, -1).unbind()
    offsets = []
    for each in seen.index:
        index = each[part]
        depth = w.index_select(0, index)
        right = x.index_select(0, index).addcmul_(seen.column[part], depth, value=-1)
        down = y.index_select(0, index).addcmul_(seen.row[part], depth, value=-1)
        offsets.append([right, down, depth])
    # Corners are clockwise on the screen, where rows go down.
    weights = [_cross(offsets[(i + 2) % 3], offsets[(i + 1) % 3]) for i in range(3)]
    at = [[axis.index_select(0, each[part]) for axis in normals] for each in seen.corners]
    return offsets, weights, at


class LightPixels(torch.autograd.Function):
    """Fused evaluation of pixel normals, from their faces' matrices, and of light.

    Takes the ``NormalMatrices`` (9, m) of the visible faces, the faces, the n covered pixels, the
    lights (lights, views, 3), and the two shading constants. Returns intensities (lights, n).
    """

    @staticmethod
    def forward(
        ctx: Any,
        matrices: Tensor,
        seen: FacesSeen,
        visible: Visible,
        light: Tensor,
        albedo: float,
        ambient: float,
    ) -> Tensor:
        """Evaluate normals, then light."""
        ctx.rest = matrices.shape, seen, visible, albedo, ambient
        ctx.known = []
        # Table lookup; integer division takes ten times as long.
        height, width = visible.face_ids.shape[1:]
        column, row = (torch.arange(n, device=light.device).to(light) for n in (width, height))
        centers = (column + 0.5).repeat(height), (row + 0.5).repeat_interleave(width)
        out = matrices.new_empty(len(light), len(visible.pixel))
        for part in _parts(visible.pixel):
            known = _lit_pixels(matrices, seen, visible, centers, light, part)
            if any(ctx.needs_input_grad):
                ctx.known.append(known)
            for row, each in zip(out[:, part], known.lit, strict=True):
                torch.add(each, ambient, out=row).mul_(albedo).clamp_(0, 1)
        return out

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        """Propagate through light and normalisation to the matrices."""
        shape, seen, visible, albedo, ambient = ctx.rest
        to_matrices = grad.new_zeros(shape)
        by_axis = to_matrices.view(3, 3, -1)
        for part, known in zip(_parts(visible.pixel), ctx.known, strict=True):
            to_normal = [torch.zeros_like(known.inverse) for _ in range(3)]
            along = torch.zeros_like(known.inverse)
            for each, axes, towards in zip(known.lit, known.lights, grad[:, part], strict=True):
                raw = (each + ambient).mul_(albedo)
                towards = torch.ops.aten.hardtanh_backward(towards, raw, 0.0, 1.0)
                along.addcmul_(towards, each)
                for into, axis in zip(to_normal, axes, strict=True):
                    into.addcmul_(towards, axis)
            # Normalisation removes the component along the normal itself.
            inverse = known.inverse * albedo
            face = seen.at_pixel[part]
            for rows, into, axis in zip(by_axis, to_normal, known.normal, strict=True):
                into.addcmul_(axis, along, value=-1).mul_(inverse)
                rows[0].scatter_add_(0, face, into * known.right)
                rows[1].scatter_add_(0, face, into * known.down)
                rows[2].scatter_add_(0, face, into)
        return to_matrices, None, None, None, None, None


_AT_ONCE = 1 << 15
"""Pixels, or faces, shaded per batch, so that intermediates fit the cache."""


def _parts(items: Tensor) -> list[slice]:
    return [slice(i, i + _AT_ONCE) for i in range(0, len(items), _AT_ONCE)]


@dataclass(frozen=True)
class _LitPixels:
    """Intermediate values of n pixels; lists have one entry per axis."""

    right: Float[Tensor, " n"]
    """Offset in columns from the face's own pixel."""
    down: Float[Tensor, " n"]
    lights: list[list[Float[Tensor, " n"]]]
    normal: list[Float[Tensor, " n"]]
    inverse: Float[Tensor, " n"]
    """Inverse length of the normal before normalisation."""
    lit: list[Float[Tensor, " n"]]
    """Dot product of the normal with each light."""


def _lit_pixels(
    matrices: Tensor,
    seen: FacesSeen,
    visible: Visible,
    centers: tuple[Tensor, Tensor],
    light: Tensor,
    part: slice,
) -> _LitPixels:
    view, face = visible.view[part], seen.at_pixel[part]
    within = torch.sub(visible.pixel[part], view, alpha=len(centers[0]))
    right, down = (
        center.index_select(0, within).sub_(own.index_select(0, face))
        for center, own in zip(centers, (seen.column, seen.row), strict=True)
    )
    normal = []
    for rows in matrices.view(3, 3, -1):
        by_right, by_down, own = (row.index_select(0, face) for row in rows)
        normal.append(own.addcmul_(by_right, right).addcmul_(by_down, down))
    squared = _dot(normal, normal)
    inverse = squared.rsqrt_().nan_to_num_(nan=math.nan, posinf=1.0)
    for axis in normal:
        axis.mul_(inverse)
    lights = [[axis.index_select(0, view) for axis in each.t().contiguous()] for each in light]
    lit = [_dot(normal, each) for each in lights]
    return _LitPixels(right, down, lights, normal, inverse, lit)


def _dot(a: Sequence[Tensor], b: Sequence[Tensor], out: Tensor | None = None) -> Tensor:
    """``a[0] b[0] + a[1] b[1] + a[2] b[2]``."""
    return torch.mul(a[0], b[0], out=out).addcmul_(a[1], b[1]).addcmul_(a[2], b[2])


def _cross(
    a: Sequence[Tensor], b: Sequence[Tensor], plus: tuple[Sequence[Tensor], ...] = ()
) -> list[Tensor]:
    """``a`` x ``b``, plus the cross product of two others. Faster than the one in `geometry`, which
    is exactly zero for parallel vectors."""
    out = []
    for j, k in ((1, 2), (2, 0), (0, 1)):
        axis = (a[j] * b[k]).addcmul_(a[k], b[j], value=-1)
        if plus:
            c, d = plus
            axis.addcmul_(c[j], d[k]).addcmul_(c[k], d[j], value=-1)
        out.append(axis)
    return out
