"""Collect all runs below a folder into one tidy table."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from styleexp.runs import finding
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    import pandas

    from styleexp.runs.reading import Run

FIRST = ("run", "status", "seconds", "reason", "device", "loss")
"""Leading columns."""


def collect(folder: str | Path) -> pandas.DataFrame:
    """One row per run below ``folder``, including those that failed or never started.

    Columns: ``run`` (its folder, relative), ``status``, ``seconds``, ``reason``, ``device``,
    ``loss`` (`reading.final_loss`), ``config.*``, ``metric.*``, ``version.*``,
    ``asset.*`` (sha256), ``experiment`` if known from a plan. ``status`` is the run's own, or
    ``missing`` (planned but never started), ``died`` (its process was killed), ``outdated`` (its
    plan has changed since), or ``other`` (the job's folder contains another run). List values are
    JSON. Raises `UserError` without pandas (extra ``report``), or if the folder doesn't exist.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise UserError(f"there is no folder '{folder}' to collect runs from.")
    try:
        import pandas
    except ImportError:
        raise UserError("collecting needs pandas: pip install 'styleexp[report]'.") from None
    listed = _listed(folder)
    runs = {str(run.folder.relative_to(folder)): run for run in finding.find(folder)}
    rows = [
        {"run": path, **row(run), **listed.get(run.folder, {})}
        for path, run in sorted(runs.items())
    ]
    frame = pandas.DataFrame(rows, columns=None if rows else list(FIRST))
    rest = sorted(column for column in frame.columns if column not in FIRST)
    return frame.reindex(columns=[*FIRST, *rest])


def write(frame: pandas.DataFrame, folder: str | Path) -> list[Path]:
    """Write ``runs.csv`` and ``runs.parquet``; return their paths.

    Parquet columns have a single type: columns of mixed types are written as text.
    """
    from styleexp.runs.records import RunFolder

    target = RunFolder(Path(folder))
    typed = frame.copy()
    for name in typed.columns:
        kinds = {type(value) for value in typed[name].dropna()}
        if len(kinds - {int, float}) > (0 if kinds & {int, float} else 1):
            typed[name] = typed[name].map(str, na_action="ignore")
    try:
        parquet = target.write("runs.parquet", lambda path: typed.to_parquet(path, index=False))
    except ImportError:
        raise UserError("Parquet needs pyarrow: pip install 'styleexp[report]'.") from None
    return [target.write("runs.csv", lambda path: frame.to_csv(path, index=False)), parquet]


def row(run: Run) -> dict[str, Any]:
    """A run as a flat row, with the columns of `collect`."""
    flat: dict[str, Any] = {
        "status": run.status,
        "seconds": run.seconds,
        "reason": run.remark,
        "device": run.device,
        "loss": run.loss,
    }
    flat |= {f"metric.{name}": value for name, value in run.measured.items()}
    for key, value in run.config.items():
        flat[f"config.{key}"] = json.dumps(value) if isinstance(value, list) else value
    for name, version in (run.record.get("versions") or {}).items():
        flat[f"version.{name}"] = version
    for role, asset in (run.record.get("assets") or {}).items():
        flat[f"asset.{role}"] = asset.get("sha256") or asset.get("name")
    return flat


def _listed(folder: Path) -> dict[Path, dict[str, str]]:
    """What the plans below a folder say about their jobs, by the jobs' folders."""
    from styleexp.experiments.sweeps import manifest

    found: dict[Path, dict[str, str]] = {}
    for path in sorted(folder.rglob(manifest.NAME)):
        for name, job in manifest.read(path.parent).items():
            columns = found.setdefault(path.parent / name, {})
            columns["experiment"] = job.get("experiment", "")
            if job["state"] == "outdated":
                columns["status"] = "outdated"
    return found
