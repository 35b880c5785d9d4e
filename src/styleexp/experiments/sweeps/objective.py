"""Objective of a search: see ``conf/search``."""

from __future__ import annotations

import json
import os
from pathlib import Path

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
    path = folder / "metrics.json"
    least = float(os.environ[LEAST_IOU])
    try:
        metrics = json.loads(path.read_text(encoding="utf-8"))
        distance, iou = float(metrics["style_distance"]), float(metrics["silhouette_iou"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(
            f"a search needs style_distance and silhouette_iou in '{path}', but they can't be read "
            f"({type(error).__name__})."
        ) from error
    return distance + PENALTY * max(0.0, least - iou)
