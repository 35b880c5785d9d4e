"""Visibility: the visible face per pixel. Not differentiated.

Faces are projected to triangles in pixel coordinates (``Triangles``), clipped at the near plane. In
each pixel row a triangle is a span between two edges; the nearest span at each pixel wins.

Spans are watertight: an edge's crossing with a row is bit-identical from both sides, because it is
anchored at the edge's midpoint, and a pixel centre on an edge is assigned by the top-left rule.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from styleexp.renderers.soft_raster import culling
from styleexp.renderers.soft_raster.culling import rows_of, true_indices

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from torch import Tensor

    from styleexp.renderers.soft_raster.culling import FacePairs

_AT_ONCE = 1 << 16
"""Triangles per batch when finding spans, so that intermediates fit the cache."""
_FAR = 1e30
"""Offset that excludes an edge's crossing from a maximum or minimum."""


@dataclass(frozen=True)
class Triangles:
    """Triangles in pixel coordinates, one array per corner."""

    x: Sequence[Float[Tensor, " triangles"]]
    y: Sequence[Float[Tensor, " triangles"]]
    inverse_w: Sequence[Float[Tensor, " triangles"]]
    view: Int[Tensor, " triangles"]
    face: Int[Tensor, " triangles"]


@dataclass(frozen=True)
class Visible:
    """Winners of the depth test, as images and as lists of the covered pixels."""

    face_ids: Int[Tensor, "views height width"]
    depth: Float[Tensor, "views height width"]
    pixel: Int[Tensor, " winners"]
    """Index of each covered pixel into the flattened (views, height, width)."""
    view: Int[Tensor, " winners"]
    face: Int[Tensor, " winners"]


def rasterise(
    points: Float[Tensor, "3 views vertices"],
    corners: Int[Tensor, "3 faces"],
    pairs: FacePairs,
    near: float,
    resolution: tuple[int, int],
) -> Visible:
    """Find the nearest face at every pixel centre; ties go to the lowest face index."""
    views = points.shape[1]
    height, width = resolution
    best = torch.zeros(views * height * width, dtype=torch.int64, device=points.device)
    triangles = _triangles(points, corners, pairs, near)
    first, rows = _rows(triangles, resolution)
    for begin in range(0, len(rows), _AT_ONCE):
        order, groups = _by_count(rows[begin : begin + _AT_ONCE])
        setup = _set_up(triangles, first, order.add_(begin), resolution)
        found, held = [], 0
        for count, part in groups:
            found.append(_spans(setup, part, count, width))
            held += len(found[-1].start)
            if held > culling.CHUNK:
                _fill(best, found)
                found, held = [], 0
        _fill(best, found)
    return _winners(best, (views, height, width), points.dtype)


def _triangles(points: Tensor, corners: Tensor, pairs: FacePairs, near: float) -> Triangles:
    """Project the pairs to the image, clipping those that cross the near plane."""
    views, count = points.shape[1:]
    flat = points.reshape(3, views * count)
    first = pairs.view * count
    index = [corner.index_select(0, pairs.face).add_(first) for corner in corners]
    inverse = 1 / flat[2]
    x, y = flat[0] * inverse, flat[1] * inverse
    whole = Triangles(
        [x.index_select(0, i) for i in index],
        [y.index_select(0, i) for i in index],
        [inverse.index_select(0, i) for i in index],
        pairs.view,
        pairs.face,
    )
    crossing = pairs.needs_clipping.nonzero().view(-1)
    if not crossing.numel():
        return whole
    rest = (~pairs.needs_clipping).nonzero().view(-1)
    view, face = pairs.view[crossing], pairs.face[crossing]
    homogeneous = torch.stack([flat.index_select(1, i[crossing]) for i in index])
    cut_off = clipped(homogeneous, near)
    both = [
        [torch.cat([row[rest], cut]) for row, cut in zip(rows, parts, strict=True)]
        for rows, parts in zip((whole.x, whole.y, whole.inverse_w), cut_off, strict=True)
    ]
    view = torch.cat([pairs.view[rest], view, view])
    return Triangles(both[0], both[1], both[2], view, torch.cat([pairs.face[rest], face, face]))


def clipped(corners: Float[Tensor, "3 3 n"], near: float) -> Float[Tensor, "3 3 2n"]:
    """Clip triangles, given as (corner, coordinate, triangle), at ``w = near`` and project them.

    Returns (coordinate, corner, triangle) of x, y and 1/w; two triangles each, the second with zero
    area if the front part is itself a triangle.
    """
    in_front = corners[:, 2] >= near
    number = in_front.sum(0)
    # Rotate each triangle's corners so that those in front come first: one (a), or two (a, b).
    ahead = in_front & ~in_front.roll(1, 0)
    start = ahead.byte().argmax(0)
    order = (start + torch.arange(3, device=start.device)[:, None]) % 3
    a, b, c = corners.gather(0, order[:, None, :].expand_as(corners))
    two = number == 2
    on_ab, on_bc, on_ca = _cut(a, b, near), _cut(b, c, near), _cut(c, a, near)
    second = torch.where(two, b, on_ab)
    third = torch.where(two, on_bc, on_ca)
    polygons = torch.stack([torch.stack([a, second, third]), torch.stack([a, third, on_ca])], -1)
    x, y, w = polygons.movedim(-1, -2).flatten(-2).unbind(1)
    inverse = 1 / w
    return torch.stack([x * inverse, y * inverse, inverse])


def _cut(a: Float[Tensor, "3 n"], b: Float[Tensor, "3 n"], near: float) -> Float[Tensor, "3 n"]:
    """Intersection of an edge with the near plane, bit-identical from either side of the edge."""
    forward = a[2] < b[2]
    low, high = torch.where(forward, a, b), torch.where(forward, b, a)
    rise = high[2] - low[2]
    share = torch.where(rise > 0, (near - low[2]) / rise, 0.0)
    point = low + share * (high - low)
    point[2] = near
    return point


def _rows(
    t: Triangles, resolution: tuple[int, int]
) -> tuple[Float[Tensor, " triangles"], Int[Tensor, " triangles"]]:
    """First row of pixel centres that each triangle may contain, and the number of rows.

    The top is inclusive, the bottom exclusive. There are none if the triangle lies between two
    columns or has a NaN corner.
    """
    height, width = resolution
    top, bottom = _range(t.y)
    first = top.sub_(0.5).ceil_().clamp_(0, height)
    count = bottom.sub_(0.5).ceil_().clamp_(0, height).sub_(first)
    # Rounding may move a crossing, so only drop triangles clearly between columns.
    left, right = _range(t.x)
    left, right = (
        left.sub_(0.51).ceil_().clamp_(0, width),
        right.sub_(0.49).ceil_().clamp_(0, width),
    )
    return first, count.mul_(right > left).nan_to_num_(nan=0.0).to(torch.int32)


def _by_count(counts: Int[Tensor, " n"]) -> tuple[Int[Tensor, " m"], list[tuple[int, slice]]]:
    """Sort the m non-empty items by their number of elements, ``counts``; also return the slices of
    this order with equal counts.

    Each slice is processed as one dense array of not many more than culling.CHUNK elements.
    """
    if counts.device.type == "cpu":  # numpy uses radix sort for short integers
        most = int(counts.max()) if len(counts) else 0
        kind = torch.uint8 if most < 1 << 8 else torch.int16 if most < 1 << 15 else torch.int32
        short = counts.to(kind)
        order = torch.from_numpy(np.argsort(short.numpy(), kind="stable"))
    else:
        order = counts.argsort(stable=True)
    per_count = torch.bincount(counts).tolist()
    order = order[sum(per_count[:1]) :]
    parts, begin = [], 0
    for count, size in enumerate(per_count[1:], 1):
        end = begin + size
        most = max(1, culling.CHUNK // count)
        parts += [(count, slice(i, min(i + most, end))) for i in range(begin, end, most)]
        begin = end
    return order, parts


@dataclass(frozen=True)
class _Edges:
    """One edge of each triangle. It crosses row ``y`` at ``x + (y - middle_y) * slope``.

    ``x`` is ``left`` for edges that bound a triangle on its left, ``right`` for those on its right;
    otherwise it is so far away that the edge bounds nothing. A downward edge has the triangle to
    its right and owns pixels on it; an upward edge has it to its left. Horizontal edges bound no
    row; they are handled by the range of rows.
    """

    left: Float[Tensor, " triangles"]
    right: Float[Tensor, " triangles"]
    middle_y: Float[Tensor, " triangles"]
    slope: Float[Tensor, " triangles"]


@dataclass(frozen=True)
class _Setup:
    """Per-triangle setup of the rasteriser."""

    edges: tuple[_Edges, ...]
    first: Float[Tensor, " triangles"]
    """First row."""
    start: Int[Tensor, " triangles"]
    """Index of the first row's first pixel into the flattened (views, height, width)."""
    low: Int[Tensor, " triangles"]
    """Lower half of the depth test's key: the inverted face index."""
    x: Float[Tensor, " triangles"]
    y: Float[Tensor, " triangles"]
    inverse_w: Float[Tensor, " triangles"]
    """1/w at ``(x, y)``; it is linear in the image."""
    slope_x: Float[Tensor, " triangles"]
    slope_y: Float[Tensor, " triangles"]
    lowest: Float[Tensor, " triangles"]
    """Bounds of 1/w from the corners, because a sliver's slopes are unreliable."""
    highest: Float[Tensor, " triangles"]


def _set_up(
    t: Triangles, first: Tensor, order: Int[Tensor, " m"], resolution: tuple[int, int]
) -> _Setup:
    """Set up the triangles, in the given order."""
    height, width = resolution
    x, y, q = ([row.index_select(0, order) for row in each] for each in (t.x, t.y, t.inverse_w))
    view, face, first = (each.index_select(0, order) for each in (t.view, t.face, first))
    edges = []
    for a, b in ((0, 1), (1, 2), (2, 0)):
        dx, dy = x[b] - x[a], y[b] - y[a]
        middle_x, middle_y = (x[a] + x[b]).mul_(0.5), (y[a] + y[b]).mul_(0.5)
        left = middle_x.sub((dy <= 0).to(dx.dtype), alpha=_FAR)
        right = middle_x.add((dy >= 0).to(dx.dtype), alpha=_FAR)
        slope = dx.div_(dy).nan_to_num_(nan=0.0, posinf=0.0, neginf=0.0)
        edges.append(_Edges(left, right, middle_y, slope))
    x1, x2, y1, y2 = x[1] - x[0], x[2] - x[0], y[1] - y[0], y[2] - y[0]
    q1, q2 = q[1] - q[0], q[2] - q[0]
    scale = (x1 * y2).sub_(x2 * y1).reciprocal_().nan_to_num_(posinf=0.0, neginf=0.0)
    slope_x = (q1 * y2).sub_(q2 * y1).mul_(scale)
    slope_y = (q2 * x1).sub_(q1 * x2).mul_(scale)
    start = view.mul_(height).add_(first.long()).mul_(width)
    return _Setup(
        tuple(edges),
        first,
        start,
        face.bitwise_not_().bitwise_and_(0xFFFFFFFF),
        x[0],
        y[0],
        q[0],
        slope_x,
        slope_y,
        *_range(q),
    )


def _range(corners: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    a, b, c = corners
    return torch.minimum(torch.minimum(a, b), c), torch.maximum(torch.maximum(a, b), c)


@dataclass(frozen=True)
class _Spans:
    """Spans: runs of pixels of one row inside a triangle."""

    start: Int[Tensor, " spans"]
    """Index of the first pixel into the flattened (views, height, width)."""
    count: Int[Tensor, " spans"]
    inverse_w: Float[Tensor, " spans"]
    """1/w at the centre of the first pixel."""
    slope: Float[Tensor, " spans"]
    """Increment of 1/w per pixel."""
    low: Int[Tensor, " spans"]


def _spans(setup: _Setup, part: slice, rows: int, width: int) -> _Spans:
    """Spans of triangles that cover equally many rows, as dense arrays of (rows, triangles)."""
    s = replace(setup, **{f.name: getattr(setup, f.name)[part] for f in fields(setup)[1:]})
    step = torch.arange(rows, device=s.x.device)[:, None]
    y = s.first + (step + 0.5).to(s.x.dtype)
    begins, beyonds = [], []
    for edges in setup.edges:
        crossing = (y - edges.middle_y[part]).mul_(edges.slope[part])
        begins.append(crossing + edges.left[part])
        beyonds.append(crossing.add_(edges.right[part]))
    begin = functools.reduce(torch.maximum, begins)
    beyond = functools.reduce(torch.minimum, beyonds)
    for end in (begin, beyond):
        end.sub_(0.5).ceil_().clamp_(0, width)
    # Edges at an infinite corner may not cross a row: no span then.
    count = beyond.sub_(begin).nan_to_num_(nan=0.0).clamp_min_(0)
    steps = (count - 1).clamp_min_(0)
    by_y = (y - s.y).mul_(s.slope_y).add_(s.inverse_w)
    x = (begin - s.x).add_(0.5)
    left = (x * s.slope_x).add_(by_y).nan_to_num_()
    right = x.add_(steps).mul_(s.slope_x).add_(by_y).nan_to_num_()
    left, right = torch.clamp(left, s.lowest, s.highest), torch.clamp(right, s.lowest, s.highest)
    slope = right.sub_(left).div_(steps.clamp_min_(1))
    return _Spans(
        begin.long().add_(s.start + step * width).view(-1),
        count.to(torch.int32).view(-1),
        left.float().view(-1),
        slope.float().view(-1),
        s.low.expand(rows, -1).reshape(-1),
    )


def _fill(best: Tensor, found: list[_Spans]) -> None:
    """Depth test of all pixels in spans.

    Positive floats sort like their bits; the inverted face index in the lower bits breaks ties.
    """
    if not found:
        return
    every = [torch.cat([getattr(each, f.name) for each in found]) for f in fields(_Spans)]
    order, groups = _by_count(every[1])
    start, _, inverse_w, slope, low = (each.index_select(0, order) for each in every)
    for count, part in groups:
        step = torch.arange(count, device=best.device)[:, None]
        pixel = start[part] + step
        at_pixel = torch.addcmul(inverse_w[part], slope[part], step.float())
        key = torch.add(low[part], at_pixel.view(torch.int32), alpha=1 << 32)
        best.scatter_reduce_(0, pixel.view(-1), key.view(-1), "amax")


def _winners(best: Tensor, shape: tuple[int, int, int], dtype: torch.dtype) -> Visible:
    """Unpack the keys; the background's key, 0, is face -1 at infinity."""
    # Copy even a single number, which counts as contiguous; torch is little-endian.
    high = best.view(torch.int32).view(-1, 2)[:, 1].clone(memory_format=torch.contiguous_format)
    pixel = true_indices(high != 0)
    view = rows_of(pixel, shape[0], shape[1] * shape[2])
    depth = high.view(torch.float32).reciprocal_().to(dtype)
    face_ids = best.bitwise_not_().bitwise_left_shift_(32).bitwise_right_shift_(32)
    face = face_ids.index_select(0, pixel)
    return Visible(face_ids.view(shape), depth.view(shape), pixel, view, face)
