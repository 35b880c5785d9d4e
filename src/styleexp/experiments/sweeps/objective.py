"""Objective of a search: see ``conf/search``."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from styleexp.runs import reading, untrusted
from styleexp.system.errors import UserError

LEAST_CRAFT = "STYLEEXP_LEAST_CRAFT"
"""Environment variable with the craft that a result has to keep; ``conf/search`` sets it for each
job."""
PENALTY = 2.0
"""Match that a point of missing craft costs."""
TRIAL = "trial.json"
"""File of a trial with its ``scores`` on the way, by step, and, if it was pruned, what the search
is ``told`` of it."""


def objective(folder: Path) -> float:
    """`score` of a finished run, from its ``metrics.json``; of a pruned one, what it left
    (`pruning.Trial`), even if it was finished later by hand: the search has gone on with that."""
    told = untrusted.number(noted(folder).get("told"))
    if told is not None:
        return told
    return score(reading.read(folder).metrics)


def score(measured: Mapping[str, float]) -> float:
    """Estimated match of a result, from 1 to 5, less a penalty for missing craft: the two measures
    that were chosen by raters (`experiments.ratings`).

    Raises `UserError` where they weren't measured.
    """
    least = float(os.environ[LEAST_CRAFT])
    missing = [name for name in ("match", "craft") if name not in measured]
    if missing:
        raise UserError(
            f"a search needs match and craft, but {' and '.join(missing)} of this result can't be "
            "measured: metrics.judge must name an encoder, and the style must have relief."
        )
    return measured["match"] - PENALTY * max(0.0, least - measured["craft"])


def noted(folder: Path) -> dict[str, Any]:
    """A trial's `TRIAL`; empty if there is none that can be read."""
    try:
        return untrusted.load(folder / TRIAL)
    except untrusted.Unreadable:
        return {}
