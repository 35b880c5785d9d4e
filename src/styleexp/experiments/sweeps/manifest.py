"""A plan's ``manifest.json``: every job with its key, state and folder.

A job's own folder is authoritative: the status it wrote, and the lock its process holds. The
manifest is for people and later tools; it has its own lock.
"""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from styleexp.experiments.sweeps.plan import Planned
from styleexp.runs import reading, records
from styleexp.runs.jobs import MANIFEST as NAME
from styleexp.runs.reading import Run
from styleexp.system import locks
from styleexp.system.errors import UserError

SCHEMA = 1
PATIENCE = 60.0
"""Seconds to wait for the manifest's lock."""
ENDED = ("done", "failed")
"""Final states of a job."""


def write(folder: Path, jobs: Iterable[Planned]) -> None:
    """Write the jobs of a plan; jobs of other plans, or of an earlier version of this one, are
    marked as outdated."""
    with locks.hold(folder, PATIENCE):
        before = read(folder)
        listed = {}
        for job in jobs:
            run = reading.of_job(job)
            refuse_others(job, run)
            known = before.pop(job.name, {})
            known = known if known.get("key") == job.key else {}
            listed[job.name] = {
                "key": job.key,
                "experiment": job.entry,
                "overrides": list(job.overrides),
                "state": run.status,
                "attempts": known.get("attempts", 0),
            } | {k: known[k] for k in ("host", "process", "changed") if k in known}
        for name, known in before.items():
            listed.setdefault(name, {**known, "state": "outdated"})
        _write(folder, listed)


def refuse_others(job: Planned, run: Run) -> None:
    """Raise `UserError` if a job's folder contains another run, or one of a later version."""
    if run.status == "newer":
        raise UserError(f"cannot run in '{job.folder}': {run.reason}")
    if run.status == "other":
        raise UserError(
            f"'{job.folder}' doesn't belong to this plan ({run.reason}): move it away, or "
            "choose another --folder."
        )


def read(folder: Path) -> dict[str, dict[str, Any]]:
    """The manifest's jobs, keyed by their folder below the plan's; empty if there is no
    manifest."""
    path = folder / NAME
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise UserError(f"'{path}' can't be read ({error}): remove it (runs are kept).") from error
    if content.get("schema") != SCHEMA:
        raise UserError(f"'{path}' was written by another version: choose another --folder.")
    return dict(content["jobs"])


def update(folder: Path, name: str, state: str) -> dict[str, dict[str, Any]]:
    """Record a job's new state and host; return all jobs."""
    with locks.hold(folder, PATIENCE):
        jobs = read(folder)
        job = jobs.setdefault(name, {})
        job |= {"state": state, "changed": records.now()}
        if state == "running":
            job |= {"host": platform.node(), "process": os.getpid()}
            job["attempts"] = job.get("attempts", 0) + 1
        _write(folder, jobs)
        return jobs


def home(folder: Path) -> Path | None:
    """The working folder in which a plan was started, which its relative paths refer to."""
    try:
        return Path(json.loads((folder / NAME).read_text(encoding="utf-8"))["begun_in"])
    except (OSError, ValueError, KeyError, TypeError):  # missing, or of an earlier version
        return None


def _write(folder: Path, jobs: dict[str, dict[str, Any]]) -> None:
    begun_in = str(home(folder) or Path.cwd())
    content = {"schema": SCHEMA, "begun_in": begun_in, "jobs": jobs}
    records.RunFolder(folder).write_json(NAME, content)
