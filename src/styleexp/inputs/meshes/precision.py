"""Rounding tolerance of a file's positions, from its number format."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

ULPS = 4
"""Tolerance in units in the last place. Two roundings of a number differ by one per axis; doubled,
because values computed twice often differ by two."""
SAMPLE = 20_000
NUMBER = re.compile(rb"[-+]?(\d*)\.?(\d*)(?:[eE][-+]?\d+)?")


def of_floats(points: np.ndarray) -> float:
    """Tolerance for single precision: a few ULPs of the largest coordinate."""
    largest = np.abs(points).max(initial=0.0)
    if not largest < np.finfo(np.float32).max:  # infinite or NaN: rejected later
        return 0.0
    return ULPS * float(np.spacing(np.float32(largest)))


def of_text(words: Sequence[bytes | str], points: np.ndarray) -> float:
    """Tolerance for text: two units of the last digit of the largest coordinate.

    Up to nine digits may be printed singles, so the single-precision tolerance applies, too.
    Numbers with fewer than six digits count as exact, not rounded.
    """
    some = words[:: max(1, len(words) // SAMPLE)]
    digits = max((_digits(w if isinstance(w, bytes) else w.encode()) for w in some), default=0)
    largest = np.abs(points).max(initial=0.0)
    if not 0 < largest < np.inf or not digits:
        return 0.0
    if digits < 6:
        return of_floats(points)
    unit = 10.0 ** (np.floor(np.log10(largest)) - digits + 1)
    exact = np.array_equal(points, points.astype(np.float32).astype(np.float64))
    return max(2 * float(unit), of_floats(points) if digits <= 9 or exact else 0.0)


def _digits(word: bytes) -> int:
    """Number of significant digits, including written trailing zeros."""
    match = NUMBER.fullmatch(word)
    if match is None:
        return 0
    # Without a point, trailing zeros are not significant.
    whole = match[1] + match[2]
    return len((whole if match[2] else whole.rstrip(b"0")).lstrip(b"0"))
