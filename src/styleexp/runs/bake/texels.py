"""Which texels a face covers, and what those between the islands show.

Texture space: u points right, v up, so v = 1 is the first row of the image; texel centres are at
(column + 1/2, row + 1/2) / size. Texture coordinates wrap outside [0, 1].
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

BATCH = 1 << 18
"""Texels per batch. A batch's arrays take about 100 MB."""
EDGE = 1e-9
"""Barycentric weight below zero at which a centre on an edge still belongs to the face."""


@dataclass(frozen=True)
class Texels:
    """Texels whose centres faces cover, in the order of the faces."""

    at: Int[np.ndarray, " n"]
    """Index into the flattened picture."""
    face: Int[np.ndarray, " n"]
    weights: Float[np.ndarray, "n 3"]
    """Barycentric coordinates, float32."""


def covered(uv: Float[np.ndarray, "faces 3 2"], size: int) -> Iterator[Texels]:
    """Yield the texels of a picture of ``size`` x ``size`` that faces cover, in batches: row by
    row of every face, from where the row enters it to where it leaves."""
    points = uv * size - 0.5  # texel centres are whole numbers, y up
    low = np.ceil(points[..., 1].min(axis=1) - EDGE).astype(np.int64)
    high = np.floor(points[..., 1].max(axis=1) + EDGE).astype(np.int64)
    e1, e2 = points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]
    double = e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]
    used = np.flatnonzero((high >= low) & (np.abs(double) > 1e-12))
    counts = high[used] - low[used] + 1
    start = 0
    while start < len(used):  # rows of a few faces at a time
        stop = start + max(1, int(np.searchsorted(np.cumsum(counts[start:]), BATCH, "right")))
        chosen, rows = used[start:stop], counts[start:stop]
        face = np.repeat(chosen, rows)
        step = np.arange(len(face)) - np.repeat(np.cumsum(rows) - rows, rows)
        yield from _spans(points, face, low[face] + step, double, size)
        start = stop


def _spans(
    points: np.ndarray, face: np.ndarray, row: np.ndarray, double: np.ndarray, size: int
) -> Iterator[Texels]:
    """Texels of these rows (n,) of these faces (n,)."""
    # A corner's weight in a row is slope * x + value.
    slope, value = np.empty((3, len(face))), np.empty((3, len(face)))
    first, last = np.full(len(face), -np.inf), np.full(len(face), np.inf)
    for k in range(3):
        b, c = points[face, (k + 1) % 3], points[face, (k + 2) % 3]
        slope[k] = (b[:, 1] - c[:, 1]) / double[face]
        value[k] = ((row - b[:, 1]) * (c[:, 0] - b[:, 0]) + b[:, 0] * (c[:, 1] - b[:, 1])) / double[
            face
        ]
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = (-EDGE - value[k]) / slope[k]
        first = np.where(slope[k] > 0, np.maximum(first, crossing), first)
        last = np.where(slope[k] < 0, np.minimum(last, crossing), last)
        last = np.where((slope[k] == 0) & (value[k] < -EDGE), -np.inf, last)
    known = np.isfinite(first) & np.isfinite(last)
    first, last = np.where(known, first, 0.0), np.where(known, last, -1.0)
    left = np.ceil(first).astype(np.int64)
    count = np.maximum(np.floor(last).astype(np.int64) - left + 1, 0)
    ends = np.cumsum(count)
    start = 0
    while start < len(count):
        before = ends[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(ends, before + BATCH, "right")))
        span = np.repeat(np.arange(start, stop), count[start:stop])
        column = left[span] + np.arange(len(span)) - (ends - count)[span] + before
        weights = np.stack([slope[k, span] * column + value[k, span] for k in range(3)], axis=1)
        at = (size - 1 - row[span]) % size * size + column % size
        if len(span):
            yield Texels(at, face[span], weights.astype(np.float32))
        start = stop


def fill(
    known: Bool[np.ndarray, "size size"], picture: Float[np.ndarray, "size size channels"]
) -> None:
    """Give unknown texels the value of the nearest known one, in place, so that filtering at an
    island's border, at any mip level, sees the border's value."""
    from scipy.ndimage import distance_transform_edt

    unknown = ~known
    nearest = distance_transform_edt(unknown, return_distances=False, return_indices=True)
    row, column = (each[unknown] for each in nearest)
    picture[unknown] = picture[row, column]
