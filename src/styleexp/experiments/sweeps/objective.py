"""Objective of a search: see ``conf/search``."""

from __future__ import annotations

import os
from pathlib import Path

from styleexp.runs import reading
from styleexp.system.errors import UserError

LEAST_CRAFT = "STYLEEXP_LEAST_CRAFT"
"""Environment variable with the craft that a result has to keep; ``conf/search`` sets it for each
job."""
PENALTY = 2.0
"""Match that a point of missing craft costs."""


def objective(folder: Path) -> float:
    """Estimated match of a finished run, from 1 to 5, less a penalty for missing craft: the two
    measures that were chosen by raters (`experiments.ratings`).

    Reads ``match`` and ``craft`` from the run's ``metrics.json``; raises `UserError` if they are
    missing.
    """
    run = reading.read(folder)
    least = float(os.environ[LEAST_CRAFT])
    missing = [name for name in ("match", "craft") if name not in run.metrics]
    if missing:
        raise UserError(
            f"a search needs match and craft in '{folder / 'metrics.json'}', but "
            f"{' and '.join(missing)} can't be read."
        )
    return run.metrics["match"] - PENALTY * max(0.0, least - run.metrics["craft"])
