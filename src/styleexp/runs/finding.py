"""Find the runs below a folder, whether they have started or not."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from styleexp.runs import jobs, reading, untrusted
from styleexp.runs.reading import Run

HYDRAS = ".hydra/overrides.yaml"
"""File that Hydra writes before the run has a record."""


def find(folder: Path) -> list[Run]:
    """Every run at or below ``folder``, in the order of the jobs' numbers, then of the names.

    A job listed in a sweep's ``jobs.json`` or a plan's ``manifest.json`` is read with
    `reading.of_job`; if it never started, it has the status ``missing``.
    """
    asked = {job.folder: job for job in jobs.below(folder)}
    runs = [reading.of_job(job) for job in asked.values()]
    runs += [reading.read(at) for at in folders(folder) if at not in asked]
    return sorted(runs, key=lambda run: _natural(run.folder, folder))


def folders(folder: Path) -> Iterator[Path]:
    """Yield the folders of started runs at or below ``folder``. Hidden folders, and folders inside
    of a run's, are not searched."""
    for at, below, files in os.walk(folder):
        path = Path(at)
        if "status.json" in files or ("run.json" in files and _is_record(path / "run.json")):
            below.clear()
            yield path
        elif (path / HYDRAS).is_file():
            yield path
        below[:] = sorted(name for name in below if not name.startswith("."))


def is_run(folder: Path) -> bool:
    """Whether the folder itself contains files of a run."""
    return any((folder / name).is_file() for name in ("run.json", "status.json", HYDRAS))


def _is_record(path: Path) -> bool:
    """Whether a ``run.json`` is a run's, if perhaps damaged, and not another program's."""
    try:
        return "config" in untrusted.load(path)
    except untrusted.Unreadable:
        return True


def _natural(path: Path, root: Path) -> list[tuple[int, int, str]]:
    """Sort key by which job 10 follows job 9."""
    parts = path.relative_to(root).parts
    return [(0, int(p), "") if p.isdecimal() else (1, 0, p) for p in parts]
