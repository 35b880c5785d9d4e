"""What is left of a plan costs: core-hours and disk, from its own finished jobs or its estimates.

A job's core-seconds are its wall time times its threads, both from its record. Jobs of an
experiment without any finished one count by the plan's ``minutes``, which are on two cores; without
these, and the disk without a finished job, the cost is unknown, and said to be.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING

from styleexp.runs import reading

if TYPE_CHECKING:
    from styleexp.experiments.sweeps.plan import Plan, Planned

ESTIMATED_ON = 2
"""Cores of the machine that a plan's ``minutes`` are meant for."""
MOST = 20
"""Finished jobs of an experiment that are measured; the folders of all would take long to read."""


@dataclass(frozen=True)
class Cost:
    """Cost of one experiment's unfinished jobs."""

    jobs: int
    left: int
    hours: float | None = None
    """Core-hours of the jobs left; None if unknown."""
    size: float | None = None
    """Bytes of the jobs left; None if unknown."""
    measured: int = 0
    """Number of finished jobs that ``hours`` was measured on; 0: estimated by the plan."""

    def words(self) -> str:
        """The cost as text."""
        if not self.left:
            return f"{_jobs(self.jobs)}, all done"
        done = f", {self.jobs - self.left} done" if self.left < self.jobs else ""
        return f"{_jobs(self.jobs)}{done}; left: {amounts(self.hours, self.size)}{self._origin()}"

    def _origin(self) -> str:
        if self.hours is None:
            return " (no job done to measure; the plan has no minutes for this profile)"
        return f" (measured on {_jobs(self.measured)})" if self.measured else " (plan's estimate)"


def of_plan(plan: Plan, by_entry: Mapping[str, Sequence[Planned]], profile: str) -> dict[str, Cost]:
    """The cost of each experiment, keyed by its name. A job of several counts in the first."""
    found, seen = {}, set()
    for entry in plan.experiments:
        assert entry.name is not None
        jobs = [job for job in by_entry[entry.name] if job.name not in seen]
        seen |= {job.name for job in jobs}
        found[entry.name] = _of_jobs(jobs, len(by_entry[entry.name]), entry.minutes.get(profile))
    return found


def _of_jobs(jobs: Sequence[Planned], estimated: int, minutes: float | None) -> Cost:
    """``minutes`` are the estimate for ``estimated`` jobs."""
    runs = [reading.of_job(job) for job in jobs]
    left = sum(run.status != "done" for run in runs)
    done = [run for run in runs if run.status == "done" and run.seconds is not None][:MOST]
    threads = [run.record.get("threads") for run in done]
    seconds = [
        run.seconds * count
        for run, count in zip(done, threads, strict=True)
        if isinstance(count, int) and run.seconds is not None
    ]
    size = left * fmean(folder_size(run.folder) for run in done) if done else None
    if seconds:
        return Cost(len(jobs), left, left * fmean(seconds) / 3600, size, len(seconds))
    if minutes is not None:
        return Cost(len(jobs), left, ESTIMATED_ON * minutes / 60 * left / max(estimated, 1), size)
    return Cost(len(jobs), left, None, size)


def total(costs: Mapping[str, Cost]) -> str:
    """All experiments' cost as text; what is unknown is told."""
    left = [cost for cost in costs.values() if cost.left]
    hours = [cost.hours for cost in left if cost.hours is not None]
    sizes = [cost.size for cost in left if cost.size is not None]
    unknown = sum(cost.left for cost in left if cost.hours is None)
    unsized = sum(cost.left for cost in left if cost.size is None)
    told = amounts(sum(hours) if hours else None, sum(sizes) if sizes else None)
    if hours and unknown:
        told += f", and {_jobs(unknown)} of unknown time"
    if sizes and unsized:
        told += f" (disk without {_jobs(unsized)} of unknown size)"
    return told if sizes or not left else f"{told}; disk space unknown until a job is done"


def amounts(hours: float | None, size: float | None) -> str:
    """Core-hours and bytes as text."""
    if hours is None:
        time = "unknown time"
    elif hours < 1:
        minutes = f"{60 * hours:.2g}"
        time = f"about {minutes} core-minute{'' if minutes == '1' else 's'}"
    else:
        time = f"about {hours:.3g} core-hours"
    if size is None:
        return time
    unit, name = (1e9, "GB") if size >= 1e9 else (1e6, "MB")
    return f"{time}, {size / unit:.2g} {name}"


def folder_size(folder: Path) -> int:
    """Bytes of all files in a folder."""
    return sum(
        os.lstat(os.path.join(at, name)).st_size
        for at, _, files in os.walk(folder)
        for name in files
    )


def _jobs(count: int) -> str:
    return f"{count} job{'' if count == 1 else 's'}"
