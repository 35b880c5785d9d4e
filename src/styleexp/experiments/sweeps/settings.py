"""The overrides of a sweep's jobs, and the settings that distinguish them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

GROUPS = ("source", "style", "pair")
"""Keys that choose source and style; all others are settings."""


def product(params: Mapping[str, str] | None, overrides: Sequence[str]) -> list[list[str]]:
    """The jobs of Hydra's basic sweeper, in order, as lists of overrides.

    ``params`` are those of ``hydra.sweeper``; ``overrides`` with the same key replace them. Raises
    Hydra's exceptions for values that can't be parsed or aren't a list. Needs an initialised Hydra.
    """
    from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.override_parser.overrides_parser import OverridesParser

    parser = OverridesParser.create(config_loader=GlobalHydra.instance().config_loader())
    given = [f"{key}={value}" for key, value in (params or {}).items()]
    parsed = parser.parse_overrides([*given, *overrides])
    return BasicSweeper.split_arguments(parsed, None)[0]


def varying(jobs: Sequence[Sequence[str]]) -> list[dict[str, str]]:
    """For each job, the overrides that not all jobs share, without Hydra's ``+``."""
    split = [dict(_pair(override) for override in overrides) for overrides in jobs]
    keys = dict.fromkeys(key for each in split for key in each)
    differing = [key for key in keys if len({each.get(key) for each in split}) > 1]
    return [{key: each[key] for key in differing if key in each} for each in split]


def setting(overrides: Mapping[str, str]) -> str:
    """A short label of the overrides that are settings, such as ``high`` or ``field.sigma=5``."""
    return ", ".join(_label(k, v) for k, v in overrides.items() if k.split(".")[0] not in GROUPS)


def readable(overrides: Mapping[str, str]) -> str:
    """The overrides as typed, for a table."""
    return " ".join(f"{key}={value}" for key, value in overrides.items())


def _label(key: str, value: str) -> str:
    return f"{key}={value}" if "." in key else value


def _pair(override: str) -> tuple[str, str]:
    key, _, value = override.partition("=")
    return key.lstrip("+"), value
