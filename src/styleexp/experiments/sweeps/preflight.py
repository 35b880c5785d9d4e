"""What the jobs of a plan need and this machine lacks, found without running any."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from styleexp import plugins
from styleexp.config import checks, sources
from styleexp.encoders.options import judge_name
from styleexp.inputs import assets
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from styleexp.config.schema import Config
    from styleexp.experiments.sweeps.plan import Planned

LEARNED = ("renderer", "encoder", "field", "loss")
"""Parts of the learned methods; a baseline uses none of them."""


def missing(jobs: Iterable[Planned]) -> dict[str, list[Planned]]:
    """What is missing or wrong, each as one sentence, with the jobs that can't run for it.

    Meshes, pictures, weights, plugins and extras are looked up by name and nothing heavy is
    imported, so a damaged file or a driver that doesn't work is found by the run alone.
    """
    found: dict[str, list[Planned]] = {}
    said: dict[tuple[Any, ...], str | None] = {}
    for job in jobs:
        assert job.config is not None
        for at, needed in _needs(job.config):
            if at not in said:
                said[at] = _said(needed)
            if (problem := said[at]) is not None and job not in found.setdefault(problem, []):
                found[problem].append(job)
    return found


def _said(needed: Callable[[], object]) -> str | None:
    try:
        needed()
    except UserError as error:
        return str(error)
    return None


def _needs(config: Config) -> Iterator[tuple[tuple[Any, ...], Callable[[], object]]]:
    """Yield checks, each with a key by which equal ones are known."""
    yield ("values", id(config)), partial(checks.check, config)
    for kind, part in sources.parts(config).items():
        yield (kind, part), partial(sources.check_part, kind, part)
    if config.baseline is not None:
        yield ("baseline", config.baseline.name), partial(_usable, "baseline", config.baseline.name)
    else:
        for kind in LEARNED:
            name = getattr(config, kind).name
            yield (kind, name), partial(_usable, kind, name)
        weights = getattr(config.encoder, "weights", None)
        encoder = config.encoder.name
        yield ("weights", encoder, weights), partial(_check_weights, encoder, weights)
    for name in config.logger:
        yield ("logger", name), partial(_usable, "logger", name)
    judge = judge_name(config.metrics.judge, config.encoder.name)
    if judge is not None:
        yield ("encoder", judge), partial(_usable, "encoder", judge)
        yield ("weights", judge, None), partial(_check_weights, judge, None)
    if config.preview.name == "pyrender":
        yield ("preview",), _check_pyrender


def _usable(kind: str, name: str | None) -> None:
    if name is None:
        raise UserError(f"no {kind} was chosen: give {kind}=NAME.")
    plugins.usable(kind, name)


def _check_weights(encoder: str, folder: str | None) -> None:
    """Raise `UserError` for weights that are not here, also for those that a run would download:
    all jobs at once, on nodes that may have no network."""
    if encoder == "clip" and folder is None:
        raise UserError("encoder=clip needs your own weights: give encoder.weights=FOLDER.")
    if folder is not None and not Path(folder).is_dir():
        raise UserError(f"encoder.weights={folder} is not a folder: check its name.")
    if encoder in assets.names("weights") and assets.locate(encoder, "weights") is None:
        raise UserError(
            f"the weights '{encoder}' are not on this machine: get them by 'styleexp-assets fetch "
            f"{encoder}'."
        )


def _check_pyrender() -> None:
    from importlib.util import find_spec

    if find_spec("pyrender") is None:
        raise UserError("preview=pyrender needs pyrender: pip install 'styleexp[gl]'.")


def told(problems: dict[str, list[Planned]], jobs: Sequence[Planned]) -> Iterator[str]:
    """Lines for the terminal: every problem once, with the jobs that it stops."""
    for problem, stopped in sorted(problems.items(), key=lambda item: -len(item[1])):
        entries = list(dict.fromkeys(job.entry for job in stopped))
        where = f"{', '.join(entries[:4])}{', ...' if len(entries) > 4 else ''}"
        yield f"- {problem}\n  stops {len(stopped)} of {len(jobs)} jobs ({where})"
