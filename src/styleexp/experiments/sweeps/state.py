"""The state of a plan's jobs, for people: counts, time left, reasons of failures. Cancelling."""

from __future__ import annotations

import os
import platform
import shutil
import signal
import subprocess
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from styleexp.experiments.sweeps import manifest
from styleexp.experiments.sweeps.runner import CANCELLED
from styleexp.runs import reading
from styleexp.runs.jobs import Job
from styleexp.runs.reading import Run
from styleexp.system.errors import UserError

MOST = 100
"""Jobs listed one by one; of more, only those that aren't waiting or done."""
UNLISTED = ("waiting", "done", "outdated")


@dataclass(frozen=True)
class State:
    """The jobs of a plan's folder, in the manifest's order."""

    folder: Path
    jobs: dict[str, tuple[str, Run, dict[str, Any]]]
    """State, run and the manifest's entry of each job, by its name."""

    @property
    def counts(self) -> Counter[str]:
        """Number of jobs in each state."""
        return Counter(state for state, _, _ in self.jobs.values())

    @property
    def left(self) -> int:
        """Number of jobs that have not ended."""
        ended = ("outdated", *manifest.ENDED)
        return sum(count for state, count in self.counts.items() if state not in ended)

    def summary(self) -> list[str]:
        """Counts, the time left, and each reason of a failure with the number of its jobs.

        The time left is the mean time of a finished job by the jobs left, divided by the number
        that run now.
        """
        lines = [", ".join(f"{count} {state}" for state, count in self.counts.items())]
        took = [run.seconds for state, run, _ in self.jobs.values()
                if state == "done" and run.seconds is not None]  # fmt: skip
        running = self.counts["running"]
        if self.left and not running:
            lines.append("nothing runs now")
        elif self.left and took:
            lines.append(f"about {_duration(fmean(took) * self.left / running)} left")
        reasons: dict[str, list[str]] = {}
        for name, (state, run, _) in self.jobs.items():
            if run.remark and state != "outdated":
                reasons.setdefault(f"{state}: {run.remark}", []).append(name)
        for reason, names in sorted(reasons.items(), key=lambda item: -len(item[1])):
            more = f" and {len(names) - 1} more" if len(names) > 1 else ""
            lines.append(f"{names[0]}{more}: {reason}")
        return lines

    def lines(self) -> list[str]:
        """A table of the jobs, and the summary."""
        from rich.console import Console
        from rich.table import Table

        table = Table(title=str(self.folder))
        for column in ("job", "state", "step", "attempts", "time"):
            table.add_column(column, overflow="fold")
        for name, (state, run, known) in self.jobs.items():
            if len(self.jobs) > MOST and state in UNLISTED:
                continue
            taken, total = len(run.steps), run.config.get("optim.steps")
            table.add_row(
                name,
                state,
                f"{taken}/{total}" if taken and total else "",
                str(known.get("attempts", 0)),
                f"{run.seconds:.0f} s" if run.seconds is not None else "",
            )
        console = Console()
        if not console.is_terminal:
            console = Console(width=140)
        with console.capture() as captured:
            if table.row_count:
                console.print(table)
        return [*captured.get().splitlines(), *self.summary()]


def of_folder(folder: Path) -> State:
    """The state of a plan's folder. Raises `UserError` if it isn't one."""
    known = manifest.read(folder)
    if not known:
        raise UserError(f"'{folder}' is not a plan's folder: it has no {manifest.NAME}.")
    found = {}
    for name, entry in known.items():
        job = Job(name, tuple(entry.get("overrides", ())), folder / name, entry.get("key"))
        run = reading.of_job(job)
        state = "outdated" if entry["state"] == "outdated" else run.status
        found[name] = ("waiting" if state == "missing" else state, run, entry)
    return State(folder, found)


def cancel(folder: Path) -> Iterator[str]:
    """Stop a plan: no job starts any more, SLURM's tasks are cancelled, and running jobs of this
    machine are stopped as by Ctrl-C, with a checkpoint. Yields what was done, as text.

    The plan's runner ends by itself; starting it again continues.
    """
    found = of_folder(folder)
    (folder / CANCELLED).touch()
    if arrays := _arrays(folder):
        # Submitit ignores SIGTERM, scancel's own signal; a run ends by SIGINT with a checkpoint.
        for how in ("--state=PENDING", "--signal=INT"):
            subprocess.run(["scancel", how, *arrays], capture_output=True, check=False)
        yield f"asked SLURM to stop: {', '.join(arrays)}"
    for name, (state, _, known) in found.jobs.items():
        if state != "running" or arrays:
            continue
        where = known.get("host", "?")
        if where == platform.node() and isinstance(known.get("process"), int):
            try:
                os.kill(known["process"], signal.SIGINT)
                yield f"{name}: stopped"
            except OSError as error:
                yield f"{name}: can't be stopped ({error})"
        else:
            yield f"{name}: runs on {where} until it ends: cancel it there"
    yield f"no other job of '{folder}' starts until the plan is started again."


def _arrays(folder: Path) -> list[str]:
    """SLURM's ids of the plan's arrays that are still in the queue."""
    ids = {path.name.split("_")[0] for path in (folder / ".submitit").glob("[0-9]*")}
    if not ids or shutil.which("squeue") is None:
        return []
    asked = ["squeue", "--noheader", "--format=%F", "--me"]
    queued = subprocess.run(asked, capture_output=True, text=True, check=False).stdout.split()
    return sorted(ids & set(queued))


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} hours"
