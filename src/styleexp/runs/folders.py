"""Read run folders in any state: finished or not, intact or damaged."""

from __future__ import annotations

import json
import shlex
import statistics
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any

from styleexp.experiments.sweeps import jobs
from styleexp.experiments.sweeps.jobs import Job
from styleexp.runs import identity
from styleexp.runs.schema import too_new
from styleexp.system import locks
from styleexp.system.errors import UserError

MARKS = ("run.json", "status.json", ".hydra/overrides.yaml")
"""Files that mark a run's folder; Hydra's exists before the run has a record."""


@dataclass(frozen=True)
class Run:
    """One run's files, read once. Missing files are empty; damaged ones are listed in
    ``problems``."""

    folder: Path
    record: dict[str, Any] = field(default_factory=dict)
    """``run.json``."""
    status: dict[str, Any] = field(default_factory=dict)
    """``status.json``."""
    steps: list[dict[str, float]] = field(default_factory=list)
    """``metrics.jsonl``."""
    metrics: dict[str, float] = field(default_factory=dict)
    """``metrics.json``: the metrics of the result."""
    overrides: list[str] = field(default_factory=list)
    problems: tuple[str, ...] = ()

    @property
    def state(self) -> str:
        """``done``, ``running``, ``interrupted`` or ``failed``; ``missing`` if it never started,
        ``died`` if its status is running but it has no process, ``newer`` if a later version of
        styleexp wrote it, ``other`` if a sweep's job folder contains another run."""
        return str(self.status.get("status", "missing"))

    @property
    def config(self) -> dict[str, Any]:
        """The configuration, flattened to dotted keys."""
        return flatten(self.record.get("config") or {})

    @property
    def title(self) -> str:
        """Source and style as a title."""
        return f"{self.part('source')} in the style of {self.part('style')}"

    def part(self, kind: str) -> str:
        """Name of the ``source`` or ``style``."""
        chosen = (self.record.get("config") or {}).get(kind) or {}
        if chosen.get("path"):
            return PurePath(chosen["path"]).stem
        return str(chosen.get("name") or self._planned(kind) or f"unknown {kind}")

    def _planned(self, kind: str) -> str | None:
        """Name of the ``source`` or ``style`` of a run that never started, from its overrides."""
        given = dict(each.lstrip("+").split("=", 1) for each in self.overrides if "=" in each)
        if f"{kind}.path" in given:
            return PurePath(given[f"{kind}.path"]).stem
        source, _, style = given.get("pair", "").partition("_")  # as conf/pair names them
        return given.get(kind) or {"source": source, "style": style}[kind] or None

    @property
    def command(self) -> str:
        """The command that repeats the run."""
        return shlex.join(["styleexp", *self.overrides])

    @property
    def seconds(self) -> float | None:
        """Wall time of a finished run."""
        value = self.status.get("seconds")
        return float(value) if isinstance(value, int | float) else None

    @property
    def summary(self) -> dict[str, float]:
        """Numbers for comparing runs: the mean loss over the last tenth of the steps, and the
        result's metrics."""
        found: dict[str, float] = {}
        losses = [s["loss"] for s in self.steps if "loss" in s]
        if losses:
            found["loss"] = statistics.fmean(losses[-max(1, len(losses) // 10) :])
        if self.state == "done" and self.steps and "rms_displacement" in self.steps[-1]:
            found["rms_displacement"] = self.steps[-1]["rms_displacement"]
        return found | self.metrics


def read(folder: Path) -> Run:
    """Read a run's folder, as far as possible."""
    problems: list[str] = []

    def load(name: str) -> dict[str, Any]:
        path = folder / name
        if not path.is_file():
            return {}
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            if not isinstance(content, dict):
                raise ValueError("it is not a JSON object")
        except (OSError, ValueError) as error:
            problems.append(f"{name} cannot be read ({error}).")
            return {}
        return content

    record, status, measured = load("run.json"), load("status.json"), load("metrics.json")
    if told := too_new(record) or too_new(status):
        return Run(folder, status={"status": "newer", "reason": told}, problems=(told,))
    if status.get("status") == "running" and not locks.held(folder):
        status["status"] = "died"
    metrics = {
        name: float(value)
        for name, value in measured.items()
        if isinstance(value, int | float) and not isinstance(value, bool)
    }
    overrides = record.get("overrides")
    return Run(
        folder,
        record,
        status,
        _steps(folder / "metrics.jsonl", problems),
        metrics,
        _composed(folder) if overrides is None else list(overrides),
        tuple(problems),
    )


def readable(folder: Path, purpose: str) -> Run:
    """Like `read`, but raises `UserError` for a run of a later version of styleexp."""
    run = read(folder)
    if run.state == "newer":
        raise UserError(f"cannot {purpose} '{folder}': {run.status['reason']}")
    return run


def is_run(folder: Path) -> bool:
    """Whether the folder contains files of a run."""
    return any((folder / mark).is_file() for mark in MARKS)


def find(folder: Path) -> list[Run]:
    """Every run at or below ``folder``, sorted by job number, then name.

    Jobs listed in a sweep's ``jobs.json`` or a plan's ``manifest.json`` that never started are
    included, with their overrides and the state ``missing``.
    """
    found = {path.parents[m.count("/")]: None for m in MARKS for path in folder.rglob(m)}
    asked = {job.folder: job for job in planned(folder)}
    runs = [_of_job(read(path), asked.get(path)) for path in found]
    runs += [Run(at, overrides=list(j.overrides)) for at, j in asked.items() if at not in found]
    return sorted(runs, key=lambda run: natural(run.folder, folder))


def planned(folder: Path) -> Iterator[Job]:
    """The jobs listed by sweeps and plans at or below ``folder``, without outdated ones."""
    for path in folder.rglob(jobs.JOBS):
        if (jobs.listed(path.parent) or {}).get("jobs"):
            yield from jobs.planned(path.parent)
    for path in folder.rglob("manifest.json"):
        for name, job in dict(_listed(path) or {}).items():
            if isinstance(job, dict) and job.get("state") != "outdated":
                given = tuple(map(str, job.get("overrides") or []))
                yield Job(name, given, path.parent / name, job.get("key"))


def _of_job(run: Run, job: Job | None) -> Run:
    """The run in a job's folder if it is the job's; else the job, with the mismatch as its
    state."""
    if job is None or run.state == "newer" or not (run.record or run.state == "done"):
        return run
    state, told = "unreadable", "it has no run.json that can be read"
    if run.record:
        state, told = "other", identity.not_of(job.key, job.overrides, run.record) or ""
        if not told:
            return run
    status = {"status": state, "reason": told}
    return Run(run.folder, status=status, overrides=list(job.overrides), problems=(f"{told}.",))


def _listed(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))["jobs"]
    except (OSError, ValueError, KeyError, TypeError):
        return None  # a file of another program


def natural(path: Path, root: Path) -> list[tuple[int, int, str]]:
    """Natural sort key: job 10 follows job 9."""
    parts = path.relative_to(root).parts
    return [(0, int(p), "") if p.isdigit() else (1, 0, p) for p in parts]


def flatten(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested dictionaries to dotted keys."""
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, dict):
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[prefix + key] = value
    return flat


def _steps(path: Path, problems: list[str]) -> list[dict[str, float]]:
    if not path.is_file():
        return []
    steps, damaged = [], 0
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            step = json.loads(line)
            step["step"] = int(step["step"])
            steps.append(step)
        except (ValueError, KeyError, TypeError):
            damaged += 1
    if damaged:
        problems.append(f"metrics.jsonl: {damaged} damaged lines were left out.")
    return steps


def _composed(folder: Path) -> list[str]:
    """The overrides that Hydra recorded for a job that stopped before it had a record."""
    path = folder / ".hydra" / "overrides.yaml"
    if not path.is_file():
        return []
    from omegaconf import OmegaConf
    from yaml import YAMLError

    try:
        found = OmegaConf.to_container(OmegaConf.load(path))
    except (OSError, YAMLError):  # Hydra was killed while writing
        return []
    return [str(each) for each in found] if isinstance(found, list) else []
