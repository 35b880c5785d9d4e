"""Anti-aliased outlines, which carry the gradient of visibility.

An outline is made of contour edges: those of a front face whose neighbour across the edge faces
away or does not exist. Where such an edge passes between the centres of two neighbouring pixels, at
a distance ``s`` (in pixels) from the one on the inside, the part ``s - 0.5`` of the outer pixel takes
the inner pixel's colour or, where that is negative, the part ``0.5 - s`` of the inner pixel takes the
outer one's. The sum over the two moves with ``s`` by their difference in colour, which is the
derivative of what an area-averaging camera sees.

Searching edges rather than the visible triangles' neighbours matters: with faces smaller than
pixels the triangle seen at a pixel centre hardly ever owns the outline next to it. Steep edges are
searched for along rows, the others along columns. Where several edges pass between the same two
pixels only the outermost counts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from styleexp.renderers.soft_raster.raster import ragged

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from torch import Tensor

    from styleexp.renderers.soft_raster.raster import FacePairs, Visible


@dataclass(frozen=True)
class Crossings:
    """Outline edges between two neighbouring pixels, n of them."""

    inner: Int[Tensor, "n"]
    """Index of the pixel on the inside of the edge, into the flattened (views, height, width)."""
    outer: Int[Tensor, "n"]
    start: Int[Tensor, "n"]
    """Index of the edge's first vertex into the flattened (views, vertices)."""
    end: Int[Tensor, "n"]
    center: Float[Tensor, "2 n"]
    """Centre of the inner pixel (column, row)."""
    along_row: Bool[Tensor, "n"]
    """Whether the two pixels are neighbours in a row (or else in a column)."""
    direction: Float[Tensor, "n"]
    """+1 where the outer pixel is to the right or below, -1 where to the left or above."""


def neighbours(faces: Int[Tensor, "faces 3"], count: int) -> Int[Tensor, "3 faces"]:
    """The face across each face's edge ``(k, k + 1)``; the number of faces where there is none.

    The neighbour is the face that has the edge in the opposite direction; of several, one.
    """
    start, end = faces, faces.roll(-1, 1)
    own = (start * count + end).t().reshape(-1)
    opposite = (end * count + start).t().reshape(-1)
    ordered, order = own.sort(stable=True)
    place = torch.searchsorted(ordered, opposite).clamp_max(max(own.numel() - 1, 0))
    if not own.numel():
        return own.view(3, 0)
    found = ordered[place] == opposite
    number = faces.shape[0]
    return torch.where(found, order[place] % number, number).view(3, number)


@torch.no_grad()
def find_crossings(
    points: Float[Tensor, "3 views vertices"],
    corners: Int[Tensor, "3 faces"],
    across: Int[Tensor, "3 faces"],
    front: Bool[Tensor, "views faces"],
    pairs: FacePairs,
    visible: Visible,
    near: float,
) -> Crossings:
    """All places where a visible contour edge separates two pixels."""
    start, end, view = _contour_edges(points, corners, across, front, pairs)
    found = _pixel_pairs(points, start, end, view, near, visible.depth)
    return _outermost(found, visible.depth)


def _contour_edges(
    points: Tensor, corners: Tensor, across: Tensor, front: Tensor, pairs: FacePairs
) -> tuple[Tensor, Tensor, Tensor]:
    """Edges (start, end as indices into (views, vertices), and view) of front faces only."""
    views, number = front.shape
    known = torch.cat([front, front.new_zeros(views, 1)], dim=1).view(-1)
    first = pairs.view * (number + 1)
    starts, ends, seen = [], [], []
    for k in range(3):
        beyond = first + across[k].index_select(0, pairs.face)
        edge = (~known.index_select(0, beyond)).nonzero().view(-1)
        view, face = pairs.view[edge], pairs.face[edge]
        base = view * points.shape[2]
        starts.append(base + corners[k].index_select(0, face))
        ends.append(base + corners[(k + 1) % 3].index_select(0, face))
        seen.append(view)
    return torch.cat(starts), torch.cat(ends), torch.cat(seen)


def _pixel_pairs(
    points: Tensor, start: Tensor, end: Tensor, view: Tensor, near: float, depth: Tensor
) -> tuple[Crossings, Tensor, Tensor]:
    """Pixel pairs that the edges pass between; also ``s`` and 1/w there. Not yet tested for sight."""
    height, width = depth.shape[1:]
    flat = points.reshape(3, -1)
    a, b = flat.index_select(1, start), flat.index_select(1, end)
    # Only the part in front of the near plane is searched; the crossing is that of the whole line.
    rise = b[2] - a[2]
    cut = a + ((near - a[2]) / torch.where(rise == 0, 1.0, rise)) * (b - a)
    a_front, b_front = a[2] >= near, b[2] >= near
    p, q = torch.where(a_front, a, cut), torch.where(b_front, b, cut)
    p, q = p[:2] / p[2].clamp_min(near), q[:2] / q[2].clamp_min(near)
    dx, dy = q - p
    along_row = dy.abs() >= dx.abs()

    # Scan lines: rows for steep edges, columns for the others.
    low, high = torch.minimum(p, q), torch.maximum(p, q)
    lines = torch.where(along_row, height, width).to(p.dtype)
    first = torch.ceil(torch.where(along_row, low[1], low[0]) - 0.5).clamp_min(0)
    last = torch.ceil(torch.where(along_row, high[1], high[0]) - 0.5).minimum(lines) - 1
    counts = torch.where(a_front | b_front, last - first + 1, 0.0).clamp_min(0).long()
    owner, step = ragged(counts)

    along_row = along_row[owner]
    line = first.long()[owner] + step
    dx, dy = dx[owner], dy[owner]
    run, rise = torch.where(along_row, dx, dy), torch.where(along_row, dy, dx)
    from_p, from_line = torch.where(along_row, p[:, owner], p[:, owner].flip(0))
    share = ((line.to(p.dtype) + 0.5 - from_line) / rise).clamp(0, 1)
    crossing = from_p + share * run
    # The pair's first pixel is left of, or above, the crossing.
    before = torch.floor(crossing - 0.5)
    limit = torch.where(along_row, width, height) - 1
    kept = ((before >= 0) & (before < limit)).nonzero().view(-1)
    owner, along_row, line, share = owner[kept], along_row[kept], line[kept], share[kept]
    crossing, before = crossing[kept], before[kept]
    # Counter-clockwise front faces are right of edges that go down (dy > 0), above those that go right.
    inner_after = torch.where(along_row, dy[kept] > 0, dx[kept] < 0)
    fraction = crossing - before - 0.5
    distance = torch.where(inner_after, 1 - fraction, fraction)

    base = view[owner] * (height * width)
    stride = torch.where(along_row, 1, width)
    pixel = base + torch.where(along_row, line * width, line) + before.long() * stride
    inner = torch.where(inner_after, pixel + stride, pixel)
    outer = torch.where(inner_after, pixel, pixel + stride)
    inner_step = (before + inner_after.to(before.dtype)) + 0.5
    center_line = line.to(before.dtype) + 0.5
    center = torch.stack(
        [
            torch.where(along_row, inner_step, center_line),
            torch.where(along_row, center_line, inner_step),
        ]
    )
    direction = torch.where(inner_after, -1.0, 1.0).to(points.dtype)
    inverse = torch.lerp(
        1 / torch.where(a_front, a[2], near)[owner],
        1 / torch.where(b_front, b[2], near)[owner],
        share,
    )
    found = Crossings(inner, outer, start[owner], end[owner], center, along_row, direction)
    return found, distance, inverse


def _outermost(found: tuple[Crossings, Tensor, Tensor], depth: Tensor) -> Crossings:
    """Keep what is in front of the farther pixel, and of that the outermost edge of each pair."""
    crossings, distance, inverse_w = found
    flat = depth.reshape(-1)
    inner_depth, outer_depth = flat[crossings.inner], flat[crossings.outer]
    seen = (inner_depth < outer_depth) & (inverse_w * outer_depth > 1)
    # Of a row's and a column's pair the first pixel is the same; tell them apart by the parity.
    pair = torch.minimum(crossings.inner, crossings.outer) * 2 + crossings.along_row
    bits = distance.float().clamp(0, 1).view(torch.int32).long()
    rank = torch.arange(bits.numel(), device=bits.device)
    key = torch.where(seen, ((bits + 1) << 32) | rank, 0)
    best = key.new_zeros(2 * flat.numel())
    best.scatter_reduce_(0, pair, key, "amax")
    kept = (seen & (best[pair] == key)).nonzero().view(-1)
    return Crossings(
        crossings.inner[kept],
        crossings.outer[kept],
        crossings.start[kept],
        crossings.end[kept],
        crossings.center[:, kept],
        crossings.along_row[kept],
        crossings.direction[kept],
    )


class CrossingDistance(torch.autograd.Function):
    """Distance in pixels from each inner pixel's centre to its edge, towards the outer pixel.

    Takes homogeneous pixels (3, views, V) and ``Crossings``; returns (n). With the vertices' offsets
    from the pixel's ray, ``(x w - column w, y w - row w)``, the line through both needs no division
    by their depths, and so holds for edges that reach behind the camera.
    """

    @staticmethod
    def forward(ctx: Any, points: Tensor, crossings: Crossings) -> Tensor:
        """Intersect the edge's line with the pixel's row or column."""
        flat = points.reshape(3, -1)
        a, b = flat.index_select(1, crossings.start), flat.index_select(1, crossings.end)
        center = crossings.center
        a_offset, b_offset = a[:2] - center * a[2], b[:2] - center * b[2]
        along_row = crossings.along_row
        # u runs from pixel to pixel, v is 0 on their line.
        a_u, a_v = torch.where(along_row, a_offset, a_offset.flip(0))
        b_u, b_v = torch.where(along_row, b_offset, b_offset.flip(0))
        below = a[2] * b_v - b[2] * a_v
        usable = below != 0
        scale = torch.where(usable, crossings.direction / torch.where(usable, below, 1.0), 0.0)
        distance = (a_u * b_v - b_u * a_v) * scale
        # Rounding may put it a hair outside of the pair.
        within = (distance >= 0) & (distance <= 1)
        ctx.crossings, ctx.shape = crossings, points.shape
        ctx.save_for_backward(
            a[2], b[2], a_u, a_v, b_u, b_v, scale, distance * crossings.direction, within
        )
        return distance.clamp(0, 1)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        """Quotient rule, summed into the two vertices."""
        a_w, b_w, a_u, a_v, b_u, b_v, scale, offset, within = ctx.saved_tensors
        crossings: Crossings = ctx.crossings
        above = grad * scale
        below = -above * offset
        out = grad.new_zeros(ctx.shape)
        flat = out.view(3, -1)
        for index, u, v, w in (
            (crossings.start, b_v * above, -b_u * above - b_w * below, b_v * below),
            (crossings.end, -a_v * above, a_u * above + a_w * below, -a_v * below),
        ):
            x, y = torch.where(crossings.along_row, u, v), torch.where(crossings.along_row, v, u)
            w = w - x * crossings.center[0] - y * crossings.center[1]
            for axis, value in enumerate((x, y, w)):
                flat[axis].index_add_(0, index, value)
        return out, None


class Blend(torch.autograd.Function):
    """Mix pixels across outlines: values (channels, pixels), distances (n), inner and outer (n).

    A pixel takes the part ``|s - 0.5|`` of its neighbour; if its neighbours' parts come to more than
    one they are scaled to one, so that a result never leaves the range of what it mixes.
    """

    @staticmethod
    def forward(ctx: Any, values: Tensor, distance: Tensor, inner: Tensor, outer: Tensor) -> Tensor:
        """Add each part of the difference to the neighbour's colour."""
        shrinks = distance < 0.5
        target, source = torch.where(shrinks, inner, outer), torch.where(shrinks, outer, inner)
        part = (distance - 0.5).abs()
        total = part.new_zeros(values.shape[1]).index_add_(0, target, part).index_select(0, target)
        scale = 1 / total.clamp_min(1)
        difference = values.index_select(1, source) - values.index_select(1, target)
        change = difference * (part * scale)
        out = values.clone()
        for channel, row in enumerate(change):
            out[channel].index_add_(0, target, row)
        moved = out.index_select(1, target) - values.index_select(1, target)
        ctx.save_for_backward(
            target,
            source,
            part * scale,
            scale,
            difference,
            torch.where(total > 1, moved, 0.0),
            shrinks,
        )
        return out

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None, None]:
        """Colours pass through to both pixels, distances feel the difference."""
        target, source, weight, scale, difference, excess, shrinks = ctx.saved_tensors
        at_target = grad.index_select(1, target)
        to_part = (at_target * (difference - excess)).sum(0) * scale
        to_distance = torch.where(shrinks, -to_part, to_part)
        to_values = grad.clone()
        for channel, row in enumerate(at_target * weight):
            to_values[channel].index_add_(0, source, row)
            to_values[channel].index_add_(0, target, row, alpha=-1)
        return to_values, to_distance, None, None
