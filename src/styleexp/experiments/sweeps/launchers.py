"""Hydra's launchers: number of parallel jobs, and threads per job."""

from __future__ import annotations

import math
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from styleexp.config.overrides import quote
from styleexp.system import gpus
from styleexp.system.errors import UserError, unknown_name


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
PACKED = ("joblib", "submitit_local", "submitit_slurm")
"""Launchers whose tasks may have several jobs each: they start processes, which takes seconds."""
EARLY = 60
"""Seconds by which SLURM may send a task's signal too early (``sbatch --signal``)."""
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


@contextmanager
def composed(folder: Path, launcher: Sequence[str]) -> Iterator[tuple[Any, Any]]:
    """Hydra's loader and its configuration with these overrides, for jobs below ``folder``. Hydra
    is initialised within the context.

    Raises `UserError` for an unknown key of Hydra's, and Hydra's exceptions.
    """
    import hydra
    from hydra.core.global_hydra import GlobalHydra
    from hydra.types import RunMode

    from styleexp.config import compose

    compose.register()
    with hydra.initialize_config_module("styleexp.conf", version_base="1.3"):
        composer: Any = GlobalHydra.instance().hydra

        def composed(overrides: Sequence[str]) -> Any:
            given = [f"hydra.sweep.dir={quote(str(folder))}", *overrides]
            return composer.compose_config(
                "config", given, run_mode=RunMode.MULTIRUN, from_shell=False
            )

        own = [each for each in launcher if each.lstrip("+~").startswith("hydra.")]
        if own:
            plain = composed([each for each in launcher if each.startswith("launcher=")])
            for each in own:
                _check_key(plain.hydra, re.split("[=@]", each.lstrip("+~"))[0], launcher)
        yield composer.config_loader, composed(launcher)


def _check_key(hydra: Any, key: str, launcher: Sequence[str]) -> None:
    """Raise `UserError` for a key that this configuration of Hydra's doesn't have, with the nearest
    that it has. Mappings without a schema may be added to."""
    from omegaconf import OmegaConf

    node, above = hydra, "hydra"
    for name in key.split(".")[1:]:
        if not OmegaConf.is_dict(node):
            return  # Hydra says what is wrong
        known = [str(each) for each in node if not str(each).startswith("_")]
        if name not in known:
            if OmegaConf.get_type(node) is dict:
                return  # a + adds it; Hydra says so where it is missing
            if not known:
                chosen = [each.partition("=")[2] for each in launcher if "launcher=" in each]
                raise UserError(
                    f"the launcher '{chosen[0]}' has no keys, but '{key}' was given: choose "
                    "another with --launcher."
                )
            raise unknown_name(f"key of {above},", name, known)
        node, above = node[name], f"{above}.{name}"


def check_per_task(hydra: Any, per_task: int) -> None:
    """Raise `UserError` if the launcher's tasks can't have that many jobs."""
    if per_task < 1:
        raise UserError(f"--per-task {per_task} is not possible: give a number from 1.")
    if per_task > 1 and name_of(hydra) not in PACKED:
        raise UserError(
            f"--per-task {per_task} is not possible with the launcher '{name_of(hydra)}': use "
            f"--launcher {', '.join(PACKED[:-1])} or {PACKED[-1]}."
        )


def described(hydra: Any, tasks: int) -> list[str]:
    """Lines for the terminal: how the launcher starts that many tasks. For SLURM, the batch file.

    Raises `UserError` if SLURM's commands are missing here.
    """
    kind = name_of(hydra)
    if kind == "submitit_slurm":
        size = min(tasks, batch_size(hydra) or tasks)
        return ["the batch file for SLURM:", *(f"  {line}" for line in _batch_file(hydra, size))]
    if kind == "submitit_local":
        return [f"each task in a process of its own, for at most {hydra.launcher.timeout_min} min"]
    return []


def check(hydra: Any) -> None:
    """Raise `UserError` if the launcher can't work here: SLURM's commands are missing, or tasks get
    too little time."""
    if name_of(hydra) != "submitit_slurm":
        return
    missing = [name for name in ("sbatch", "srun") if shutil.which(name) is None]
    if missing:
        raise UserError(
            f"there is no {' and no '.join(missing)} on this machine: run this on a login node of "
            "the cluster, or use --launcher submitit_local."
        )
    minutes, delay = float(hydra.launcher.timeout_min), float(hydra.launcher.signal_delay_s)
    if 60 * minutes < delay + 2 * EARLY:
        raise UserError(
            f"hydra.launcher.timeout_min={minutes:g} leaves tasks no time to work: SLURM warns "
            f"them signal_delay_s={delay:g} s before its end and up to {EARLY} s earlier; give at "
            f"least {math.ceil((delay + 2 * EARLY) / 60)}, better an hour."
        )


def notes(hydra: Any, tasks: int, per_task: int) -> list[str]:
    """Sentences on what doesn't work as one might expect with the launcher here, for that many
    tasks of ``per_task`` jobs."""
    if name_of(hydra) != "submitit_slurm" or shutil.which("sbatch") is None:
        return []
    found = []
    most = batch_size(hydra)
    if most is not None and tasks > most:
        found.append(
            f"SLURM takes at most {most} tasks in an array here (MaxArraySize), so there are "
            f"{math.ceil(tasks / most)} arrays, each after the other has ended: for a single one, "
            f"give --per-task {math.ceil(tasks * per_task / most)}."
        )
    if _answer("sacct", "--noheader", "--jobs=1") is None:
        found.append(
            "SLURM's accounting (sacct) doesn't answer here, so a task that is killed is not "
            "noticed: if nothing runs any more, end this command and repeat it."
        )
    return found


def _answer(*command: str) -> str | None:
    """What a command of SLURM's prints; None if it is missing, fails, or doesn't answer."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=20)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout if done.returncode == 0 else None


def _batch_file(hydra: Any, tasks: int) -> list[str]:
    """The batch file that Submitit writes for an array of tasks, as lines."""
    from omegaconf import OmegaConf
    from submitit.slurm import slurm

    asked: Any = OmegaConf.to_container(hydra.launcher, resolve=True)
    folder = asked.pop("submitit_folder")
    for name in ("_target_", "max_num_timeout"):
        asked.pop(name)
    names = slurm.SlurmExecutor._equivalence_dict()
    converted: dict[str, Any] = {
        str(names.get(key, key)): value for key, value in asked.items() if value is not None
    }
    if "mem" in converted:
        converted["mem"] = slurm._convert_mem(converted["mem"])
    command = f"{shlex.quote(sys.executable)} -u -m submitit.core._submit {shlex.quote(folder)}"
    count = tasks if tasks > 1 else None  # Submitit submits a single task without an array
    text = slurm._make_sbatch_string(command, folder, map_count=count, **converted)
    return [line for line in text.splitlines() if line and line != "# Parameters"]


def batch_size(hydra: Any) -> int | None:
    """Maximum number of tasks per batch for the launcher; None for no limit. SLURM's limits the
    tasks of an array."""
    kind = name_of(hydra)
    if kind == "submitit_slurm":
        found = re.search(
            r"^MaxArraySize\s*=\s*(\d+)", _answer("scontrol", "show", "config") or "", re.M
        )
        return max(1, int(found[1])) if found else None
    if kind == "submitit_local":
        return side_by_side(hydra)
    return MANY if kind in ("basic", "joblib") else None


def side_by_side(hydra: Any) -> int:
    """Number of parallel jobs on one machine, from Hydra's configuration (``hydra.launcher``)."""
    kind = name_of(hydra)
    if kind == "joblib":
        jobs = int(hydra.launcher.n_jobs)
        return jobs if jobs > 0 else max(1, cores() + 1 + jobs)  # joblib: -1 is all cores
    if kind == "submitit_local":
        return int(hydra.sweeper.get("max_batch_size") or 1)
    return 1


def at_once(hydra: Any) -> int | None:
    """Maximum number of jobs that run at the same time; None if the launcher doesn't limit it."""
    kind = name_of(hydra)
    if kind == "submitit_slurm":
        return int(hydra.launcher.array_parallelism)
    if kind == "ray":
        count = hydra.launcher.ray.init.get("num_cpus")
        return None if count is None else int(count)
    return side_by_side(hydra)


def threads_each(hydra: Any) -> int:
    """Threads per job, so that parallel jobs don't compete for cores; 0: all cores."""
    kind = name_of(hydra)
    if kind == "submitit_slurm":
        return int(hydra.launcher.cpus_per_task or 0)
    if kind == "ray":
        return int(hydra.launcher.ray.remote.get("num_cpus") or 0)
    jobs = side_by_side(hydra)
    return max(1, cores() // jobs) if jobs > 1 else 0


def place(hydra: Any, device: str) -> None:
    """Give a job's process a GPU of its own (`gpus.take_one`), unless ``device`` names one or is
    the CPU, or jobs run one after the other in this process."""
    if name_of(hydra) != "basic" and device in ("auto", "cuda"):
        gpus.take_one()


def name_of(hydra: Any) -> str:
    """The launcher's name, from Hydra's configuration."""
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
