"""Hydra's launchers: number of parallel jobs, and threads per job."""

from __future__ import annotations

import os
from typing import Any

from styleexp.system import gpus
from styleexp.system.errors import UserError


def cores() -> int:
    """Number of cores available to this process."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


JOBS = {
    "joblib": "hydra.launcher.n_jobs",
    "submitit_local": "hydra.sweeper.max_batch_size",
    "submitit_slurm": "hydra.launcher.array_parallelism",
    "ray": "hydra.launcher.ray.init.num_cpus",
}
"""Each launcher's key for the number of parallel jobs."""
MANY = 100
"""Jobs per batch for launchers that keep every return value, 0.2 MB with its configuration."""


def overrides(name: str, jobs: int | None = None) -> list[str]:
    """Overrides that choose a launcher and its number of parallel jobs."""
    if jobs is None:
        return [f"launcher={name}"]
    if name not in JOBS or jobs < 1:
        raise UserError(
            f"--jobs {jobs} is not possible with the launcher '{name}': use --launcher joblib and "
            "a number from 1."
        )
    return [f"launcher={name}", f"{JOBS[name]}={jobs}"]


def batch_size(hydra: Any) -> int | None:
    """Maximum number of jobs per batch for the launcher; None for no limit."""
    kind = _kind(hydra)
    if kind == "submitit_local":
        return side_by_side(hydra)
    return MANY if kind in ("basic", "joblib") else None


def side_by_side(hydra: Any) -> int:
    """Number of parallel jobs on one machine, from Hydra's configuration (``hydra.launcher``)."""
    kind = _kind(hydra)
    if kind == "joblib":
        jobs = int(hydra.launcher.n_jobs)
        return jobs if jobs > 0 else max(1, cores() + 1 + jobs)  # joblib: -1 is all cores
    if kind == "submitit_local":
        return int(hydra.sweeper.get("max_batch_size") or 1)
    return 1


def threads_each(hydra: Any) -> int:
    """Threads per job, so that parallel jobs don't compete for cores; 0: all cores."""
    kind = _kind(hydra)
    if kind == "submitit_slurm":
        return int(hydra.launcher.cpus_per_task or 0)
    if kind == "ray":
        return int(hydra.launcher.ray.remote.get("num_cpus") or 0)
    jobs = side_by_side(hydra)
    return max(1, cores() // jobs) if jobs > 1 else 0


def place(hydra: Any, device: str) -> None:
    """Give a job's process a GPU of its own (`gpus.take_one`), unless ``device`` names one or is
    the CPU, or jobs run one after the other in this process."""
    if _kind(hydra) != "basic" and device in ("auto", "cuda"):
        gpus.take_one()


def _kind(hydra: Any) -> str:
    target = str(hydra.launcher._target_)
    for word, kind in (
        ("LocalLauncher", "submitit_local"),
        ("SlurmLauncher", "submitit_slurm"),
        ("joblib", "joblib"),
        ("Ray", "ray"),
    ):
        if word in target:
            return kind
    return "basic"
