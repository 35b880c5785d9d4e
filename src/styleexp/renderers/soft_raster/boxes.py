"""Visibility on a GPU: the visible face per pixel, from all pixels of the triangles' boxes.

The same answer as `raster`'s, found in another way: a GPU tests every pixel of a triangle's
bounding box in less time than its host takes to launch the kernels that would find the spans. The
host waits twice per render, for the number of these pixels and for that of the covered ones; once
more if a face crosses the near plane.

Watertight too: which side of an edge a pixel centre is on is computed relative to the edge's
midpoint, and so, for the triangle across the edge, with exactly the opposite sign.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from styleexp.renderers.soft_raster.raster import Visible, clipped

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from torch import Tensor

    from styleexp.renderers.soft_raster.culling import FacePairs

AT_ONCE = 1 << 24
"""Pixels of boxes tested per batch, of about 250 bytes each: bounds memory."""
_MARGIN = 0.01
"""Pixels by which a box is larger than its triangle, since rounding may move an edge."""


@dataclass(frozen=True)
class _Boxes:
    """Triangles in pixel coordinates, and the pixels that each may cover."""

    screen: Float[Tensor, "3 points"]
    """Column, row and 1/w of corners."""
    index: Int[Tensor, "3 triangles"]
    """Each triangle's corners among them."""
    first: Float[Tensor, "2 triangles"]
    """Column and row of the box's first pixel."""
    columns: Int[Tensor, " triangles"]
    count: Int[Tensor, " triangles"]
    """Number of the box's pixels, and its running total."""
    ends: Int[Tensor, " triangles"]
    begun: Int[Tensor, " triangles"]
    """Index of the view's first pixel into the flattened (views, height, width)."""
    low: Int[Tensor, " triangles"]
    """Lower half of the depth test's key: the inverted face index."""


def rasterise(
    points: Float[Tensor, "3 views vertices"],
    corners: Int[Tensor, "3 faces"],
    pairs: FacePairs,
    near: float,
    resolution: tuple[int, int],
) -> Visible:
    """Find the nearest face at every pixel centre; ties go to the lowest face index."""
    views, count = points.shape[1:]
    height, width = resolution
    faces = corners.shape[1]
    best = torch.zeros(views * height * width, dtype=torch.int64, device=points.device)
    if best.numel() and faces:
        inverse = 1 / points[2:]
        screen = torch.cat([points[:2] * inverse, inverse]).view(3, -1)
        each = torch.arange(views, device=points.device)[:, None]
        index = (corners[:, None] + each * count).view(3, -1)
        begun = (each * (height * width)).expand(views, faces).reshape(-1)
        low = (-1 - torch.arange(faces, device=points.device)).bitwise_and_(0xFFFFFFFF)
        assert pairs.crossing is not None
        crossing, whole = pairs.chosen & pairs.crossing, pairs.chosen & ~pairs.crossing
        boxes = _boxes(screen, index, whole.view(-1), begun, low.repeat(views), resolution)
        told = torch.stack([boxes.ends[-1], crossing.sum()])
        total, cut = told.tolist()
        _fill(best, boxes, total, width)
        if cut:
            ends = crossing.view(-1).cumsum(0)
            # Where each is, without waiting for a size that is known already.
            places = torch.searchsorted(ends, torch.arange(1, cut + 1, device=ends.device))
            _fill_clipped(best, points, boxes, places, near, resolution)
    return _winners(best, (views, height, width), points.dtype)


def _fill_clipped(
    best: Tensor,
    points: Tensor,
    boxes: _Boxes,
    chosen: Int[Tensor, " crossing"],
    near: float,
    resolution: tuple[int, int],
) -> None:
    """Depth test of the ``chosen`` triangles, which cross the near plane, cut there."""
    at = boxes.index.index_select(1, chosen)
    homogeneous = points.reshape(3, -1).index_select(1, at.view(-1)).view(3, 3, -1)
    screen = clipped(homogeneous.transpose(0, 1), near).reshape(3, -1)
    index = torch.arange(screen.shape[1], device=screen.device).view(3, -1)
    begun, low = (each.index_select(0, chosen).repeat(2) for each in (boxes.begun, boxes.low))
    cut = _boxes(screen, index, None, begun, low, resolution)
    _fill(best, cut, int(cut.ends[-1]), resolution[1])


def _boxes(
    screen: Tensor,
    index: Tensor,
    counted: Bool[Tensor, " triangles"] | None,
    begun: Tensor,
    low: Tensor,
    resolution: tuple[int, int],
) -> _Boxes:
    """Boxes of the triangles within the frame; those that aren't ``counted``, or have a NaN corner,
    have no pixels."""
    height, width = resolution
    low_corner, high_corner = (
        screen[:2].index_select(1, index.view(-1)).view(2, 3, -1).aminmax(dim=1)
    )
    first = low_corner.sub_(0.5 + _MARGIN).ceil_().clamp_min_(0)
    beyond = high_corner.sub_(0.5 - _MARGIN).ceil_()
    beyond[0].clamp_max_(width)
    beyond[1].clamp_max_(height)
    size = beyond.sub_(first).nan_to_num_(nan=0.0, posinf=0.0, neginf=0.0).clamp_min_(0).long()
    area = size[0] * size[1]
    if counted is not None:
        area = area * counted
    return _Boxes(screen, index, first, size[0], area, area.cumsum(0), begun, low)


def _fill(best: Tensor, boxes: _Boxes, total: int, width: int) -> None:
    """Depth test of all pixels of the boxes."""
    if not total:
        return
    if total <= AT_ONCE:
        _test(best, boxes, slice(None), 0, total, width)
        return
    marks = torch.arange(AT_ONCE, total, AT_ONCE, device=best.device)
    stops = torch.searchsorted(boxes.ends, marks, right=True)
    reached = torch.cat([stops.new_zeros(1), boxes.ends]).index_select(0, stops)
    begin = before = 0
    found = torch.stack([stops, reached], 1).tolist()
    for end, after in [*found, [len(boxes.ends), total]]:
        if after > before:
            _test(best, boxes, slice(begin, end), before, after - before, width)
        begin, before = end, after


def _test(best: Tensor, boxes: _Boxes, part: slice, before: int, total: int, width: int) -> None:
    """Depth test of the pixels of some of the boxes, ``total`` in number, after ``before`` others.

    Positive floats sort like their bits; the inverted face index in the lower bits breaks ties.
    """
    count = boxes.count[part]
    owner = torch.repeat_interleave(count, output_size=total)
    begun = (boxes.ends[part] - count).index_select(0, owner)
    place = torch.arange(before, before + total, device=best.device).sub_(begun)
    wide = boxes.columns[part].index_select(0, owner)
    down = place // wide
    step = torch.stack([place - down * wide, down])
    first = boxes.first[:, part].index_select(1, owner)
    pixel = step + first.long()
    center = pixel.to(first.dtype) + 0.5

    index = boxes.index[:, part].index_select(1, owner)
    x, y, inverse_w = boxes.screen.index_select(1, index.view(-1)).view(3, 3, -1)
    corner = torch.stack([x, y])
    following = corner.roll(-1, 1)
    along = following - corner
    offset = center[:, None] - (corner + following) * 0.5
    side = offset[0] * along[1] - offset[1] * along[0]
    # The top-left rule: a downward edge owns the pixels on it, as does one along the top.
    owns = torch.where(along[1] == 0, along[0] < 0, along[1] > 0)
    inside = torch.where(owns, side >= 0, side > 0).all(0)
    # An edge's side is the opposite corner's weight; 1/w is linear in the image.
    at_pixel = (side * inverse_w.roll(1, 0)).sum(0) / side.sum(0)

    key = boxes.low[part].index_select(0, owner)
    key.add_(at_pixel.float().view(torch.int32), alpha=1 << 32).mul_(inside)
    place = boxes.begun[part].index_select(0, owner).add_(pixel[0]).add_(pixel[1], alpha=width)
    best.scatter_reduce_(0, place, key, "amax")


def _winners(best: Tensor, shape: tuple[int, int, int], dtype: torch.dtype) -> Visible:
    """Unpack the keys; the background's key, 0, is face -1 at infinity."""
    high = best.view(torch.int32).view(-1, 2)[:, 1]
    pixel = high.nonzero().view(-1)
    depth = high.contiguous().view(torch.float32).reciprocal().to(dtype)
    face_ids = best.bitwise_not_().bitwise_left_shift_(32).bitwise_right_shift_(32)
    face = face_ids.index_select(0, pixel)
    return Visible(
        face_ids.view(shape), depth.view(shape), pixel, pixel // (shape[1] * shape[2]), face
    )
