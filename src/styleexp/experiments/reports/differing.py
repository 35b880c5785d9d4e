"""What tells runs apart, in words: for titles and labels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from styleexp.experiments.reports import html
from styleexp.runs.reading import Run

SEED = "optim.seed"
"""Key of the seed."""
OMITTED = "not given"
"""Value of a run without an override for a key."""
DIGITS = 8
MOST_KEYS, MOST_VALUES = 3, 6
"""Number of keys that a title tells, and of values of each."""


def settings(run: Run) -> dict[str, str]:
    """A run's overrides by key, without Hydra's prefixes and without ``hydra.*`` keys. Numbers with
    many digits, as a search draws them, are rounded to four."""
    pairs = (override.lstrip("+~").partition("=") for override in run.overrides)
    return {key: rounded(value) for key, _, value in pairs if not key.startswith("hydra")}


def rounded(value: str) -> str:
    """The text of a number with more than `DIGITS` characters, with four digits; other texts."""
    try:
        return f"{float(value):.4g}" if len(value) > DIGITS else value
    except ValueError:
        return value


def of_overrides(runs: Sequence[Run]) -> dict[str, list[str]]:
    """The keys whose overrides differ between runs, with each run's value: that of its
    configuration, where all have the key (``1`` and ``1.0`` are equal then), else as given."""
    given = [settings(run) for run in runs]
    found = {}
    for key in dict.fromkeys(key for each in given for key in each):
        values = [each.get(key, OMITTED) for each in given]
        if all(key in run.config for run in runs):
            values = [html.plain(run.config[key]) for run in runs]
        if len(set(values)) > 1:
            found[key] = values
    return found


def of(tables: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """The keys whose values differ between tables, with each table's value, None if it has none."""
    keys = dict.fromkeys(key for each in tables for key in each)
    rows = {key: [each.get(key) for each in tables] for key in keys}
    return {key: row for key, row in rows.items() if len(set(map(repr, row))) > 1}


def setting(key: str, value: str) -> str:
    """A key and its value, for a label."""
    return f"{key} {OMITTED}" if value == OMITTED else f"{key}={value}"


def told(values: Mapping[str, Sequence[str]]) -> str:
    """Keys with their values, for a title: ``layers low, high; field.sigma 1, 5``."""
    parts = []
    for key, each in list(values.items())[:MOST_KEYS]:
        distinct = list(dict.fromkeys(each))
        more = len(distinct) - MOST_VALUES
        shown = [*distinct[:MOST_VALUES], *([f"{more} more"] if more > 0 else [])]
        parts.append(f"{key} {', '.join(shown)}")
    if (more := len(values) - MOST_KEYS) > 0:
        parts.append(f"{more} more keys" if more > 1 else "1 more key")
    return "; ".join(parts)
