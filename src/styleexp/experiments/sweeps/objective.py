"""Objective of a search: see ``conf/search``."""

from __future__ import annotations

import os
from pathlib import Path

from styleexp.runs import reading
from styleexp.system.errors import UserError

LEAST_IOU = "STYLEEXP_LEAST_IOU"
"""Environment variable with the IoU constraint; ``conf/search`` sets it for each job."""
PENALTY = 10.0
"""Penalty per unit of missing IoU: 0.1 too little counts as much as gaining no style at all, since
the style distance is relative to the source's."""


def objective(folder: Path) -> float:
    """Held-out style distance of a finished run, with a penalty if the outline moved too far.

    Reads ``style_distance`` and ``silhouette_iou`` from the run's ``metrics.json``; raises
    `UserError` if they are missing.
    """
    run = reading.read(folder)
    least = float(os.environ[LEAST_IOU])
    missing = [name for name in ("style_distance", "silhouette_iou") if name not in run.metrics]
    if missing:
        raise UserError(
            f"a search needs style_distance and silhouette_iou in '{folder / 'metrics.json'}', but "
            f"{' and '.join(missing)} can't be read."
        )
    distance, iou = run.metrics["style_distance"], run.metrics["silhouette_iou"]
    return distance + PENALTY * max(0.0, least - iou)
