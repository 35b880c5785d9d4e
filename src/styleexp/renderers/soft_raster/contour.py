"""Anti-aliased outlines with visibility gradients.

An outline consists of contour edges: edges of a front face whose neighbour faces away or doesn't
exist. Consider such an edge between two neighbouring pixel centres, at a distance ``s`` (in pixels)
from the inner one. If ``s > 0.5``, the outer pixel is blended with the inner colour by ``s - 0.5``;
otherwise the inner pixel is blended with the outer colour by ``0.5 - s``. The derivative of the two
pixels' sum by ``s`` is their difference in colour, as for an area-averaging camera.

All contour edges are searched, not only those of visible triangles: if faces are smaller than
pixels, the triangle visible at a pixel centre rarely owns the outline next to it. If several edges
pass between two pixels, only the outermost counts. For each edge, only pixel pairs in rows (for
steep edges) or only pairs in columns are used.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import torch

from styleexp.renderers.soft_raster.culling import chunks, positions, ragged, take, true_indices

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from torch import Tensor

    from styleexp.renderers.soft_raster.culling import FacePairs
    from styleexp.renderers.soft_raster.raster import Visible


MOST_CROSSINGS = 1 << 20
"""Number of crossings above which all but the outermost per pixel pair are dropped: bounds
memory."""


@dataclass(frozen=True)
class Crossings:
    """n outline edges, each between two neighbouring pixels."""

    inner: Int[Tensor, " n"]
    """Index of the pixel inside the edge, into the flattened (views, height, width)."""
    outer: Int[Tensor, " n"]
    start: Int[Tensor, " n"]
    """Index of the edge's first vertex into the flattened (views, vertices)."""
    end: Int[Tensor, " n"]
    center: Float[Tensor, "2 n"]
    """Centre of the inner pixel (column, row)."""
    along_row: Bool[Tensor, " n"]
    """Whether the two pixels are neighbours in a row; otherwise, in a column."""
    direction: Float[Tensor, " n"]
    """+1 if the outer pixel is to the right or below, -1 if to the left or above."""
    view: Int[Tensor, " n"]
    face: Int[Tensor, " n"]
    """The front face that owns the edge."""


_Found = tuple[Crossings, "Tensor", "Tensor"]


def neighbours(faces: Int[Tensor, "faces 3"], count: int) -> Int[Tensor, "3 faces"]:
    """The face across each face's edge ``(k, k + 1)``; the number of faces if there is none.

    The neighbour is a face that has the edge in the opposite direction; if there are several, any
    of them.
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


@dataclass(frozen=True)
class _Segments:
    """m edges, clipped at the near plane, and the scan lines they cross."""

    p: Float[Tensor, "3 m"]
    """One end, in pixels along and across the lines, and 1/w; ``q`` is the other end."""
    q: Float[Tensor, "3 m"]
    view: Int[Tensor, " m"]
    face: Int[Tensor, " m"]
    start: Int[Tensor, " m"]
    end: Int[Tensor, " m"]
    preferred: Bool[Tensor, " m"]
    """Whether the scan lines cross the edge at the larger angle."""
    first: Float[Tensor, " m"]
    """First scan line on which it passes between pixel centres."""
    count: Int[Tensor, " m"]
    """Number of scan lines."""


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
    """Find all visible contour edges that separate two pixels."""
    edges = _contour_edges(points, corners, across, front, pairs.chosen)
    ends = _ends(points, edges, near)
    found: list[_Found] = []
    held = 0
    # An edge competes to be outermost in both directions, though only one is used.
    both = [_segments(ends, edges, visible.depth, along_row) for along_row in (True, False)]
    for along_row, segments, parts in zip((True, False), both, _portions(both), strict=True):
        for part, total in parts:
            some = segments if total is not None else _part(segments, part)
            found.append(_seen_crossings(some, visible.depth, along_row, total))
            held += len(found[-1][1])
            if held > MOST_CROSSINGS:  # many coincident faces would otherwise fill the memory
                found = [_outermost_of(found)]
                held = len(found[0][1])
    return _outermost_of(found, preferred_only=True)[0]


def _portions(both: list[_Segments]) -> list[list[tuple[slice, int | None]]]:
    """Portions of each, and the number of lines that each crosses, if known. On a GPU, all at once
    if memory allows it: one question for both."""
    if both[0].count.device.type != "cpu":
        totals = torch.stack([each.count.sum() for each in both]).tolist()
        if sum(totals) <= MOST_CROSSINGS:
            return [[(slice(None), total)] for total in totals]
    portions: list[list[tuple[slice, int | None]]] = []
    for segments in both:
        ends = [0, *itertools.accumulate(chunks(segments.count))]
        portions.append([(slice(*pair), None) for pair in itertools.pairwise(ends)])
    return portions


def _outermost_of(found: list[_Found], preferred_only: bool = False) -> _Found:
    """Select the outermost crossings, with their distances and preferences, in order; or only those
    of them that are preferred."""
    columns = [[getattr(each, f.name) for each, _, _ in found] for f in fields(Crossings)]
    every = Crossings(*(torch.cat(column, dim=-1) for column in columns))
    distance = torch.cat([each for _, each, _ in found])
    preferred = torch.cat([each for _, _, each in found])
    outermost = _outermost(every, distance, preferred if preferred_only else None)
    return _part(every, outermost), distance[outermost], preferred[outermost]


def _part(record: Any, index: slice | Tensor) -> Any:
    """Index each tensor of a record along its last dimension."""
    return replace(record, **{f.name: getattr(record, f.name)[..., index] for f in fields(record)})


def _contour_edges(
    points: Tensor, corners: Tensor, across: Tensor, front: Tensor, chosen: Tensor
) -> tuple[Tensor, ...]:
    """View, face, and start and end in (views, vertices) of the contour edges."""
    away = torch.cat([~front, front.new_ones(len(front), 1)], dim=1)
    if front.device.type != "cpu":  # all edges at once
        each = take(away, across.reshape(-1)).unflatten(1, across.shape) & chosen[:, None]
        view, place = positions(each.flatten(1))
        base = view * points.shape[2]
        start, end = (
            base + which.reshape(-1).index_select(0, place)
            for which in (corners, corners.roll(-1, 0))
        )
        return view, place % max(1, corners.shape[1]), start, end
    found = []
    for k in range(3):
        view, face = positions(take(away, across[k]).logical_and_(chosen))
        base = view * points.shape[2]
        start = base + corners[k].index_select(0, face)
        end = base + corners[(k + 1) % 3].index_select(0, face)
        found.append((view, face, start, end))
    return tuple(torch.cat(parts) for parts in zip(*found, strict=True))


def _ends(
    points: Tensor, edges: tuple[Tensor, ...], near: float
) -> tuple[Float[Tensor, "3 m"], Float[Tensor, "3 m"], Bool[Tensor, " m"]]:
    """Clip edges at the near plane and project them: column, row and 1/w of both ends, and whether
    any part is in front of that plane."""
    _, _, start, end = edges
    flat = points.reshape(3, -1)
    a, b = flat.index_select(1, start), flat.index_select(1, end)
    a_front, b_front = a[2] >= near, b[2] >= near
    if points.device.type != "cpu" or not (a_front & b_front).all():
        rise = b[2] - a[2]
        cut = a + ((near - a[2]) / torch.where(rise == 0, 1.0, rise)) * (b - a)
        a, b = torch.where(a_front, a, cut), torch.where(b_front, b, cut)
    ends = []
    for each in (a, b):
        inverse = 1 / each[2].clamp_min(near)
        ends.append(torch.stack([each[0] * inverse, each[1] * inverse, inverse]))
    return ends[0], ends[1], a_front | b_front


def _segments(
    ends: tuple[Tensor, ...], edges: tuple[Tensor, ...], depth: Tensor, along_row: bool
) -> _Segments:
    """The rows or columns that projected edges cross."""
    view, face, start, end = edges
    p, q, in_front = ends
    if not along_row:
        p, q = (torch.stack([each[1], each[0], each[2]]) for each in (p, q))
    across, along = (q[1] - p[1]).abs(), (q[0] - p[0]).abs()
    preferred = across >= along if along_row else across > along
    first = torch.ceil(torch.minimum(p[1], q[1]) - 0.5).clamp_min(0)
    lines = depth.shape[1 if along_row else 2]
    beyond = torch.ceil(torch.maximum(p[1], q[1]) - 0.5).clamp_max(lines)
    count = torch.where(in_front, beyond - first, 0.0).nan_to_num(nan=0.0).clamp_min(0)
    first = first.nan_to_num(nan=0.0)
    return _Segments(p, q, view, face, start, end, preferred, first, count.long())


def _seen_crossings(
    segments: _Segments, depth: Tensor, along_row: bool, total: int | None
) -> tuple[Crossings, Tensor, Tensor]:
    """Crossings where segments pass between two pixels, in front of the farther one, with ``s`` and
    ``preferred``. ``total`` is the number of scan lines that all cross, if known."""
    height, width = depth.shape[1:]
    # Strides between pixels and between lines, and the first pixel of the last pair.
    next_pixel, next_line = (1, width) if along_row else (width, 1)
    last = (width if along_row else height) - 2
    owner, step = ragged(segments.count, total)
    p_along, p_across, p_inverse_w = (row.index_select(0, owner) for row in segments.p)
    q_along, q_across, q_inverse_w = (row.index_select(0, owner) for row in segments.q)
    line = segments.first.index_select(0, owner) + step
    share = ((line + 0.5).sub_(p_across) / q_across.sub_(p_across)).clamp_(0, 1)
    crossing = torch.lerp(p_along, q_along, share)
    inverse_w = torch.lerp(p_inverse_w, q_inverse_w, share)

    # The pair's first pixel is left of, or above, the crossing.
    before = torch.floor(crossing - 0.5)
    in_frame = (before >= 0) & (before <= last)
    before = before.nan_to_num_(nan=0.0).clamp_(0, max(last, 0))
    fraction = crossing.sub_(before).sub_(0.5)
    # A front face is to the right of its downward edges, and below its leftward ones.
    inner_last = (segments.q[1] > segments.p[1]) == along_row
    shift = (inner_last * next_pixel).index_select(0, owner)
    is_last = inner_last.to(fraction.dtype).index_select(0, owner)
    distance = torch.addcmul(is_last, 1 - 2 * is_last, fraction)

    begun = segments.view * (height * width) + segments.first.long() * next_line
    pixel = step.mul_(next_line).add_(begun.index_select(0, owner))
    pixel.add_(before.long(), alpha=next_pixel)
    inner, outer = pixel + shift, pixel.add_(next_pixel).sub_(shift)
    flat = depth.reshape(-1)
    last_pixel = max(flat.numel() - 1, 0)
    inner_depth = flat.index_select(0, inner.clamp_max(last_pixel))
    outer_depth = flat.index_select(0, outer.clamp_max(last_pixel))
    seen = in_frame & (inner_depth < outer_depth) & (inverse_w * outer_depth > 1)

    kept = true_indices(seen)
    owner, is_last = owner.index_select(0, kept), is_last.index_select(0, kept)
    along = before.index_select(0, kept).add_(is_last).add_(0.5)
    across = line.index_select(0, kept).add_(0.5)
    crossings = Crossings(
        inner.index_select(0, kept),
        outer.index_select(0, kept),
        segments.start.index_select(0, owner),
        segments.end.index_select(0, owner),
        torch.stack([along, across] if along_row else [across, along]),
        seen.new_full((len(kept),), along_row),
        1 - 2 * is_last,
        segments.view.index_select(0, owner),
        segments.face.index_select(0, owner),
    )
    return crossings, distance.index_select(0, kept), segments.preferred.index_select(0, owner)


def _outermost(
    crossings: Crossings, distance: Tensor, only: Bool[Tensor, " n"] | None
) -> Int[Tensor, " pixel_pairs"]:
    """Index of the outermost edge between each pair of pixels, if it is one of ``only`` these."""
    # A row pair and a column pair may share their first pixel; the parity distinguishes them.
    pair = torch.minimum(crossings.inner, crossings.outer) * 2 + crossings.along_row
    fine = 1 << 20  # steps of distance, and the outermost edge of each pair comes last
    order = (pair * (2 * fine) + (distance.clamp(0, 1) * fine).long()).argsort(stable=True)
    pair = pair[order]
    last = torch.cat([pair[1:] != pair[:-1], pair.new_ones(min(len(pair), 1), dtype=torch.bool)])
    if only is not None:
        last &= only[order]
    return order[true_indices(last)]


class CrossingDistance(torch.autograd.Function):
    """Distance, in pixels, from each inner pixel's centre to its edge, towards the outer pixel.

    Takes homogeneous pixels (3, views, V) and ``Crossings``; returns (n). With the vertices'
    offsets from the pixel's ray, ``(x w - column w, y w - row w)``, the line through both needs no
    division by depth, so it is also valid for edges that extend behind the camera.
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
        ctx.crossings, ctx.shape = crossings, points.shape
        ctx.save_for_backward(a[2], b[2], a_u, a_v, b_u, b_v, scale, distance * crossings.direction)
        return distance.clamp(0, 1)  # rounding may put it slightly outside the pair

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        """Quotient rule, summed into the two vertices."""
        a_w, b_w, a_u, a_v, b_u, b_v, scale, offset = ctx.saved_tensors
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
