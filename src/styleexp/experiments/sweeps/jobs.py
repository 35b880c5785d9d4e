"""The jobs of a sweep, and the settings that distinguish them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from styleexp.runs import identity

GROUPS = ("source", "style", "pair")
"""Keys that choose source and style; all others are settings."""


JOBS = "jobs.json"
"""File that lists the planned jobs, so that a job that never started is reported as missing."""


@dataclass(frozen=True)
class Job:
    """One run of a sweep, started or not."""

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
        content = json.loads((folder / JOBS).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    jobs = content.get("jobs", []) if isinstance(content, dict) else None
    if not isinstance(jobs, list) or not all(isinstance(each, list) for each in jobs):
        return None  # a file of another program
    return content


def planned(folder: Path) -> list[Job]:
    """The jobs of Hydra's sweep in ``folder``, in order, whether their folders exist or not.

    If they weren't known in advance (as with Optuna), the jobs that were started.
    """
    content = listed(folder)
    if content is None or "jobs" not in content:
        numbered = (p for p in folder.glob("*") if p.name.isdigit())
        return [_begun(p) for p in sorted(numbered, key=lambda p: int(p.name))]
    keys = content.get("keys") or [None] * len(content["jobs"])
    return _placed(
        [
            Job(str(n), tuple(each), folder / str(n), key)
            for n, (each, key) in enumerate(zip(content["jobs"], keys, strict=True))
        ],
        folder,
    )


def _begun(folder: Path) -> Job:
    """The search job described by a folder's own record."""
    try:
        record = json.loads((folder / "run.json").read_text(encoding="utf-8"))
        return Job(folder.name, tuple(record["overrides"]), folder, identity.of(record))
    except (OSError, ValueError, KeyError, TypeError):
        return Job(folder.name, (), folder)


def _placed(jobs: list[Job], folder: Path) -> list[Job]:
    """Set the jobs' folders, which ``hydra.sweep.subdir`` may name other than by number."""
    if all((job.folder / "run.json").exists() for job in jobs):
        return jobs
    found = {_begun(path.parent).key: path.parent for path in folder.rglob("run.json")}
    found.pop(None, None)
    return [
        job
        if (job.folder / "run.json").exists()
        else replace(job, folder=found.get(job.key, job.folder))
        for job in jobs
    ]


def product(params: Mapping[str, str] | None, overrides: Sequence[str]) -> list[list[str]]:
    """The jobs of Hydra's basic sweeper, in order, as lists of overrides.

    ``params`` are those of ``hydra.sweeper``; ``overrides`` with the same key replace them. Raises
    Hydra's exceptions for values that can't be parsed or aren't a list. Needs an initialised Hydra.
    """
    from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.override_parser.overrides_parser import OverridesParser

    parser = OverridesParser.create(config_loader=GlobalHydra.instance().config_loader())
    given = [f"{key}={value}" for key, value in (params or {}).items()]
    parsed = parser.parse_overrides([*given, *overrides])
    return BasicSweeper.split_arguments(parsed, None)[0]


def varying(jobs: Sequence[Sequence[str]]) -> list[dict[str, str]]:
    """For each job, the overrides that not all jobs share, without Hydra's ``+``."""
    split = [dict(_pair(override) for override in overrides) for overrides in jobs]
    keys = dict.fromkeys(key for each in split for key in each)
    told = [key for key in keys if len({each.get(key) for each in split}) > 1]
    return [{key: each[key] for key in told if key in each} for each in split]


def setting(overrides: Mapping[str, str]) -> str:
    """A short label of the overrides that are settings, such as ``high`` or ``field.sigma=5``."""
    return ", ".join(_label(k, v) for k, v in overrides.items() if k.split(".")[0] not in GROUPS)


def readable(overrides: Mapping[str, str]) -> str:
    """The overrides as typed, for a table."""
    return " ".join(f"{key}={value}" for key, value in overrides.items())


def _label(key: str, value: str) -> str:
    return f"{key}={value}" if "." in key else value


def _pair(override: str) -> tuple[str, str]:
    key, _, value = override.partition("=")
    return key.lstrip("+"), value
