"""Find the runs below a folder, whether they have started or not."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

from styleexp.runs import jobs, reading, untrusted
from styleexp.runs.reading import Run

HYDRAS = ".hydra/overrides.yaml"
"""File that Hydra writes before the run has a record."""
DATED = re.compile(r"(\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d)(?:_(\d+))?")
"""Name of a folder that is named by the time, and which of that second's it is."""


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


def sweeps_of_experiment(folder: Path) -> list[Path]:
    """The sweeps of the experiment that ``folder`` is named after, oldest first.

    ``styleexp +experiment=NAME`` puts them into ``outputs/NAME``, named by the time. Empty for any
    other folder.
    """
    name = folder.resolve().name
    dated = [(DATED.fullmatch(path.name), path) for path in folder.iterdir() if path.is_dir()]
    found = [
        (match[1], int(match[2] or 1), path)
        for match, path in dated
        if match and _experiment(path) == name
    ]
    return [path for *_, path in sorted(found)]


def _experiment(sweep: Path) -> str | None:
    """The experiment of a sweep, as its jobs' overrides name it."""
    for overrides in (jobs.listed(sweep) or {}).get("jobs", ())[:1]:
        for each in overrides:
            key, _, value = each.lstrip("+").partition("=")
            if key == "experiment":
                return str(value)
    return None


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
