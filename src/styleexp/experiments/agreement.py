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
from styleexp.runs import reading
from styleexp.system import atomic
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    import numpy as np
    from omegaconf import DictConfig

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
    ``picture`` is the mean absolute difference of four views, in [0, 1]. ``loss`` is the mean over
    the last tenth of the steps, measured with the run's own renderer. ``held_out_loss`` is measured
    with the first run's renderer and encoder for all runs: the loss at held-out views relative to
    the source's; 1 means no style was gained.
    """
    import numpy as np

    rows, results = [], []
    for job in report.planned(folder):
        found, run = reading.of_job(job), job.folder
        named = [o.partition("=")[2] for o in job.overrides if o.startswith("renderer=")]
        row = {
            "run": str(run.relative_to(folder)),
            "renderer": found.get("config.renderer.name", "".join(named[-1:])),
            "status": found["status"],
        }
        rows.append(row)
        if found["status"] != "done":
            row["reason"] = found["reason"] or ""
            continue
        lines = (run / "metrics.jsonl").read_text(encoding="utf-8").splitlines()
        steps = [json.loads(line) for line in lines]
        row["seconds_per_step"] = statistics.median(s["seconds"] for s in steps)
        row["loss"] = statistics.fmean(s["loss"] for s in steps[-max(1, len(steps) // 10) :])
        results.append((row, *_result(run / "result.ply")))
    if not results:
        return rows

    _, first, faces, displacement = results[0]
    pictures = []
    for row, vertices, _, other in results:
        pictures.append((row, _views(first, vertices, faces)))
        gap = np.linalg.norm(vertices - first, axis=1)
        scale = max(float(np.sqrt((displacement**2).mean())), 1e-12)
        row["distance"] = float(np.sqrt((gap**2).mean())) / scale
        row["correlation"] = float(np.corrcoef(displacement, other)[0, 1])
        difference = np.abs(pictures[-1][1].astype(float) - pictures[0][1].astype(float))
        row["picture"] = float(difference.mean() / 255)
    _draw(pictures, folder / "figure.png")
    try:
        distances = held_out_losses(folder / results[0][0]["run"], [v for _, v, *_ in results])
    except UserError as error:  # a file of the first run has changed; report the rest
        print(f"note: held_out_loss is not measured: {error}")
        distances = [None] * len(results)
    for (row, *_), distance in zip(results, distances, strict=True):
        row["held_out_loss"] = distance
    return rows


def held_out_losses(run: Path, results: list[np.ndarray]) -> list[float] | list[None]:
    """Loss of each result (vertices, 3) at the style bank's views, relative to the source's loss,
    with the settings and files of ``run``. Raises `UserError` if those have changed.

    All entries are None if results were saved with more vertices than the source, split at seams.
    """
    import torch

    from styleexp.config import build
    from styleexp.method import targets
    from styleexp.method.scene import PaperScene
    from styleexp.runs import origins, records

    config = origins.restored(records.read_record(run, "compare"), run, "compare")
    config.optim.seed += HELD_OUT_SEED  # local views of one seed all come from one bank of cameras
    _, scene = build.prepare(config)
    assert isinstance(scene, PaperScene)
    subject, weights = scene.subject, config.loss
    if any(len(vertices) != len(subject.source.vertices) for vertices in results):
        return [None] * len(results)
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
        for v in results
    ]


def _result(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, faces and displacement of a result, as stored in its file."""
    from styleexp.inputs.meshes.ply import stored_result

    vertices, faces, displacement = stored_result(path.read_bytes())
    assert displacement is not None
    return vertices, faces, displacement


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
