"""Parts that are chosen by name: a name, its options, and a factory that imports it when used."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Spec:
    """One choice of a kind of part, built in or a plugin's.

    What the factory is called with, and what ``config`` has to be:

    - renderer: ``factory(options)``; any dataclass.
    - encoder: ``factory(options, device=, seed=)``; ``config.EncoderConfig`` or a subclass.
    - style: ``factory(options)``; ``config.StyleConfig`` or a subclass. Returns a mesh, or an image
      of shape (height, width, 3) in [0, 1].
    - field: ``factory(options, generator=, sigma=, bound=)``; ``config.FieldConfig`` or a subclass.
    - loss: ``factory(options, encoder=)``; ``config.LossConfig`` or a subclass.
    - baseline: ``factory(options)``; any dataclass. Returns a `baselines.Method`.
    - logger: ``factory(options, folder=, record=, step=)``; any dataclass. Returns a
      `loggers.Logger` for the run of that folder, whose ``run.json`` is the record, from that step.
    """

    name: str
    description: str
    config: type
    """Dataclass of its options, with a ``name`` field and a default for each; what Hydra validates
    against."""
    factory: Callable[..., Any]
    """Builds the part from such options. Heavy imports belong inside."""
    requires: tuple[str, ...] = ()
    """Top-level import names of packages that it needs and that may be missing."""
    extra: str | None = None
    """The extra of its own distribution that brings them."""
    reads: tuple[str, ...] | None = None
    """Of a baseline: the keys that it reads, besides its own options and what every run reads
    (`styleexp.unread`); a key stands for all below it. A run says of the others that are given that
    they have no effect. None: not known."""
