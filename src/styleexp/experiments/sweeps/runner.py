"""Run a plan: launch unfinished jobs through a Hydra launcher until none is left.

A job is claimed by the lock of its own folder, which its process holds until it ends. So any number
of runners can work on one plan, on one machine or on several that share its folder. If a runner or
worker is killed, its job is resumed from its checkpoint.
"""

from __future__ import annotations

import multiprocessing
import os
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from styleexp.config.overrides import quote
from styleexp.experiments.sweeps import launchers, manifest
from styleexp.runs import identity, reading, records
from styleexp.runs.jobs import Job
from styleexp.system import locks
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from styleexp.config.schema import Config
    from styleexp.experiments.sweeps.plan import Planned

LOG = "log.txt"
"""File in a job's folder with its output."""
CANCELLED = "cancelled"
"""File in a plan's folder after which no job is started, until the plan is."""
MOST_DEATHS = 3
"""Number of times a job's process may die while running alone before the job counts as failed."""
AT_WORK = threading.Lock()
"""Held by this process while it runs a job."""
NAMES, THREADS = "STYLEEXP_JOBS", "STYLEEXP_THREADS"
"""Keys of ``hydra.job.env_set`` that tell a task its jobs' names and their number of threads."""
SEPARATOR = ":"
"""Between names; a job's name has none."""
POLL = 1.0
"""Seconds between polls of jobs that other runners execute."""


def run(jobs: Sequence[Planned], folder: Path, launcher: Sequence[str], per_task: int = 1) -> None:
    """Run all jobs that are neither done nor failed, and wait for those of other runners.

    ``launcher`` are overrides of Hydra's own configuration, including ``launcher=...``; each of its
    tasks runs up to ``per_task`` jobs, one after the other in one process. Raises `UserError` if
    the launcher itself fails before any job started.
    """
    (folder / CANCELLED).unlink(missing_ok=True)
    deaths: Counter[str] = Counter()
    suspects: set[str] = set()
    while True:
        if (folder / CANCELLED).exists():
            raise UserError("cancelled by styleexp-sweep cancel; repeat the command to continue.")
        if not (folder / manifest.NAME).exists():  # the folder was removed meanwhile
            manifest.write(folder, jobs)
        states = {}
        for job in jobs:
            run = reading.of_job(job)
            manifest.refuse_others(job, run)
            states[job.name] = run.status
            if states[job.name] not in manifest.ENDED and deaths[job.name] >= MOST_DEATHS:
                _give_up(job, folder)
                states[job.name] = "failed"
        waiting = [job for job in jobs if states[job.name] not in (*manifest.ENDED, "running")]
        if not waiting:
            if "running" not in states.values():
                return
            time.sleep(POLL)
            continue
        # A dying worker may kill the others: retry dead jobs one at a time.
        batch = [job for job in waiting if job.name not in suspects] or waiting[:1]
        before = _progress(folder, batch)
        error = _launch(batch, folder, launcher, per_task)
        after = {job.name: reading.of_job(job).status for job in batch}
        died = [name for name, state in after.items() if state == "died"]
        if error is not None and not set(after.values()) & set(manifest.ENDED):
            # No progress: some job can't even write a status, for example for lack of space.
            died = [name for name, state in after.items() if state != "running"]
        if len(batch) == 1:
            deaths.update(died)
        suspects.update(died)
        if error is None:
            continue
        if _progress(folder, batch) == before and not (folder / CANCELLED).exists():
            raise UserError(
                f"the launcher failed before any job started ({records.first_line(error)}): see "
                f"{folder} or try --launcher basic."
            ) from error
        print(f"styleexp-sweep: a worker failed ({records.first_line(error)}); continuing.")


def retry(jobs: Sequence[Planned]) -> None:
    """Mark failed jobs to run again, from their checkpoints if they have one."""
    for job in jobs:
        if reading.of_job(job).status != "failed":
            continue
        with suppress(locks.Busy), locks.hold(job.folder):
            again = "failed, to be retried"
            records.RunFolder(job.folder).write_status("interrupted", reason=again)


def _give_up(job: Planned, folder: Path) -> None:
    reason = f"its process died {MOST_DEATHS} times without finishing: see {LOG}"
    with suppress(OSError), locks.hold(job.folder, manifest.PATIENCE):
        records.RunFolder(job.folder).write_status("failed", reason=reason)
    manifest.update(folder, job.name, "failed")
    print(f"{job.name}: failed: {reason}")


def _progress(folder: Path, jobs: Sequence[Planned]) -> list[Any]:
    known = manifest.read(folder)
    return [known.get(job.name, {}).get("attempts") for job in jobs]


def _launch(
    jobs: Sequence[Planned], folder: Path, launcher: Sequence[str], per_task: int
) -> Exception | None:
    """Run the jobs with Hydra's launcher; return the exception that it raised or that killed a
    job."""
    from hydra._internal.callbacks import Callbacks
    from hydra.core.plugins import Plugins
    from hydra.core.utils import JobStatus
    from hydra.types import HydraContext

    with launchers.composed(folder, launcher) as (loader, config):
        started = Plugins.instance().instantiate_launcher(
            hydra_context=HydraContext(loader, Callbacks()),
            task_function=task if per_task == 1 else pack,
            config=config,
        )
        threads = launchers.threads_each(config.hydra)
        # Hydra composes every task with the launcher's own overrides, which need the launcher.
        chosen = [each for each in launcher if each.startswith("launcher=")]
        tasks = [jobs[at : at + per_task] for at in range(0, len(jobs), per_task)]
        if per_task == 1:
            given = [[*_overrides(job, threads), *chosen, _subfolder(job)] for job in jobs]
        else:
            given = [[*chosen, *_packed(each, threads)] for each in tasks]
        size = launchers.batch_size(config.hydra) or len(tasks)
        for at in range(0, len(tasks), size):
            try:
                returned = started.launch(given[at : at + size], initial_job_idx=at)
            except Exception as error:
                _settle([job for each in tasks[at : at + size] for job in each])
                return error
            for each in returned:
                if each.status == JobStatus.FAILED:
                    return each._return_value
    return None


def _overrides(job: Job, threads: int) -> list[str]:
    """The job's overrides, with its number of threads unless it has one."""
    given = any(each.startswith("threads=") for each in job.overrides)
    return [*job.overrides, *([] if given else [f"threads={threads}"])]


def _subfolder(job: Job) -> str:
    return f"hydra.sweep.subdir={quote(job.name)}"


def _packed(jobs: Sequence[Job], threads: int) -> list[str]:
    """Overrides of a task for `pack`. Its jobs' own are in the manifest."""
    names = {NAMES: SEPARATOR.join(job.name for job in jobs), THREADS: str(threads)}
    passed = [f"+hydra.job.env_set.{key}={quote(value)}" for key, value in names.items()]
    # Hydra's folder of the task is that of its first job, without Hydra's files about the task.
    return [*passed, _subfolder(jobs[0]), "hydra.output_subdir=null"]


def _settle(jobs: Sequence[Planned]) -> None:
    """Wait for jobs that are still running after another one was killed."""
    while any(reading.of_job(job).status == "running" for job in jobs):
        time.sleep(POLL)


def task(config: DictConfig) -> None:
    """Job function for the launcher, possibly called in another process: one job."""
    from hydra.core.hydra_config import HydraConfig
    from omegaconf import OmegaConf

    from styleexp.config import compose

    runtime = HydraConfig.get()
    root, folder = Path(runtime.sweep.dir), Path(runtime.runtime.output_dir)
    name = str(runtime.sweep.subdir)
    # Keep Hydra's grammar: resolving would lose an escaped "${" in a file's name.
    given: Any = OmegaConf.to_container(runtime.overrides.task, resolve=False)
    compose.register()
    # No key: the manifest was removed; the runner rewrites it.
    key = manifest.read(root).get(name, {}).get("key")
    _attempt(Job(name, tuple(given), folder, key), root, lambda: compose.typed(config))


def pack(config: DictConfig) -> None:
    """Job function for the launcher, possibly called in another process: several jobs.

    Their overrides are those of the manifest; a job that it no longer has isn't run. What a job
    raises is in its record, and the next one runs.
    """
    import copy

    from hydra.core.hydra_config import HydraConfig

    from styleexp.config import compose, many

    runtime = HydraConfig.get()
    root, passed = Path(runtime.sweep.dir), runtime.job.env_set
    compose.register()
    composer = many.Composer()  # the launcher has brought the runner's Hydra along
    for name in passed[NAMES].split(SEPARATOR):
        known = manifest.read(root).get(name)
        if known is None:
            continue
        given = _overrides(Job(name, tuple(known["overrides"]), root / name), int(passed[THREADS]))

        def composed(given: list[str] = given) -> Config:
            return copy.deepcopy(composer.compose([*given, "hydra.mode=RUN"]))

        _attempt(Job(name, tuple(given), root / name, known["key"]), root, composed)


def _attempt(job: Job, root: Path, composed: Callable[[], Config]) -> None:
    """Run a job, unless another runner executes it or it has ended meanwhile. Never raises if the
    job fails."""
    from contextlib import chdir

    from hydra.core.hydra_config import HydraConfig

    end_with_runner()
    try:
        with AT_WORK, locks.hold(job.folder), chdir(HydraConfig.get().runtime.cwd):
            if (root / CANCELLED).exists():
                return
            state = reading.of_job(job).status if job.key else reading.read(job.folder).last_status
            if state not in (*manifest.ENDED, "other"):  # the runner rejects another run's folder
                _work(composed, root, job)
    except locks.Busy:
        return


@cache
def end_with_runner() -> None:
    """Exit a joblib worker after its job if the process that started it, a plan's or a sweep's, was
    killed; it would wait forever."""
    if not multiprocessing.current_process().name.startswith("Loky"):
        return
    runner = os.getppid()

    def watch() -> None:
        while os.getppid() == runner:
            time.sleep(POLL)
        with AT_WORK:
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _work(composed: Callable[[], Config], root: Path, job: Job) -> None:
    """Run a job whose lock is held, with its output redirected to its log."""
    from hydra.core.hydra_config import HydraConfig

    from styleexp.experiments.execute import begin

    name, folder = job.name, job.folder
    begun = time.perf_counter()
    manifest.update(root, name, "running")
    code = 0
    with (
        open(folder / LOG, "a", buffering=1, encoding="utf-8") as log,
        redirect_stdout(log),
        redirect_stderr(log),
    ):
        try:
            asked = [each for each in job.overrides if not each.startswith("launcher=")]
            typed = composed()
            if job.key not in (None, identity.job_key(typed)):
                raise UserError(
                    "its source or style file, or the code of a plugin, has changed since the plan "
                    "was read: start the plan again."
                )
            launchers.place(HydraConfig.get(), typed.device)
            code = begin(typed, folder, [*asked, "hydra.mode=RUN"])
        except UserError as error:
            _failed(folder, str(error))
            print(f"styleexp: {error}")
        except Exception as error:
            _failed(folder, records.first_line(error))
            traceback.print_exc()
    state = str(reading.read(folder).last_status)
    listed = manifest.update(root, name, state)
    done = sum(job["state"] == "done" for job in listed.values())
    current = sum(job["state"] != "outdated" for job in listed.values())
    took = time.perf_counter() - begun
    print(f"{name}: {state} in {took:.0f} s ({done} of {current} done)", flush=True)
    if code == 130:
        raise KeyboardInterrupt


def _failed(folder: Path, reason: str) -> None:
    """Write a status if the run failed before it could."""
    if reading.read(folder).last_status != "failed":
        records.RunFolder(folder).write_status("failed", reason=reason)
