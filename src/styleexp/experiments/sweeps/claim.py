"""Claim the folder of a run or sweep before Hydra writes the first file into it.

A folder named by the time gets a suffix if it is taken, since two commands in the same second would
share it. A folder named by the user is refused while another process uses it; a sweep's also if it
contains results of other jobs.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from styleexp.config import unread
from styleexp.config.overrides import quote
from styleexp.experiments.sweeps import pruning
from styleexp.experiments.sweeps.settings import product
from styleexp.runs import identity, reading
from styleexp.runs.jobs import JOBS, Job, listed
from styleexp.runs.records import RunFolder
from styleexp.system import locks
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from styleexp.config.schema import Config

LIMITS = ("n_trials", "max_failure_rate")
"""Settings of a search that don't change its trials, but when it ends."""
PATIENCE = 2.0
"""Seconds to wait for a folder, because checking whether it is held locks it briefly."""


def run(config: DictConfig) -> None:
    """Claim the folder of a single run, and set it in ``config``.

    Raises `UserError` if the user named the folder and another process is using it.
    """
    _claim(config, "run")


def sweep(config: DictConfig) -> Path:
    """Claim the folder of a sweep, record its jobs in ``jobs.json``, and return the folder.

    Raises `UserError` like `run`, if the folder contains results of other jobs, and for a search
    whose settings for pruning can't be used.
    """
    pruning.settings(config.hydra.job.env_set)
    folder = _claim(config, "sweep")
    try:
        configs: dict[str, Config] = {}
        jobs = _jobs(config, folder, configs)
        content: dict[str, Any] = {"search": _search(config)}
        if jobs is not None:
            content = {"jobs": [job.overrides for job in jobs], "keys": [job.key for job in jobs]}
        _refuse_others(folder, jobs or (), configs, content)
    except BaseException:
        locks.drop(folder)
        raise
    RunFolder(folder).write_json(JOBS, content)
    if note := unread.note(list(configs.values()), _given(config)):
        print(f"note: {note}", flush=True)
    return folder


def _claim(config: DictConfig, kind: str) -> Path:
    """Lock the folder ``hydra.KIND.dir``, or a sibling if it is taken and its name is arbitrary."""
    from omegaconf import OmegaConf, open_dict, read_write

    named = f"hydra.{kind}.dir"
    folder = Path(OmegaConf.select(config, named))
    raw = OmegaConf.to_container(config.hydra[kind], resolve=False)
    assert isinstance(raw, dict)
    given = any(each.lstrip("+").startswith(f"{named}=") for each in config.hydra.overrides.hydra)
    if given or "${now:" not in str(raw["dir"]):
        try:
            locks.take(folder, PATIENCE)
        except locks.Busy:
            raise UserError(busy(folder, kind)) from None
        return folder
    made = fresh(folder)
    if made != folder:
        with read_write(config.hydra), open_dict(config.hydra):
            config.hydra[kind].dir = str(made)
            # A sweep's jobs are composed again, with these.
            config.hydra.overrides.hydra.append(f"{named}={quote(str(made))}")
    return made


def busy(folder: Path, kind: str = "run") -> str:
    """Error message for a folder that another process holds."""
    return (
        f"another process is using '{folder}': wait for it, or choose another folder with "
        f"hydra.{kind}.dir=FOLDER."
    )


def fresh(folder: Path) -> Path:
    """Create and lock an unused folder: this one, or the first free one with a number appended.

    The lock is for this process's next `locks.hold`.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    for each in _names(folder):
        with suppress(FileExistsError, locks.Busy):
            each.mkdir()
            locks.take(each)
            return each
    raise AssertionError("unreachable")


def _names(folder: Path) -> Iterator[Path]:
    yield folder
    for number in itertools.count(2):
        yield folder.with_name(f"{folder.name}_{number}")


def _jobs(config: DictConfig, folder: Path, configs: dict[str, Config]) -> list[Job] | None:
    """The sweep's jobs with their keys; None if the sweeper generates them dynamically. Puts their
    configurations into ``configs``, by the jobs' names."""
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.hydra_config import HydraConfig
    from omegaconf import open_dict

    from styleexp.config import compose

    if "BasicSweeper" not in config.hydra.sweeper._target_:
        return None
    listed = product(config.hydra.sweeper.params, _given(config))
    loader: Any = GlobalHydra.instance().config_loader()
    jobs, before = [], HydraConfig.instance().cfg
    for number, overrides in enumerate(listed):
        key = None
        # If composing fails, Hydra or the job itself reports the error.
        with suppress(Exception):
            composed = loader.load_sweep_config(config, list(overrides))
            with open_dict(composed):
                composed.hydra.job.id = composed.hydra.job.num = number
                HydraConfig.instance().set_config(composed)
                del composed["hydra"]
            configs[str(number)] = compose.typed(composed)
            key = identity.job_key(configs[str(number)])
        jobs.append(Job(str(number), tuple(overrides), folder / str(number), key))
    HydraConfig.instance().cfg = before
    return jobs


def _given(config: DictConfig) -> list[str]:
    """The command's overrides in Hydra's grammar; resolving would lose an escaped "${" in a file's
    name."""
    from omegaconf import OmegaConf

    given: Any = OmegaConf.to_container(config.hydra.overrides.task, resolve=False)
    return given


def _search(config: DictConfig) -> dict[str, Any]:
    """Description of a search, whose jobs aren't known in advance. Another number of trials is the
    same search, going on: a seeded sampler proposes the same first ones, which are done."""
    from omegaconf import OmegaConf

    sweeper = OmegaConf.to_container(config.hydra.sweeper, resolve=True)
    assert isinstance(sweeper, dict)
    kept = {key: value for key, value in sweeper.items() if key not in LIMITS}
    return {"overrides": _given(config), "sweeper": json.loads(json.dumps(kept, default=str))}


def _refuse_others(
    folder: Path, jobs: Sequence[Job], configs: Mapping[str, Config], content: dict[str, Any]
) -> None:
    """Raise `UserError` if a folder contains results of other jobs. Jobs that failed, and those
    that differ only in the code of their plugins, may be overwritten."""
    from styleexp.runs import identity

    remedy = "choose another folder with hydra.sweep.dir=FOLDER, or remove it."
    planned = listed(folder)
    if planned is not None:
        asked = "jobs" if "jobs" in content else "search"
        if planned.get(asked) != json.loads(json.dumps(content[asked])):
            raise UserError(f"'{folder}' contains another sweep: {remedy}")
    for job in jobs:
        run = reading.of_job(job)
        if run.status == "newer":
            raise UserError(f"cannot run in '{job.folder}': {run.reason}")
        if run.status == "other" and run.last_status != "failed":
            record, made = reading.read(job.folder).record, configs.get(job.name)
            if made is not None and identity.edited_since(made, job.overrides, record):
                continue
            raise UserError(f"'{job.folder}' doesn't belong to this sweep ({run.reason}): {remedy}")
