"""Visibility: which face is seen at which pixel. Nothing here is differentiated.

Faces become triangles in pixel coordinates (``Triangles``), clipped at the near plane; these are
tested against the pixel centres in their bounding boxes; the nearest hit of each pixel wins.

The tests are watertight: the edge function of an edge is the same number, bit for bit, from its two
sides, because it is anchored at the edge's midpoint, and a pixel centre on an edge belongs to the
side given by the top-left rule.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from torch import Tensor

_BOX_SIZES = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
"""Bounding boxes are padded to these sizes; larger ones are filled row by row."""
_CHUNK = 1 << 20
"""Most pixel candidates that are tested at once: bounds memory, and keeps the work in cache."""


@dataclass(frozen=True)
class FacePairs:
    """Pairs (view, face) that may be seen: facing the camera and not wholly outside the frame."""

    view: Int[Tensor, " pairs"]
    face: Int[Tensor, " pairs"]
    needs_clipping: Bool[Tensor, " pairs"]
    """A corner lies in front of the near plane, or behind the camera."""


@dataclass(frozen=True)
class Triangles:
    """Triangles in pixel coordinates, one row of each array per corner."""

    x: Float[Tensor, "3 triangles"]
    y: Float[Tensor, "3 triangles"]
    inverse_w: Float[Tensor, "3 triangles"]
    view: Int[Tensor, " triangles"]
    face: Int[Tensor, " triangles"]


@dataclass(frozen=True)
class Visible:
    """The winners of the depth test, pixel by pixel and as lists of the covered pixels."""

    face_ids: Int[Tensor, "views height width"]
    depth: Float[Tensor, "views height width"]
    pixel: Int[Tensor, " winners"]
    """Index into the flattened (views, height, width)."""
    view: Int[Tensor, " winners"]
    face: Int[Tensor, " winners"]


def facing(
    vertices: Float[Tensor, "vertices 3"],
    corners: Int[Tensor, "3 faces"],
    face_normals: Float[Tensor, "3 faces"],
    eyes: Float[Tensor, "views 3"],
) -> Bool[Tensor, "views faces"]:
    """Whether the camera is on the outer side of each face's plane.

    Decided in the world, so that it also holds for faces that reach behind the camera.
    """
    x, y, z = vertices.t().contiguous().index_select(1, corners[0])
    offset = face_normals[0] * x + face_normals[1] * y + face_normals[2] * z
    side = torch.addcmul(-offset, eyes[:, :1], face_normals[0])
    side.addcmul_(eyes[:, 1:2], face_normals[1]).addcmul_(eyes[:, 2:], face_normals[2])
    return side > 0


def candidate_pairs(
    points: Float[Tensor, "3 views vertices"],
    corners: Int[Tensor, "3 faces"],
    front: Bool[Tensor, "views faces"],
    near: float,
    resolution: tuple[int, int],
) -> FacePairs:
    """Drop back faces and faces on the outer side of the near plane or of one side of the frame."""
    height, width = resolution
    x, y, w = points
    # The sides of the frame are planes in homogeneous pixels, so the tests also hold where w < 0.
    outside = (x < 0).byte()
    outside |= (x > width * w).byte() << 1
    outside |= (y < 0).byte() << 2
    outside |= (y > height * w).byte() << 3
    outside |= (w < near).byte() << 4
    outside = outside.view(-1)

    count = points.shape[2]
    hit = front.reshape(-1).nonzero().view(-1)
    view = hit // max(front.shape[1], 1)
    face = hit - view * front.shape[1]
    first = view * count
    codes = [outside.index_select(0, first + corner.index_select(0, face)) for corner in corners]
    inside = (codes[0] & codes[1] & codes[2]) == 0
    keep = inside.nonzero().view(-1)
    crosses = ((codes[0] | codes[1] | codes[2]) & 16) != 0
    return FacePairs(view[keep], face[keep], crosses[keep])


def rasterise(
    points: Float[Tensor, "3 views vertices"],
    corners: Int[Tensor, "3 faces"],
    pairs: FacePairs,
    near: float,
    resolution: tuple[int, int],
) -> Visible:
    """Find the nearest face at every pixel centre; equal depth goes to the lowest face index."""
    views = points.shape[1]
    height, width = resolution
    best = torch.zeros(views * height * width, dtype=torch.int64, device=points.device)

    triangles = _triangles(points, corners, pairs, near)
    low_x, high_x = _pixel_range(triangles.x, width)
    low_y, high_y = _pixel_range(triangles.y, height)
    span = torch.maximum(high_x - low_x, high_y - low_y)
    has_pixel = (high_x >= low_x) & (high_y >= low_y)
    sizes = torch.tensor(_BOX_SIZES, device=points.device)
    bucket = torch.bucketize(span + 1, sizes)
    bucket = torch.where(has_pixel, bucket, -1)
    for index, size in enumerate(_BOX_SIZES):
        members = (bucket == index).nonzero().view(-1)
        for part in members.split(max(1, _CHUNK // size**2)) if members.numel() else ():
            _test_boxes(best, triangles, part, low_x, low_y, size, resolution)
    members = (bucket == len(_BOX_SIZES)).nonzero().view(-1)
    if members.numel():
        _test_rows(best, triangles, members, low_y, high_y, resolution)
    return _winners(best, (views, height, width), points.dtype)


def _triangles(points: Tensor, corners: Tensor, pairs: FacePairs, near: float) -> Triangles:
    """Project the pairs to the image, clipping those that cross the near plane."""
    views, count = points.shape[1:]
    flat = points.reshape(3, views * count)
    index = [pairs.view * count + corner.index_select(0, pairs.face) for corner in corners]
    inverse = 1 / flat[2]
    x, y = flat[0] * inverse, flat[1] * inverse
    whole = Triangles(
        torch.stack([x.index_select(0, i) for i in index]),
        torch.stack([y.index_select(0, i) for i in index]),
        torch.stack([inverse.index_select(0, i) for i in index]),
        pairs.view,
        pairs.face,
    )
    crossing = pairs.needs_clipping.nonzero().view(-1)
    if not crossing.numel():
        return whole
    rest = (~pairs.needs_clipping).nonzero().view(-1)
    view, face = pairs.view[crossing], pairs.face[crossing]
    homogeneous = torch.stack([flat.index_select(1, i[crossing]) for i in index])
    clipped = _clip(homogeneous, near)
    return Triangles(
        x=torch.cat([whole.x[:, rest], clipped[0]], dim=1),
        y=torch.cat([whole.y[:, rest], clipped[1]], dim=1),
        inverse_w=torch.cat([whole.inverse_w[:, rest], clipped[2]], dim=1),
        view=torch.cat([pairs.view[rest], view, view]),
        face=torch.cat([pairs.face[rest], face, face]),
    )


def _clip(corners: Float[Tensor, "3 3 n"], near: float) -> Float[Tensor, "3 3 2n"]:
    """Cut triangles, given as (corner, coordinate, triangle), at ``w = near`` and project them.

    Returns (coordinate, corner, triangle) of x, y and 1/w; two triangles each, the second without
    area where the part in front is itself a triangle.
    """
    in_front = corners[:, 2] >= near
    number = in_front.sum(0)
    # Turn each triangle until its corners in front come first: one (a), or two (a, b).
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
    """Where the edge meets the near plane: the same bits from either side of the edge."""
    forward = a[2] < b[2]
    low, high = torch.where(forward, a, b), torch.where(forward, b, a)
    rise = high[2] - low[2]
    share = torch.where(rise > 0, (near - low[2]) / rise, 0.0)
    point = low + share * (high - low)
    point[2] = near
    return point


def _pixel_range(values: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """First and last pixel whose centre lies within the three corners' range and the frame.

    None, with a corner that is not a number.
    """
    low = torch.ceil(values.amin(0) - 0.5).nan_to_num(nan=size).clamp(0, size)
    high = torch.floor(values.amax(0) - 0.5).nan_to_num(nan=-1.0).clamp(-1, size - 1)
    return low.long(), high.long()


@dataclass(frozen=True)
class _Edge:
    """One edge of each triangle, turned so that the pixel centres on it are on its inner side."""

    mx: Tensor
    my: Tensor
    dx: Tensor
    dy: Tensor
    turned: Tensor
    """Whether the triangle is on the other side: outside of it, then, means inside."""


def _edges(x: Tensor, y: Tensor) -> list[_Edge]:
    """The edges by their midpoints and directions.

    Of the two directions of an edge one is its own, by the top-left rule: downwards, or to the left
    where it is level. Two faces that share an edge so do the very same arithmetic for it.
    """
    result = []
    for a, b in ((0, 1), (1, 2), (2, 0)):
        dx, dy = x[b] - x[a], y[b] - y[a]
        turned = (dy < 0) | ((dy == 0) & (dx > 0))
        sign = 1 - 2 * turned.to(dx.dtype)
        middle_x, middle_y = (x[a] + x[b]) * 0.5, (y[a] + y[b]) * 0.5
        result.append(_Edge(middle_x, middle_y, dx * sign, dy * sign, turned))
    return result


def _inverse_depth_plane(t: Triangles, part: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, ...]:
    """Slopes of 1/w, which is linear in the image, its first corner's value, and its range."""
    q = t.inverse_w.index_select(1, part)
    x1, x2, y1, y2 = x[1] - x[0], x[2] - x[0], y[1] - y[0], y[2] - y[0]
    area = x1 * y2 - x2 * y1
    # A sliver's slopes may be anything; its range then bounds the depth.
    scale = torch.where(area == 0, 0.0, 1 / area)
    q1, q2 = q[1] - q[0], q[2] - q[0]
    return (
        (q1 * y2 - q2 * y1) * scale,
        (q2 * x1 - q1 * x2) * scale,
        q[0],
        q.amin(0),
        q.amax(0),
    )


def _test_boxes(
    best: Tensor,
    t: Triangles,
    part: Tensor,
    low_x: Tensor,
    low_y: Tensor,
    size: int,
    resolution: tuple[int, int],
) -> None:
    """Test dense (size, size) boxes of pixels; the triangles are the innermost dimension."""
    height, width = resolution
    count, device = part.numel(), part.device
    x, y = t.x.index_select(1, part), t.y.index_select(1, part)
    # A padded box must not stick out of the frame.
    left = low_x.index_select(0, part).clamp_max(max(width - size, 0))
    top = low_y.index_select(0, part).clamp_max(max(height - size, 0))
    columns, rows = min(size, width), min(size, height)
    center_x = (left + torch.arange(columns, device=device)[:, None]).to(x.dtype) + 0.5
    center_y = (top + torch.arange(rows, device=device)[:, None]).to(y.dtype) + 0.5
    inside = None
    for edge in _edges(x, y):
        along = (center_x - edge.mx) * edge.dy
        across = (center_y - edge.my) * edge.dx
        within = (along[None, :, :] >= across[:, None, :]).logical_xor_(edge.turned)
        inside = within if inside is None else inside.logical_and_(within)
    assert inside is not None
    hit = inside.view(-1).nonzero().view(-1)
    # Look up what a cell of the box means: cheaper than arithmetic on 64-bit integers.
    cell = hit // count
    row, column = torch.meshgrid(
        torch.arange(rows, device=device), torch.arange(columns, device=device), indexing="ij"
    )
    row, column = row.reshape(-1), column.reshape(-1)
    member = hit - ((row * columns + column) * count).index_select(0, cell)

    slope_x, slope_y, first, lowest, highest = _inverse_depth_plane(t, part, x, y)
    by_x = (slope_x * (center_x - x[0])).view(-1)
    by_y = (slope_y * (center_y - y[0]) + first).view(-1)
    inverse_w = by_x.index_select(0, (column * count).index_select(0, cell) + member)
    inverse_w += by_y.index_select(0, (row * count).index_select(0, cell) + member)
    inverse_w = torch.clamp(
        inverse_w.nan_to_num_(),  # of a sliver's infinite slopes
        lowest.index_select(0, member),
        highest.index_select(0, member),
    )
    corner = (t.view.index_select(0, part) * height + top) * width + left
    pixel = corner.index_select(0, member) + (row * width + column).index_select(0, cell)
    _keep_nearest(best, pixel, inverse_w, t.face.index_select(0, part.index_select(0, member)))


def _test_rows(
    best: Tensor,
    t: Triangles,
    part: Tensor,
    low_y: Tensor,
    high_y: Tensor,
    resolution: tuple[int, int],
) -> None:
    """Fill large triangles: list their rows, in each row the pixels between the edges, and test."""
    height, width = resolution
    for some in part.split(max(1, _CHUNK // height)):
        owner, step = ragged(high_y[some] - low_y[some] + 1)
        member = some.index_select(0, owner)
        row = low_y.index_select(0, member) + step
        start, length = _row_spans(t, member, row, width)
        begin = 0
        for rows in chunks(length):
            now = slice(begin, begin + rows)
            _test_spans(best, t, member[now], row[now], start[now], length[now], resolution)
            begin += rows


def chunks(counts: Int[Tensor, " n"]) -> list[int]:
    """Split items that hold ``counts`` elements each into runs with not many more than _CHUNK."""
    chunk = torch.div(counts.cumsum(0), _CHUNK, rounding_mode="floor")
    return torch.unique_consecutive(chunk, return_counts=True)[1].tolist() or [0]


def ragged(counts: Int[Tensor, " n"]) -> tuple[Int[Tensor, " total"], Int[Tensor, " total"]]:
    """For items that hold ``counts`` elements each: every element's item and its place therein."""
    owner = torch.repeat_interleave(counts)
    place = torch.arange(owner.numel(), device=counts.device)
    place -= (counts.cumsum(0) - counts).index_select(0, owner)
    return owner, place


def _row_spans(t: Triangles, member: Tensor, row: Tensor, width: int) -> tuple[Tensor, Tensor]:
    """First pixel and number of pixels that may lie in the triangle, a pixel to spare each side."""
    x, y = t.x.index_select(1, member), t.y.index_select(1, member)
    center_y = row.to(y.dtype) + 0.5
    low, high = x.amin(0), x.amax(0)
    for edge in _edges(x, y):
        crossing = edge.mx + edge.dx * ((center_y - edge.my) / edge.dy)
        level = edge.dy == 0
        low = torch.where(level | edge.turned, low, torch.maximum(low, crossing))
        high = torch.where(level | ~edge.turned, high, torch.minimum(high, crossing))
    # An edge too long for its numbers says nothing: the whole row is tested.
    first = torch.floor(low - 1.5).nan_to_num(nan=0.0).clamp(0, width)
    last = torch.ceil(high + 0.5).nan_to_num(nan=width - 1).clamp(-1, width - 1)
    return first.long(), (last - first + 1).clamp_min(0).long()


def _test_spans(
    best: Tensor,
    t: Triangles,
    member: Tensor,
    row: Tensor,
    start: Tensor,
    length: Tensor,
    resolution: tuple[int, int],
) -> None:
    """Test the pixels of row spans; the same arithmetic as ``_test_boxes``, pixel by pixel."""
    height, width = resolution
    x, y = t.x.index_select(1, member), t.y.index_select(1, member)
    center_y = row.to(y.dtype) + 0.5
    owner, step = ragged(length)
    column = start.index_select(0, owner) + step
    center_x = column.to(x.dtype) + 0.5
    inside = torch.ones_like(owner, dtype=torch.bool)
    for edge in _edges(x, y):
        across = (center_y - edge.my) * edge.dx
        along = (center_x - edge.mx.index_select(0, owner)) * edge.dy.index_select(0, owner)
        inside &= (along >= across.index_select(0, owner)) ^ edge.turned.index_select(0, owner)
    hit = inside.nonzero().view(-1)
    owner, column, center_x = owner[hit], column[hit], center_x[hit]

    slope_x, slope_y, first, lowest, highest = _inverse_depth_plane(t, member, x, y)
    by_y = slope_y * (center_y - y[0]) + first
    by_x = slope_x.index_select(0, owner) * (center_x - x[0].index_select(0, owner))
    inverse_w = torch.clamp(
        (by_x + by_y.index_select(0, owner)).nan_to_num_(),
        lowest.index_select(0, owner),
        highest.index_select(0, owner),
    )
    first_pixel = (t.view[member] * height + row) * width
    pixel = first_pixel.index_select(0, owner) + column
    _keep_nearest(best, pixel, inverse_w, t.face[member].index_select(0, owner))


def _keep_nearest(best: Tensor, pixel: Tensor, inverse_w: Tensor, face: Tensor) -> None:
    """Depth test. Positive floats order as their bits do; the inverted face index breaks ties."""
    bits = inverse_w.float().view(torch.int32).long()
    best.scatter_reduce_(0, pixel, (bits << 32) | (~face & 0xFFFFFFFF), "amax")


def _winners(best: Tensor, shape: tuple[int, int, int], dtype: torch.dtype) -> Visible:
    """Unpack the keys; the background's, 0, is that of face -1 at infinity."""
    low, high = best.view(torch.int32).view(-1, 2).unbind(1)  # little-endian, as all of torch is
    face_ids = low.bitwise_not().long()
    depth = high.contiguous().view(torch.float32).reciprocal().to(dtype)
    pixel = best.nonzero().view(-1)
    view = pixel // max(shape[1] * shape[2], 1)
    face = face_ids.index_select(0, pixel)
    return Visible(face_ids.view(shape), depth.view(shape), pixel, view, face)
