"""Which faces each view may show, and lists of what a mask holds. Not differentiated.

On the CPU, questions are asked ("does any face cross the near plane?") and work is saved by their
answers. On a GPU the host would have to wait for an answer, so everything is computed always, in as
few kernels as there can be.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from torch import Tensor

CHUNK = 1 << 18
"""Approximate number of triangle rows, or of their pixels, per batch on the CPU: bounds memory."""


@dataclass(frozen=True)
class FacePairs:
    """Candidate pairs (view, face): facing the camera and not entirely outside the frame.

    As lists, they are sorted by view, then by face; made when asked for, because their length is
    known to the device alone.
    """

    chosen: Bool[Tensor, "views faces"]
    """The pairs as a mask."""
    crossing: Bool[Tensor, "views faces"] | None
    """Those that need clipping: a corner is in front of the near plane, or behind the camera. None
    if there is no such pair; entries of other pairs mean nothing."""

    @functools.cached_property
    def view(self) -> Int[Tensor, " pairs"]:
        """View of each pair."""
        return self._listed[0]

    @functools.cached_property
    def face(self) -> Int[Tensor, " pairs"]:
        """Face of each pair."""
        return self._listed[1]

    @functools.cached_property
    def needs_clipping(self) -> Bool[Tensor, " pairs"]:
        """`crossing` of each pair."""
        if self.crossing is None:
            return torch.zeros_like(self.face, dtype=torch.bool)
        return self.crossing.view(-1)[self.view * self.chosen.shape[1] + self.face]

    @functools.cached_property
    def _listed(self) -> tuple[Tensor, Tensor]:
        return positions(self.chosen)


def facing(
    vertices: Float[Tensor, "vertices 3"],
    corners: Int[Tensor, "3 faces"],
    face_normals: Float[Tensor, "3 faces"],
    eyes: Float[Tensor, "views 3"],
) -> Bool[Tensor, "views faces"]:
    """Whether the camera is on the outer side of each face's plane.

    Evaluated in world space, so that it is also valid for faces that extend behind the camera.
    """
    x, y, z = first = vertices.t().contiguous().index_select(1, corners[0])
    if first.device.type == "cpu":
        offset = face_normals[0] * x + face_normals[1] * y + face_normals[2] * z
    else:
        offset = (face_normals * first).sum(0)
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
    """Cull back faces, and faces outside the near plane or one side of the frame."""
    height, width = resolution
    x, y, w = points
    if points.device.type != "cpu":
        beyond = [torch.sub(x, w, alpha=width), torch.sub(y, w, alpha=height), near - w]
        sides = torch.cat([-points[:2], torch.stack(beyond)]) > 0
        outside = sides.index_select(2, corners.reshape(-1)).unflatten(2, corners.shape)
        return FacePairs(front & ~outside.all(2).any(0), outside[4].any(1))
    # The frame's sides are planes in homogeneous pixels, so the tests are also valid for w < 0.
    outside = (x < 0).byte()
    outside |= (x > width * w).byte() << 1
    outside |= (y < 0).byte() << 2
    outside |= (y > height * w).byte() << 3
    outside |= (w < near).byte() << 4

    chosen = front
    if outside.any():
        a, b, c = (take(outside, corner) for corner in corners)
        chosen = ((a & b & c) == 0).logical_and_(front)
    crossing = None
    if (outside >= 16).any():
        crossing = ((a | b | c) & 16) != 0
    return FacePairs(chosen, crossing)


def take(rows: Tensor, columns: Int[Tensor, " n"]) -> Tensor:
    """``rows[:, columns]``; for bytes on the CPU, going row by row is three times as fast."""
    if rows.device.type != "cpu":
        return rows.index_select(1, columns)
    taken = rows.new_empty(len(rows), len(columns))
    for row, into in zip(rows, taken, strict=True):
        torch.index_select(row, 0, columns, out=into)
    return taken


def positions(mask: Bool[Tensor, "rows columns"]) -> tuple[Int[Tensor, " n"], Int[Tensor, " n"]]:
    """Row and column of each true element, in order."""
    place = true_indices(mask.reshape(-1))
    row = rows_of(place, *mask.shape)
    return row, torch.sub(place, row, alpha=mask.shape[1])


def rows_of(place: Int[Tensor, " n"], rows: int, columns: int) -> Int[Tensor, " n"]:
    """Rows of sorted indices into a flattened array. Faster than division."""
    ends = torch.searchsorted(place, torch.arange(1, rows + 1, device=place.device) * columns)
    counts = ends.diff(prepend=ends.new_zeros(1))
    return torch.repeat_interleave(counts, output_size=len(place))


def true_indices(mask: Bool[Tensor, " n"]) -> Int[Tensor, " true"]:
    """Indices of true elements. Uses NumPy on the CPU, whose branchless search is 7 times as
    fast."""
    if mask.device.type != "cpu":
        return mask.nonzero().view(-1)
    return torch.from_numpy(np.flatnonzero(mask.numpy()))


def chunks(counts: Int[Tensor, " n"]) -> list[int]:
    """Split items that hold ``counts`` elements each into runs with not many more than CHUNK, given
    by their numbers of items."""
    chunk = torch.div(counts.cumsum(0), CHUNK, rounding_mode="floor")
    return torch.unique_consecutive(chunk, return_counts=True)[1].tolist() or [0]


def ragged(
    counts: Int[Tensor, " n"], total: int | None = None
) -> tuple[Int[Tensor, " total"], Int[Tensor, " total"]]:
    """For items with ``counts`` elements each, ``total`` together: the item of every element, and
    its index within it."""
    ends = counts.cumsum(0)
    if total is None:
        total = int(ends[-1]) if len(ends) else 0
    # Counting finished items is twice as fast as ``repeat_interleave``.
    owner = ends.new_zeros(total + 1).scatter_add_(0, ends, torch.ones_like(ends))
    owner = owner[:total].cumsum_(0)
    place = torch.arange(total, device=counts.device)
    place -= (ends - counts).index_select(0, owner)
    return owner, place
