"""The planned jobs of a sweep or plan, as listed in its folder."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from styleexp.runs import identity, untrusted

JOBS = "jobs.json"
"""File of a sweep that lists its jobs, so that a job that never started is reported as missing."""
MANIFEST = "manifest.json"
"""File of a plan that lists its jobs, with their states."""


@dataclass(frozen=True)
class Job:
    """One run of a sweep or plan, started or not."""

    name: str
    """Name, unique in the sweep; Hydra's job number in Hydra's sweeps."""
    overrides: tuple[str, ...]
    folder: Path
    key: str | None = None
    """Key of the requested run (`styleexp.runs.identity`); None for sweeps of earlier versions."""


def listed(folder: Path) -> dict[str, Any] | None:
    """A sweep's ``jobs.json``: its ``jobs`` as lists of overrides and their ``keys`` (missing in
    earlier versions), or the ``search`` that generates them. None if missing or unreadable."""
    try:
        content = untrusted.load(folder / JOBS)
    except untrusted.Unreadable:
        return None
    jobs = content.get("jobs", [])
    if not content or not isinstance(jobs, list) or not all(map(untrusted.is_texts, jobs)):
        return None  # a file of another program
    return content


def planned(folder: Path) -> list[Job]:
    """The jobs of Hydra's sweep in ``folder``, in order, whether their folders exist or not.

    If they weren't known in advance (as with Optuna), the jobs that were started.
    """
    content = listed(folder)
    if content is None or "jobs" not in content:
        numbered = (p for p in folder.glob("*") if p.name.isdecimal())
        return [_started(p) for p in sorted(numbered, key=lambda p: int(p.name))]
    keys = content.get("keys")
    if not isinstance(keys, list) or len(keys) != len(content["jobs"]):
        keys = [None] * len(content["jobs"])
    return _placed(
        [
            Job(str(n), tuple(overrides), folder / str(n), _text(key))
            for n, (overrides, key) in enumerate(zip(content["jobs"], keys, strict=True))
        ],
        folder,
    )


def below(folder: Path) -> Iterator[Job]:
    """Yield the jobs listed by sweeps and plans at or below ``folder``, without outdated ones."""
    for path in folder.rglob(JOBS):
        if (listed(path.parent) or {}).get("jobs"):
            yield from planned(path.parent)
    for path in folder.rglob(MANIFEST):
        yield from _of_plan(path)


def _of_plan(path: Path) -> Iterator[Job]:
    """Yield the jobs of a plan's manifest; none if it is damaged or of another program."""
    try:
        jobs = untrusted.load(path).get("jobs")
    except untrusted.Unreadable:
        return
    for name, job in jobs.items() if isinstance(jobs, dict) else ():
        if isinstance(job, dict) and job.get("state") != "outdated" and untrusted.is_below(name):
            overrides = job.get("overrides")
            given = tuple(overrides or ()) if untrusted.is_texts(overrides) else ()
            yield Job(name, given, path.parent / name, _text(job.get("key")))


def _started(folder: Path) -> Job:
    """The job that a folder's own record describes."""
    try:
        record, _ = untrusted.load_record(folder / "run.json")
    except untrusted.Unreadable:
        record = {}
    return Job(folder.name, tuple(record.get("overrides") or ()), folder, identity.of(record))


def _placed(jobs: list[Job], folder: Path) -> list[Job]:
    """Set the jobs' folders, which ``hydra.sweep.subdir`` may name other than by number."""
    if all((job.folder / "run.json").exists() for job in jobs):
        return jobs
    found = {_started(path.parent).key: path.parent for path in folder.rglob("run.json")}
    found.pop(None, None)
    return [
        job
        if (job.folder / "run.json").exists()
        else replace(job, folder=found.get(job.key, job.folder))
        for job in jobs
    ]


def _text(value: Any) -> str | None:
    return value if isinstance(value, str) else None
