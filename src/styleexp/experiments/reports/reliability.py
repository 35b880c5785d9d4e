"""Inter-rater agreement, and confidence intervals."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float

CONFIDENCE = 0.95

Level = Literal["nominal", "ordinal", "interval"]


def krippendorff_alpha(ratings: Float[np.ndarray, "raters units"], level: Level) -> float:
    """Krippendorff's alpha: 1 for full agreement, 0 for agreement by chance.

    NaN marks missing ratings; units with fewer than two ratings are ignored. Returns NaN if alpha
    is undefined: no unit with two ratings, or only one value.

    From coincidences, K. Krippendorff, "Computing Krippendorff's Alpha-Reliability" (2011).
    """
    values = np.unique(ratings[~np.isnan(ratings)])
    coincidences = np.zeros((len(values), len(values)))
    for unit in np.asarray(ratings).T:
        given = unit[~np.isnan(unit)]
        if len(given) < 2:
            continue
        counts = (given[:, None] == values).sum(axis=0)
        pairs = np.outer(counts, counts) - np.diag(counts)
        coincidences += pairs / (len(given) - 1)
    totals = coincidences.sum(axis=1)
    n = totals.sum()
    if n <= 1:
        return math.nan
    distance = _distances(values, totals, level)
    expected = (np.outer(totals, totals) * distance).sum()  # the diagonal's distance is 0
    if expected == 0:
        return math.nan
    return float(1 - (n - 1) * (coincidences * distance).sum() / expected)


def _distances(values: np.ndarray, totals: np.ndarray, level: Level) -> np.ndarray:
    """Squared differences of all pairs of values."""
    if level == "nominal":
        return 1.0 - np.eye(len(values))
    if level == "interval":
        return np.subtract.outer(values, values) ** 2
    ranks = (
        np.cumsum(totals) - totals / 2
    )  # number of values between two, with the ends counted half
    return np.subtract.outer(ranks, ranks) ** 2


def mean_interval(values: Float[np.ndarray, " n"]) -> tuple[float, float, float]:
    """Mean and bounds of its 95 % confidence interval (Student's t); NaN bounds for a single
    value."""
    from scipy import stats

    mean = float(np.mean(values))
    if len(values) < 2:
        return mean, math.nan, math.nan
    error = float(np.std(values, ddof=1)) / math.sqrt(len(values))
    reach = float(stats.t.ppf((1 + CONFIDENCE) / 2, len(values) - 1)) * error
    return mean, mean - reach, mean + reach
