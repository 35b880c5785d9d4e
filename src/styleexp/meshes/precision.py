"""How far apart two positions of a file may be and still have been one, from how it stores them."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

ULPS = 4
"""Two roundings of one number are a unit in the last place apart, on each axis; doubled, as what
was computed twice often is off by two."""
SAMPLE = 20_000
NUMBER = re.compile(rb"[-+]?(\d*)\.?(\d*)(?:[eE][-+]?\d+)?")


def of_floats(points: np.ndarray) -> float:
    """Of single precision: a few of the largest coordinate's units in the last place."""
    largest = np.abs(points).max(initial=0.0)
    if not largest < np.finfo(np.float32).max:  # infinite or NaN: refused later
        return 0.0
    return ULPS * float(np.spacing(np.float32(largest)))


def of_text(words: Sequence[bytes | str], points: np.ndarray) -> float:
    """Of written numbers: two units of the last digit that the largest coordinate has.

    Up to nine digits are what singles are printed with, so they count as singles, too. Fewer than
    six are no rounded numbers, but such as someone chose.
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
    """Significant digits, trailing zeros among them: they were written."""
    match = NUMBER.fullmatch(word)
    if match is None:
        return 0
    # Without a point trailing zeros say nothing: 1000 is as good as 1.
    whole = match[1] + match[2]
    return len((whole if match[2] else whole.rstrip(b"0")).lstrip(b"0"))
