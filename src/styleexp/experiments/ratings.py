"""Estimates of how raters would rate a result, from its measures.

Fitted to half of the rated results and tested on the other, both printed by ``python -m
benchmarks.agreement``. The raters were vision-language models, not people.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

MATCH = (2.94, 2.0, 2.85)
"""Constant, rise with `pattern`, and fall with the style distance."""
CRAFT = (2.67, 0.62, 0.74)
"""Craft at a silhouette IoU of 0.9 and a bend of 1, and its falls with the logarithms."""
MOST_DISTANCE = 1.2
"""Style distance above which nothing gets worse."""
LEAST_CHANGE, LEAST_BEND = 0.004, 0.01
"""Lower bounds of 1 - IoU and of the bend, below which nobody sees a difference."""


def match(found: Mapping[str, float]) -> float:
    """Estimated match, from 1 to 5, of a result's ``likeness``, ``order``, ``relief_distance`` and
    ``style_distance``."""
    constant, by_pattern, by_distance = MATCH
    return clipped(
        constant
        + by_pattern * pattern(found)
        - by_distance * min(found["style_distance"], MOST_DISTANCE)
    )


def pattern(found: Mapping[str, float]) -> float:
    """How right the pattern is, 0 to 1. A style that repeats itself is known by its patches, one
    that doesn't, as gravel, by its statistics (`metrics.style.relief_distance`)."""
    by_patches, by_statistics = math.sqrt(found["likeness"]), math.exp(-found["relief_distance"])
    return found["order"] * by_patches + (1 - found["order"]) * by_statistics


def craft(silhouette_iou: float, bend: float) -> float:
    """Estimated craft, from 1 to 5: outlines that change and surfaces that crumple cost."""
    change = math.log(max(1 - silhouette_iou, LEAST_CHANGE) / 0.1)
    return clipped(CRAFT[0] - CRAFT[1] * change - CRAFT[2] * math.log(max(bend, LEAST_BEND)))


def clipped(rating: float) -> float:
    """Within the scale."""
    return min(max(rating, 1.0), 5.0)


REGIONS = {
    "outer": "the outer parts",
    "top": "the top",
    "bottom": "the bottom",
    "front": "the front",
    "back": "the back",
}
LEAST_ORDER = 0.3
"""Order of a style below which its patches are too much like noise to tell where it is carried."""
LESS = 0.2
"""How much less than the whole surface's coverage a region's must be to be named."""


def verdict(found: Mapping[str, float]) -> str | None:
    """One line about a result, from its metrics; None if they are of an older version.

    For instance "carries the style on 64 % of the surface, on 31 % of the outer parts; match about
    3.1 of 5, craft about 4.2".
    """
    if "craft" not in found:
        return None
    rated = f"craft about {found['craft']:.1f} of 5"
    if "coverage" not in found:
        return rated
    if found["order"] < LEAST_ORDER:
        return f"match about {found['match']:.1f} of 5, {rated}" if "match" in found else rated
    of = "the part that style.mask selects" if "masked" in found else "the surface"
    covered = f"carries the style on {100 * found['coverage']:.0f} % of {of}"
    least = min(REGIONS, key=lambda name: found[f"coverage_{name}"])
    share = found[f"coverage_{least}"]
    if share < found["coverage"] - LESS:
        covered += f", on {100 * share:.0f} % of {REGIONS[least]}"
    if "match" in found:
        covered += f"; match about {found['match']:.1f} of 5"
    return f"{covered}, {rated}"
