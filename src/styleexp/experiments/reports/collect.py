"""Collect all runs below a folder into one tidy table."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from styleexp.runs import folders, reading
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    import pandas

FIRST = ("run", "status", "seconds", "reason", "device", "loss")
"""Leading columns."""


def collect(folder: str | Path) -> pandas.DataFrame:
    """One row per run below ``folder``, including those that failed or never started.

    Columns: ``run`` (its folder, relative), ``status``, ``seconds``, ``reason``, ``device``,
    ``loss`` (mean of the last tenth of the steps), ``config.*``, ``metric.*``, ``version.*``,
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
    asked = {job.folder: job for job in folders.planned(folder)}
    rows = []
    for run, more in sorted(_runs(folder, asked).items()):
        job = asked.get(folder / run)
        row = reading.read(folder / run) if job is None else reading.of_job(job)
        rows.append({"run": run, **row, **more})
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


def _runs(folder: Path, asked: Iterable[Path]) -> dict[str, dict[str, str]]:
    """The existing and planned runs below a folder, with what plans and sweeps say about them."""
    from styleexp.experiments.sweeps import manifest

    found: dict[str, dict[str, str]] = {run: {} for run in _begun(folder)}
    for path in asked:
        found.setdefault(str(path.relative_to(folder)), {})
    for path in sorted(folder.rglob(manifest.NAME)):
        jobs, below = manifest.read(path.parent), path.parent.relative_to(folder)
        for name, listed in jobs.items():
            run, outdated = str(below / name), listed["state"] == "outdated"
            if outdated and run not in found:
                continue
            known = found.setdefault(run, {})
            known["experiment"] = listed.get("experiment", "")
            if outdated:
                known["status"] = "outdated"
    return found


def _begun(folder: Path) -> Iterator[str]:
    """Yield folders with a run's record or status; runs aren't nested."""
    for at, below, files in os.walk(folder):
        if "status.json" in files or ("run.json" in files and _is_record(Path(at) / "run.json")):
            below.clear()
            yield str(Path(at).relative_to(folder))
        below[:] = sorted(name for name in below if not name.startswith("."))


def _is_record(path: Path) -> bool:
    try:
        return "config" in json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
