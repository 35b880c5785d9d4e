"""Compare the runs of a sweep over renderers with the first run.

``+experiment=backend_agreement`` writes ``figure.png`` (a row of views for each run, and their
absolute difference from the first run's), ``agreement.json`` and a table on the terminal.
"""

from __future__ import annotations

import json
import statistics
from pathlib import Path
from typing import TYPE_CHECKING, Any

from styleexp.experiments.sweeps import report
from styleexp.runs import jobs, reading, results
from styleexp.system import atomic
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    import numpy as np
    from omegaconf import DictConfig

    from styleexp.runs.jobs import Job
    from styleexp.runs.reading import Run
    from styleexp.runs.results import Stored

DIFFERENCE_GAIN = 4
"""Contrast factor for drawing differences."""

HELD_OUT_SEED = 1_000_003
"""Seed offset for held-out cameras, which no run of the sweep was trained with."""


class OnSweepEnd(report.OnSweep):
    """Hydra callback: compare when all jobs have ended, instead of writing the usual report."""

    def on_multirun_end(self, config: DictConfig, **rest: Any) -> None:
        """Compare the runs in the sweep's folder; failed runs are listed as failed."""
        folder = Path(config.hydra.sweep.dir)
        rows = compare(folder)
        atomic.write(folder / "agreement.json", atomic.text(json.dumps(rows, indent=2) + "\n"))
        _print_table(rows, folder)


def compare(folder: Path) -> list[dict[str, Any]]:
    """Return one row per job of the sweep in ``folder``, in order, and draw ``figure.png``.

    ``distance`` is the RMS distance of the result's vertices from the first run's, relative to the
    first run's RMS displacement; ``correlation`` is the correlation of the two displacements;
    ``picture`` is the mean absolute difference of four views, in [0, 1]. ``loss`` is `Run.loss`,
    measured with the run's own renderer. ``held_out_loss`` is measured with the first run's
    renderer and encoder for all runs: the loss at held-out views relative to the source's; 1 means
    no style was gained.
    """
    import numpy as np

    rows, measured = [], []
    for job in jobs.planned(folder):
        run = reading.of_job(job)
        row, result = _row(run, job, folder)
        rows.append(row)
        if result is not None and result.displacement is not None:
            measured.append((row, result, result.displacement, run))
    if not measured:
        return rows

    _, first, displacement, first_run = measured[0]
    scale = max(float(np.sqrt((displacement**2).mean())), 1e-12)
    pictures = []
    for row, result, other, _ in measured:
        pictures.append((row, _views(first.vertices, result.vertices, first.faces)))
        gap = np.linalg.norm(result.vertices - first.vertices, axis=1)
        row["distance"] = float(np.sqrt((gap**2).mean())) / scale
        row["correlation"] = float(np.corrcoef(displacement, other)[0, 1])
        difference = np.abs(pictures[-1][1].astype(float) - pictures[0][1].astype(float))
        row["picture"] = float(difference.mean() / 255)
    _draw(pictures, folder / "figure.png")
    try:
        vertices = [result.vertices for _, result, *_ in measured]
        losses = held_out_losses(first_run.folder, vertices)
    except UserError as error:  # a file of the first run has changed; report the rest
        print(f"note: held_out_loss is not measured: {error}")
        losses = [None] * len(measured)
    for (row, *_), loss in zip(measured, losses, strict=True):
        row["held_out_loss"] = loss
    return rows


def _row(run: Run, job: Job, folder: Path) -> tuple[dict[str, Any], Stored | None]:
    """A job's row as far as its own files tell, and its result, if it has one to compare."""
    asked = [o.partition("=")[2] for o in job.overrides if o.startswith("renderer=")]
    row = {
        "run": str(run.folder.relative_to(folder)),
        "renderer": run.config.get("renderer.name", "".join(asked[-1:])),
        "status": run.status,
    }
    if run.status != "done":
        return row | {"reason": run.remark or ""}, None
    try:
        result = results.read(run.folder / results.NAME)
        if result.displacement is None:
            raise UserError(f"'{run.folder / results.NAME}' has no displacement: run again.")
    except UserError as error:
        return row | {"status": "unreadable", "reason": str(error)}, None
    if pace := [step["seconds"] for step in run.steps if "seconds" in step]:
        row["seconds_per_step"] = statistics.median(pace)
    if run.loss is not None:
        row["loss"] = run.loss
    return row, result


def held_out_losses(folder: Path, moved: list[np.ndarray]) -> list[float] | list[None]:
    """Loss of each result (vertices, 3) at the style bank's views, relative to the source's loss,
    with the settings and files of the run in ``folder``. Raises `UserError` if those have changed.

    All entries are None if results were saved with more vertices than the source, split at seams.
    """
    import torch

    from styleexp.config import build
    from styleexp.method import targets
    from styleexp.method.scene import PaperScene
    from styleexp.runs import origins

    record = reading.recorded(folder, "compare").record
    config = origins.restored(record, folder, "compare")
    config.optim.seed += HELD_OUT_SEED  # local views of one seed all come from one bank of cameras
    _, scene = build.prepare(config)
    assert isinstance(scene, PaperScene)
    subject, weights = scene.subject, config.loss
    if any(len(vertices) != len(subject.source.vertices) for vertices in moved):
        return [None] * len(moved)
    target, loss = scene.target(targets.BANK_STEP), scene.loss

    def measure(vertices: torch.Tensor) -> float:
        found = targets.mesh_statistics(loss, scene.viewer, vertices, weights.bank_views)
        parts = [
            float(loss.distance(*each)) for each in zip(found, target, scene.scales, strict=True)
        ]
        return weights.lambda_global * parts[0] + weights.lambda_local * parts[1]

    own = measure(subject.surface.vertices)
    return [
        measure(torch.from_numpy(subject.frame.apply(v)).to(subject.surface.vertices)) / own
        for v in moved
    ]


def _views(first: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    from styleexp.inputs import meshes
    from styleexp.runs import previews

    frame = meshes.normalisation(first)
    elevations, azimuths = [v[1] for v in previews.VIEWS], [v[2] for v in previews.VIEWS]
    return previews.render_views(frame.apply(vertices), faces, elevations, azimuths, 320)


def _draw(pictures: list[tuple[dict[str, Any], np.ndarray]], path: Path) -> None:
    import numpy as np
    from PIL import Image

    from styleexp.runs.previews import sheet

    rows = []
    reference = pictures[0][1].astype(float)
    for row, views in pictures:
        rows.append((f"{row['renderer']}: result", [Image.fromarray(v) for v in views]))
        if len(rows) > 1:
            gap = 255 - DIFFERENCE_GAIN * np.abs(views.astype(float) - reference)
            dark = [Image.fromarray(v) for v in gap.clip(0, 255).astype(np.uint8)]
            label = f"{row['renderer']}: difference from {pictures[0][0]['renderer']}"
            rows.append((f"{label}, {DIFFERENCE_GAIN} times as dark", dark))
    atomic.write(path, lambda at: sheet(rows, views.shape[1]).save(at))


def _print_table(rows: list[dict[str, Any]], folder: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title="the same stylisation with every renderer")
    columns = (
        "renderer",
        "status",
        "seconds_per_step",
        "loss",
        "held_out_loss",
        "distance",
        "correlation",
        "picture",
    )
    for column in columns:
        table.add_column(column.replace("_", " "))
    for row in rows:
        cells = [row.get(column, "") for column in columns]
        table.add_row(*(f"{c:.4g}" if isinstance(c, float) else str(c) for c in cells))
    console = Console()
    if not console.is_terminal:
        console = Console(width=120)  # a log has no width; don't wrap column names
    console.print(table)
    console.print(f"{folder}/figure.png, {folder}/agreement.json", soft_wrap=True)
