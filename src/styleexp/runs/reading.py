"""Read a run's folder in any state: finished or not, intact or damaged, of any version.

This is the only reader of a run's JSON files; `styleexp.runs.results` reads its result, and
`styleexp.runs.finding` finds the folders. Needs only the standard library.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any

from styleexp.runs import identity, untrusted
from styleexp.runs.schema import too_new
from styleexp.system import locks
from styleexp.system.errors import UserError
from styleexp.system.options import flatten

if TYPE_CHECKING:
    from styleexp.runs.jobs import Job

LAST_SHARE = 10
"""Inverse fraction of the steps that `final_loss` averages: the last tenth."""


@dataclass(frozen=True)
class Run:
    """One run's folder, as far as it can be read.

    The status, the record and the overrides are read at once; the numbers when they are asked for.
    """

    folder: Path
    status: str = "missing"
    """``done``, ``running``, ``interrupted``, ``failed`` or, of a search's trial that was hopeless,
    ``pruned``, as the run wrote it; or ``missing`` if it never started, ``died`` if it is said to
    be running but has no process, ``unreadable`` if its files don't tell, ``newer`` if a later
    version of styleexp wrote it, ``other`` if a job's folder holds another run."""
    reason: str | None = None
    """Why the run has this status, if known."""
    seconds: float | None = None
    """Wall time of a finished or pruned run."""
    record: dict[str, Any] = field(default_factory=dict)
    """``run.json``; empty if there is none that can be used."""
    overrides: list[str] = field(default_factory=list)
    faults: tuple[str, ...] = ()
    """One sentence for each damaged JSON file or section."""
    last_status: str | None = None
    """The status in ``status.json``, whether or not it still holds; None if there is none."""
    has_numbers: bool = True
    """Whether the numbers in the folder are this run's."""

    @cached_property
    def config(self) -> dict[str, Any]:
        """The configuration's values by their dotted keys."""
        return flatten(self.record.get("config") or {})

    @cached_property
    def steps(self) -> list[dict[str, float]]:
        """The numbers of each step, in order, from ``metrics.jsonl``; without damaged lines."""
        return self._lines[0]

    @cached_property
    def measured(self) -> dict[str, Any]:
        """``metrics.json`` as written: what was measured of the result, without nested values."""
        plain = (int, float, str, type(None))
        return {name: v for name, v in self._metrics[0].items() if isinstance(v, plain)}

    @cached_property
    def metrics(self) -> dict[str, float]:
        """The result's metrics, which are the numbers among ``measured``."""
        numbers = {name: untrusted.number(value) for name, value in self.measured.items()}
        return {name: float(value) for name, value in numbers.items() if value is not None}

    @property
    def loss(self) -> float | None:
        """The run's final loss, see `final_loss`."""
        return final_loss(self.steps)

    @property
    def summary(self) -> dict[str, float]:
        """Numbers for comparing runs: the final loss, the last displacement of a finished run, and
        the result's metrics."""
        found = {} if self.loss is None else {"loss": self.loss}
        if self.status == "done" and self.steps and "rms_displacement" in self.steps[-1]:
            found["rms_displacement"] = self.steps[-1]["rms_displacement"]
        return found | self.metrics

    @property
    def device(self) -> str | None:
        """The device the run used."""
        device = self.record.get("device")
        return device if isinstance(device, str) else None

    @property
    def problems(self) -> tuple[str, ...]:
        """One sentence for everything in the folder that is damaged."""
        damaged = self._lines[1]
        lost = (f"metrics.jsonl: {damaged} damaged lines were left out.",) if damaged else ()
        return (*self.faults, *self._metrics[1], *lost)

    @property
    def remark(self) -> str | None:
        """The reason and the damaged files on one line, for a table; None if there is nothing to
        say."""
        faults = [fault.removesuffix(".") for fault in (*self.faults, *self._metrics[1])]
        return "; ".join(filter(None, [self.reason, *faults])) or None

    @property
    def title(self) -> str:
        """Source and style as a title."""
        return f"{self.part('source')} in the style of {self.part('style')}"

    def part(self, kind: str) -> str:
        """The name of the ``source`` or ``style``, from the record or, if the run never started,
        from its overrides."""
        path, name = self.config.get(f"{kind}.path"), self.config.get(f"{kind}.name")
        if path and isinstance(path, str):
            return PurePath(path).stem
        return str(name or self._asked_part(kind) or f"unknown {kind}")

    def _asked_part(self, kind: str) -> str | None:
        asked = dict(each.lstrip("+").split("=", 1) for each in self.overrides if "=" in each)
        if f"{kind}.path" in asked:
            return PurePath(asked[f"{kind}.path"]).stem
        source, _, style = asked.get("pair", "").partition("_")  # as conf/pair names them
        return asked.get(kind) or {"source": source, "style": style}[kind] or None

    @property
    def command(self) -> str:
        """The command that repeats the run."""
        return shlex.join(["styleexp", *self.overrides])

    @cached_property
    def _metrics(self) -> tuple[dict[str, Any], list[str]]:
        faults: list[str] = []
        return (_load(self.folder / "metrics.json", faults) if self.has_numbers else {}), faults

    @cached_property
    def _lines(self) -> tuple[list[dict[str, float]], int]:
        return _steps(self.folder / "metrics.jsonl") if self.has_numbers else ([], 0)


def read(folder: Path) -> Run:
    """Read a run's folder as far as possible. Never raises: what can't be read is left out, and
    `Run.problems` says so."""
    return _read(folder, None)


def of_job(job: Job) -> Run:
    """Read the run of a job, if its folder holds it.

    If the folder holds another run, whose numbers are not this job's, the status is ``other``. An
    ended run without a record, which can't be told from another, is ``unreadable``. Never raises.
    """
    run = _read(job.folder, job.overrides)
    if run.status == "newer":
        return run
    if not run.record:
        run = replace(run, seconds=None, has_numbers=False)
        if run.status != "done":
            return run
        reason = run.reason or (None if run.faults else "it has no run.json")
        return replace(run, status="unreadable", reason=reason)
    if reason := identity.not_of(job.key, job.overrides, run.record):
        return Run(
            job.folder,
            "other",
            reason,
            overrides=list(job.overrides),
            last_status=run.last_status,
            has_numbers=False,
        )
    return run


def readable(folder: Path, purpose: str) -> Run:
    """Like `read`, but raises `UserError` for a run of a later version of styleexp."""
    run = read(folder)
    if run.status == "newer":
        raise UserError(f"cannot {purpose} '{folder}': {run.reason}")
    return run


def recorded(folder: Path, purpose: str) -> Run:
    """Like `readable`, but also raises `UserError` if there is no record that can be used."""
    run, path = readable(folder, purpose), folder / "run.json"
    if not path.is_file():
        raise UserError(
            f"cannot {purpose} '{folder}': it has no run.json, so it is not a run's folder."
        )
    if not run.record:
        faults = [each for each in run.faults if each.startswith(path.name)]
        fault = faults[0].removesuffix(".") if faults else f"{path.name} is empty"
        raise UserError(f"cannot {purpose} '{folder}': {fault}: start the run again.")
    return run


def final_loss(steps: Sequence[Mapping[str, float]]) -> float | None:
    """The loss that a run is compared by: the mean over the last tenth of its steps (rounded down,
    but at least one step), because the loss of a single step depends on its random views.

    A step counts if its loss can be read, so a line cut off when the run was killed counts neither
    as a step nor in the mean. None without any step, as in methods that don't optimise.
    """
    losses = [step["loss"] for step in steps if "loss" in step]
    last = losses[-max(1, len(losses) // LAST_SHARE) :]
    return sum(last) / len(last) if last else None


def _read(folder: Path, asked: Sequence[str] | None) -> Run:
    """Read a folder; ``asked`` are the job's overrides, used if the run recorded none."""
    faults: list[str] = []
    written = _load(folder / "status.json", faults)
    record: dict[str, Any] = {}
    try:
        record, damaged = untrusted.load_record(folder / "run.json")
        faults += damaged
    except untrusted.Unreadable as error:
        faults.append(f"run.json cannot be read ({error}).")
    overrides = record.get("overrides")
    if overrides is None:
        overrides = asked
    if overrides is None:  # stopped before it had a record
        overrides = untrusted.load_overrides(folder / ".hydra" / "overrides.yaml")
    if newer := too_new(record) or too_new(written):
        return Run(folder, "newer", newer, overrides=list(asked or ()), has_numbers=False)
    status = last_status = written.get("status")
    if not isinstance(status, str):
        last_status = None
        status = "unreadable" if faults or written else "missing"
    if status == "running" and not locks.held(folder):
        status = "died"
    reason = written.get("reason")
    return Run(
        folder,
        status,
        str(reason) if reason else None,
        untrusted.number(written.get("seconds")),
        record,
        list(overrides),
        tuple(faults),
        last_status,
    )


def _load(path: Path, faults: list[str]) -> dict[str, Any]:
    """Load a JSON object; empty, with a sentence in ``faults``, if it is damaged."""
    try:
        return untrusted.load(path)
    except untrusted.Unreadable as error:
        faults.append(f"{path.name} cannot be read ({error}).")
        return {}


def _steps(path: Path) -> tuple[list[dict[str, float]], int]:
    """The numbers of each line, and the number of damaged lines."""
    steps: list[dict[str, float]] = []
    damaged = 0
    try:
        if not path.is_file():  # a pipe would block
            return [], 0
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return [], 0
    for line in lines:
        try:
            values = json.loads(line).items()
            step = {key: n for key, value in values if (n := untrusted.number(value)) is not None}
            step["step"] = int(step["step"])
            steps.append(step)
        except (ValueError, KeyError, AttributeError, OverflowError, RecursionError):
            damaged += 1
    return steps, damaged
