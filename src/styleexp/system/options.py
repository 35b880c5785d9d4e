"""Limits of options, declared with the dataclass fields they belong to.

Options are plain dataclasses, of built-in parts and of plugins alike. A field with limits is
written ``sigma: float = option(5.0, between=(0.001, 1000))``, followed by a string with its
meaning; `check` validates an instance. Hydra checks the types.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from styleexp.system.errors import UserError, unknown_name


def option(
    default: Any = dataclasses.MISSING,
    *,
    factory: Callable[[], Any] | Any = dataclasses.MISSING,
    choices: tuple[Any, ...] | None = None,
    above: float | None = None,
    between: tuple[float, float] | None = None,
) -> Any:
    """A dataclass field with limits. They don't apply to None; of a list, to every element.

    Args:
        default: the default value.
        factory: function that returns the default, for mutable values.
        choices: the allowed values.
        above: values must exceed this.
        between: least and largest allowed value.
    """
    limits = {"choices": choices, "above": above, "between": between}
    metadata = {name: limit for name, limit in limits.items() if limit is not None}
    if factory is not dataclasses.MISSING:
        return dataclasses.field(default_factory=factory, metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


def check(options: Any) -> None:
    """Raise `UserError` for the first value beyond its limits, naming its key and what is allowed.

    ``options`` is a dataclass instance; nested ones, and dictionaries of them, are checked too.
    Numbers must be finite.
    """
    found = list(_values(options))
    for key, value, limits in found:
        for each in value if isinstance(value, list) else [value]:
            if "choices" in limits and each not in (None, *limits["choices"]):
                raise unknown_name(f"value for {key}", str(each), map(str, limits["choices"]))
    for key, value, _ in found:
        for number in value if isinstance(value, list) else [value]:
            if isinstance(number, int | float) and not math.isfinite(number):
                raise UserError(f"{key}={number} is not allowed: give a finite number.")
    for key, value, limits in found:
        for number in value if isinstance(value, list) else [value]:
            if number is None:
                continue
            if "above" in limits and not number > limits["above"]:
                least = limits["above"]
                raise UserError(f"{key}={value} is not allowed: give a value above {least}.")
            low, high = limits.get("between", (-math.inf, math.inf))
            if "between" in limits and not low <= number <= high:
                raise UserError(f"{key}={value} is not allowed: give a value from {low} to {high}.")


def _values(options: Any, prefix: str = "") -> Iterator[tuple[str, Any, Mapping[str, Any]]]:
    """Key, value and limits of every field, nested ones included."""
    if isinstance(options, Mapping):
        for name, each in options.items():
            yield from _values(each, f"{prefix}{name}.")
        return
    if not dataclasses.is_dataclass(options):
        return
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        if dataclasses.is_dataclass(value) or isinstance(value, Mapping):
            yield from _values(value, f"{prefix}{field.name}.")
        else:
            yield prefix + field.name, value, field.metadata


def flatten(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """The values of nested dictionaries by their dotted keys."""
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, dict):
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat
