"""Parts that are chosen by name: a name, its options, and a factory that imports it when used."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from styleexp.errors import UserError, unknown_name


@dataclass(frozen=True)
class Spec:
    """One choice of a kind of part."""

    name: str
    description: str
    config: type
    """Dataclass of its options, with a ``name`` field; what Hydra validates against."""
    factory: Callable[[Any], Any]
    """Builds the part from such options. Heavy imports belong inside."""


def build(kind: str, registry: Mapping[str, Spec], options: Any) -> Any:
    """Build the part that ``options.name`` names; an unknown name is a `UserError`."""
    name = getattr(options, "name", None)
    if name is None:
        raise UserError(f"no {kind} was chosen: give {kind}=NAME, one of {', '.join(registry)}.")
    if name not in registry:
        raise unknown_name(kind, name, registry)
    return registry[name].factory(options)
