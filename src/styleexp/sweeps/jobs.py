"""The jobs of a sweep: which there are, and what tells them apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

GROUPS = ("source", "style", "pair")
"""Keys that choose what is stylised; all others are settings."""


@dataclass(frozen=True)
class Job:
    """One run of a sweep, begun or not."""

    name: str
    """Unique in the sweep; its number where Hydra counts."""
    overrides: tuple[str, ...]
    folder: Path


def product(params: Mapping[str, str] | None, overrides: Sequence[str]) -> list[list[str]]:
    """The jobs of Hydra's basic sweeper, in its order, as lists of overrides.

    ``params`` are those of ``hydra.sweeper``; ``overrides`` of the same key take their place.
    Raises Hydra's exceptions for what can't be parsed or is no list of values. Needs an initialised
    Hydra.
    """
    from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.override_parser.overrides_parser import OverridesParser

    parser = OverridesParser.create(config_loader=GlobalHydra.instance().config_loader())
    given = [f"{key}={value}" for key, value in (params or {}).items()]
    parsed = parser.parse_overrides([*given, *overrides])
    return BasicSweeper.split_arguments(parsed, None)[0]


def varying(jobs: Sequence[Sequence[str]]) -> list[dict[str, str]]:
    """For each job those of its overrides that not all jobs have, without Hydra's ``+``."""
    split = [dict(_pair(override) for override in overrides) for overrides in jobs]
    keys = dict.fromkeys(key for each in split for key in each)
    told = [key for key in keys if len({each.get(key) for each in split}) > 1]
    return [{key: each[key] for key in told if key in each} for each in split]


def setting(overrides: Mapping[str, str]) -> str:
    """A short label of the overrides that are settings: ``high``, ``field.sigma=5``."""
    return ", ".join(_label(k, v) for k, v in overrides.items() if k.split(".")[0] not in GROUPS)


def readable(overrides: Mapping[str, str]) -> str:
    """The overrides as they are typed, for a table."""
    return " ".join(f"{key}={value}" for key, value in overrides.items())


def _label(key: str, value: str) -> str:
    return f"{key}={value}" if "." in key else value


def _pair(override: str) -> tuple[str, str]:
    key, _, value = override.partition("=")
    return key.lstrip("+"), value
