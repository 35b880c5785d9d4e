"""Specs of parts chosen by name: the name, its options, and a factory that imports the part
lazily."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Spec:
    """One choice of a kind of part, built in or from a plugin.

    Signature of the factory, and type of ``config``:

    - renderer: ``factory(options)``; any dataclass.
    - encoder: ``factory(options, device=, seed=)``; ``config.EncoderConfig`` or a subclass.
    - style: ``factory(options)``; ``config.StyleConfig`` or a subclass. Returns a mesh, or an image
      of shape (height, width, 3) in [0, 1].
    - field: ``factory(options, generator=, sigma=, bound=)``; ``config.FieldConfig`` or a subclass.
    - loss: ``factory(options, encoder=)``; ``config.LossConfig`` or a subclass.
    - baseline: ``factory(options)``; any dataclass. Returns a `baselines.Method`.
    - logger: ``factory(options, folder=, record=, step=)``; any dataclass. Returns a
      `loggers.Logger` for the run in that folder, whose ``run.json`` is ``record``, starting at
      ``step``.
    """

    name: str
    description: str
    config: type
    """Dataclass of its options, with a ``name`` field and defaults for all fields. Hydra validates
    against it."""
    factory: Callable[..., Any]
    """Builds the part from an instance of ``config``. Do heavy imports inside."""
    requires: tuple[str, ...] = ()
    """Top-level import names of required packages that may be missing."""
    extra: str | None = None
    """Extra of its own distribution that installs them."""
    reads: tuple[str, ...] | None = None
    """For a baseline: the keys it reads, besides its own options and those every run reads
    (`config.unread`). A key includes all keys below it. A run notes any other given key as having
    no effect. None: unknown."""
