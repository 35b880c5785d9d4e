"""Hydra's launchers: how many jobs run side by side, and how many threads each gets."""

from __future__ import annotations

import os
from typing import Any


def cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def side_by_side(hydra: Any) -> int:
    """Jobs that run at once on one machine, by Hydra's configuration (``hydra.launcher``)."""
    kind = _kind(hydra)
    if kind == "joblib":
        jobs = int(hydra.launcher.n_jobs)
        return jobs if jobs > 0 else max(1, cores() + 1 + jobs)  # joblib: -1 is all cores
    if kind == "submitit_local":
        return int(hydra.sweeper.get("max_batch_size") or 1)
    return 1


def threads_each(hydra: Any) -> int:
    """Threads for each job, so that jobs side by side don't fight for cores; 0 takes all cores."""
    kind = _kind(hydra)
    if kind == "submitit_slurm":
        return int(hydra.launcher.cpus_per_task or 0)
    if kind == "ray":
        return int(hydra.launcher.ray.remote.get("num_cpus") or 0)
    jobs = side_by_side(hydra)
    return max(1, cores() // jobs) if jobs > 1 else 0


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
