"""Plans: experiments with their seeds and sizes, in order.

A plan is a YAML file (``sweeps/*.yaml``)::

    profile: fast                 # for every job; on the command line: profile=standard
    launcher: basic               # an option of conf/launcher
    seeds: [0]                    # optim.seed, unless an experiment sweeps it
    overrides: [encoder=vgg16]    # for every job
    experiments:
      - experiment: sigma_ablation          # a name in conf/experiment, swept as defined there
        figure: Fig. 7
        minutes: {fast: 3, standard: 8}     # duration of all its jobs on two cores
      - name: pairs                         # or without an experiment's name
        pairs: [[spot, stripe], [bunny, bubble]]    # source and style, not their product
        overrides: ["field.sigma=1,5"]
"""

from __future__ import annotations

import dataclasses
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from dataclasses import field as option
from pathlib import Path
from typing import TYPE_CHECKING, Any

from styleexp.config.overrides import literal, quote, understood
from styleexp.experiments.sweeps.settings import product, varying
from styleexp.runs.identity import job_key
from styleexp.runs.jobs import Job
from styleexp.system.errors import UserError, unknown_name

if TYPE_CHECKING:
    from styleexp.config.schema import Config


@dataclass
class Entry:
    """One experiment of a plan."""

    experiment: str | None = None
    name: str | None = None
    """Name of its folder; default: the experiment's name."""
    figure: str = ""
    """The paper's figure that it reproduces."""
    minutes: dict[str, float] = option(default_factory=dict)
    """Total minutes of its jobs on two cores, by profile."""
    overrides: list[str] = option(default_factory=list)
    pairs: list[list[str]] = option(default_factory=list)
    """Pairs of source and style."""
    seeds: list[int] | None = None
    """Seeds that replace the plan's."""


@dataclass
class Plan:
    """Experiments in order."""

    experiments: list[Entry]
    profile: str = "standard"
    launcher: str = "basic"
    seeds: list[int] = option(default_factory=list)
    overrides: list[str] = option(default_factory=list)


@dataclass(frozen=True)
class Planned(Job):
    """A job of a plan. ``name`` is its folder below the plan's."""

    entry: str = ""
    config: Config | None = option(default=None, compare=False, repr=False)

    def command(self) -> str:
        """The equivalent command."""
        target = f"hydra.run.dir={quote(str(self.folder))}"
        return shlex.join(["styleexp", *self.overrides, "hydra.mode=RUN", target])


def read(path: Path) -> Plan:
    """Read and validate a plan. Raises `UserError` if it is invalid."""
    import yaml

    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UserError(f"there is no plan '{path}': give a YAML file, see sweeps/.") from None
    except (OSError, ValueError, yaml.YAMLError) as error:
        message = " ".join(str(error).split())
        raise UserError(f"the plan '{path}' can't be read: {message}.") from error
    if not isinstance(content, dict) or not content.get("experiments"):
        raise UserError(f"the plan '{path}' lists no experiments: see sweeps/ for examples.")
    entries = []
    for number, each in enumerate(content["experiments"], 1):
        entry = _typed(Entry, each, f"experiment {number} of '{path}'")
        if entry.name is None and entry.experiment is None:
            raise UserError(f"experiment {number} of '{path}' has no experiment and no name.")
        if any(len(pair) != 2 for pair in entry.pairs):
            raise UserError(f"experiment {number} of '{path}': pairs are [source, style].")
        entries.append(dataclasses.replace(entry, name=entry.name or entry.experiment))
    names = [entry.name for entry in entries]
    for name in names:
        if names.count(name) > 1:
            raise UserError(f"the plan '{path}' has '{name}' twice: give each its own name.")
    content["experiments"] = [dataclasses.asdict(entry) for entry in entries]
    return _typed(Plan, content, f"'{path}'")


def _typed(schema: Any, content: Any, where: str) -> Any:
    """Convert a mapping to a dataclass, checking keys and types."""
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    known = [each.name for each in dataclasses.fields(schema)]
    if not isinstance(content, dict):
        raise UserError(f"{where} must be a mapping with the keys {', '.join(known)}.")
    made = OmegaConf.structured(schema)
    for key, value in content.items():
        if key not in known:
            raise unknown_name(f"key in {where},", str(key), known)
        try:
            made = OmegaConf.merge(made, {key: literal(value)})
        except OmegaConfBaseException as error:
            raise UserError(f"{where}: {key} can't be {value!r}.") from error
    return OmegaConf.to_object(made)


def experiment_jobs(overrides: Sequence[str]) -> list[list[str]]:
    """The jobs that ``styleexp -m`` creates from these overrides, as lists of overrides."""
    import hydra

    from styleexp.config import compose

    compose.register()
    with hydra.initialize_config_module("styleexp.conf", version_base="1.3"):
        return product(_params(overrides), overrides)


def _params(overrides: Sequence[str]) -> Mapping[str, str]:
    """The sweep parameters that a configuration defines. Needs an initialised Hydra."""
    from hydra.core.global_hydra import GlobalHydra
    from hydra.types import RunMode

    composed: Any = GlobalHydra.instance().hydra
    config = composed.compose_config(
        "config", list(overrides), run_mode=RunMode.MULTIRUN, from_shell=False
    )
    return dict(config.hydra.sweeper.params or {})


def jobs(plan: Plan, folder: Path, overrides: Sequence[str] = ()) -> dict[str, list[Planned]]:
    """The jobs of every experiment of a plan, keyed by its name, in order.

    Jobs with the same key share one folder and run once, even across experiments. Raises
    `UserError` and Hydra's exceptions if composing fails.
    """
    import hydra

    from styleexp.config import compose
    from styleexp.config.many import Composer

    compose.register()
    found: dict[str, list[Planned]] = {}
    first: dict[str, Planned] = {}
    with hydra.initialize_config_module("styleexp.conf", version_base="1.3"):
        composer = Composer()
        for entry in plan.experiments:
            assert entry.name is not None
            listed = [each for part in _parts(plan, entry, overrides) for each in part]
            made = []
            for each, settings in zip(listed, varying(listed), strict=True):
                config = composer.compose([*each, "hydra.mode=RUN"])
                key = job_key(config)
                name = f"{entry.name}/{_readable(settings)}-{key[:8]}"
                job = Planned(name, tuple(each), folder / name, key, entry.name, config)
                shared = first.setdefault(key, job)
                made.append(dataclasses.replace(job, name=shared.name, folder=shared.folder))
            found[entry.name] = made
    return found


def _parts(plan: Plan, entry: Entry, overrides: Sequence[str]) -> Iterator[list[list[str]]]:
    base = [f"+experiment={entry.experiment}"] if entry.experiment else []
    base += [f"profile={plan.profile}"]
    base += understood([*plan.overrides, *entry.overrides, *overrides], multirun=True)
    params = _params(base)  # what a pair chooses doesn't change them
    for pair in entry.pairs or [[]]:
        chosen = [f"{k}={v}" for k, v in zip(("source", "style"), pair, strict=False)]
        given = [*base, *understood(chosen)]
        seeds = entry.seeds if entry.seeds is not None else plan.seeds
        if seeds and (entry.seeds is not None or "optim.seed" not in params):
            given.append(f"optim.seed={','.join(map(str, seeds))}")
        yield product(params, given)


def _readable(overrides: Mapping[str, str]) -> str:
    """The overrides that distinguish a job, as a file name."""
    words = [
        v if "." not in k or k == "source.path" else f"{k.split('.')[-1]}{v}"
        for k, v in overrides.items()
    ]
    return re.sub(r"[^\w.+-]+", "-", "_".join(words)).strip("-.")[:80] or "run"
