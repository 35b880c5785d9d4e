"""Runs a plan: whatever is not done yet, through one of Hydra's launchers, until nothing is left.

A job is claimed by the lock of its own folder, which its process holds as long as it lives. So any
number of runners may work on one plan, on one machine or on several that share its folder; a runner
or a worker that is killed leaves a job that is resumed from its checkpoint.
"""

from __future__ import annotations

import multiprocessing
import os
import threading
import time
import traceback
from collections import Counter
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from styleexp import locks, records
from styleexp.errors import UserError
from styleexp.overrides import quote
from styleexp.reports import runs
from styleexp.sweeps import launchers, manifest
from styleexp.sweeps.jobs import Job

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from styleexp.sweeps.plan import Planned

LOG = "log.txt"
"""In a job's folder: what it printed."""
MOST_DEATHS = 3
"""A job whose process died so often, with no other job beside it, has failed."""
AT_WORK = threading.Lock()
"""Held by this process while it is at a job."""
POLL = 1.0
"""Seconds between looks at jobs that other runners are at."""


def run(jobs: Sequence[Planned], folder: Path, launcher: Sequence[str]) -> None:
    """Run what is neither done nor failed, and wait for what other runners are at.

    ``launcher`` are overrides of Hydra's own configuration, ``launcher=...`` among them. Raises
    `UserError` where the launcher itself fails without a job having begun.
    """
    deaths: Counter[str] = Counter()
    suspects: set[str] = set()
    while True:
        if not (folder / manifest.NAME).exists():  # the folder was removed under us
            manifest.write(folder, jobs)
        states = {}
        for job in jobs:
            found = runs.of_job(job)
            manifest.refuse_others(job, found)
            states[job.name] = found["status"]
            if states[job.name] not in manifest.ENDED and deaths[job.name] >= MOST_DEATHS:
                _give_up(job, folder)
                states[job.name] = "failed"
        waiting = [job for job in jobs if states[job.name] not in (*manifest.ENDED, "running")]
        if not waiting:
            if "running" not in states.values():
                return
            time.sleep(POLL)
            continue
        # A worker that dies may take the others with it: what died is tried again alone.
        batch = [job for job in waiting if job.name not in suspects] or waiting[:1]
        before = _progress(folder, batch)
        error = _launch(batch, folder, launcher)
        after = {job.name: runs.of_job(job)["status"] for job in batch}
        died = [name for name, state in after.items() if state == "died"]
        if error is not None and not set(after.values()) & set(manifest.ENDED):
            # Nothing came of it: some job can't even leave a status, as in a folder without space.
            died = [name for name, state in after.items() if state != "running"]
        if len(batch) == 1:
            deaths.update(died)
        suspects.update(died)
        if error is None:
            continue
        if _progress(folder, batch) == before:
            raise UserError(
                f"the launcher failed before any job began ({records.first_line(error)}): see "
                f"{folder} or try --launcher basic."
            ) from error
        print(f"styleexp-sweep: a worker failed ({records.first_line(error)}); going on.")


def retry(jobs: Sequence[Planned]) -> None:
    """Let failed jobs run again, from their checkpoints where they have one."""
    for job in jobs:
        if runs.of_job(job)["status"] != "failed":
            continue
        with suppress(locks.Busy), locks.hold(job.folder):
            again = "failed, to be tried again"
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


def _launch(jobs: Sequence[Planned], folder: Path, launcher: Sequence[str]) -> Exception | None:
    """Give the jobs to Hydra's launcher; returns what it raised or a job's process died of."""
    import hydra
    from hydra._internal.callbacks import Callbacks
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.plugins import Plugins
    from hydra.core.utils import JobStatus
    from hydra.types import HydraContext, RunMode

    with hydra.initialize_config_module("styleexp.conf", version_base="1.3"):
        composed: Any = GlobalHydra.instance().hydra
        config = composed.compose_config(
            "config",
            [f"hydra.sweep.dir={quote(str(folder))}", *launcher],
            run_mode=RunMode.MULTIRUN,
            from_shell=False,
        )
        started = Plugins.instance().instantiate_launcher(
            hydra_context=HydraContext(composed.config_loader, Callbacks()),
            task_function=task,
            config=config,
        )
        threads = launchers.threads_each(config.hydra)
        # Hydra composes every job with the launcher's own overrides: they need the launcher, too.
        chosen = [each for each in launcher if each.startswith("launcher=")]
        given = []
        for job in jobs:
            more = [*chosen, f"hydra.sweep.subdir={quote(job.name)}"]
            if not any(each.startswith("threads=") for each in job.overrides):
                more.append(f"threads={threads}")
            given.append([*job.overrides, *more])
        size = launchers.batch_size(config.hydra) or len(jobs)
        for at in range(0, len(jobs), size):
            try:
                returned = started.launch(given[at : at + size], initial_job_idx=at)
            except Exception as error:
                _settle(jobs[at : at + size])
                return error
            for each in returned:
                if each.status == JobStatus.FAILED:
                    return each._return_value
    return None


def _settle(jobs: Sequence[Planned]) -> None:
    """Wait for the jobs that go on although another of them was killed."""
    while any(runs.of_job(job)["status"] == "running" for job in jobs):
        time.sleep(POLL)


def task(config: DictConfig) -> None:
    """What the launcher calls for a job, maybe in another process.

    Skips what another runner does or did in the meantime. Never raises for the job's own failure.
    """
    from contextlib import chdir

    from hydra.core.hydra_config import HydraConfig
    from omegaconf import OmegaConf

    from styleexp import compose

    _end_with_runner()
    runtime = HydraConfig.get()
    root, folder = Path(runtime.sweep.dir), Path(runtime.runtime.output_dir)
    name = str(runtime.sweep.subdir)
    # As they are in Hydra's grammar: resolved, an escaped "${" in a file's name would be lost.
    given: Any = OmegaConf.to_container(runtime.overrides.task, resolve=False)
    compose.register()
    try:
        with AT_WORK, locks.hold(folder), chdir(runtime.runtime.cwd):  # see hydra.job.chdir
            # No key: somebody removed the manifest, which the runner then writes anew.
            key = manifest.read(root).get(name, {}).get("key")
            job = Job(name, tuple(given), folder, key)
            state = runs.of_job(job)["status"] if key else runs.status(folder)
            if state not in (*manifest.ENDED, "other"):  # the runner refuses another run's folder
                _work(config, root, job)
    except locks.Busy:
        return


@cache
def _end_with_runner() -> None:
    """End a worker of joblib after its job where its runner was killed: it would wait for ever."""
    if not multiprocessing.current_process().name.startswith("Loky"):
        return
    runner = os.getppid()

    def watch() -> None:
        while os.getppid() == runner:
            time.sleep(POLL)
        with AT_WORK:
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _work(config: DictConfig, root: Path, job: Job) -> None:
    """Do a job whose lock is held; what it prints goes into its log."""
    from styleexp import compose, identity
    from styleexp.cli.run import begin

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
            told = [each for each in job.overrides if not each.startswith("launcher=")]
            typed = compose.typed(config)
            if job.key not in (None, identity.job_key(typed)):
                raise UserError(
                    "a file of its source or style has changed since the plan was read: start the "
                    "plan again."
                )
            code = begin(typed, folder, [*told, "hydra.mode=RUN"])
        except UserError as error:
            _failed(folder, str(error))
            print(f"styleexp: {error}")
        except Exception as error:
            _failed(folder, records.first_line(error))
            traceback.print_exc()
    state = str(runs.status(folder))
    listed = manifest.update(root, name, state)
    done = sum(job["state"] == "done" for job in listed.values())
    current = sum(job["state"] != "outdated" for job in listed.values())
    took = time.perf_counter() - begun
    print(f"{name}: {state} in {took:.0f} s ({done} of {current} done)", flush=True)
    if code == 130:
        raise KeyboardInterrupt


def _failed(folder: Path, reason: str) -> None:
    """Leave a status where the run could not even begin one."""
    if runs.status(folder) != "failed":
        records.RunFolder(folder).write_status("failed", reason=reason)
