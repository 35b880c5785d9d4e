"""Specs of parts chosen by name: the name, its options, and a factory that imports the part
lazily."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Spec:
    """One choice of a kind of part, built in or from a plugin.

    Signature of the factory, type of ``config``, and what it returns:

    - renderer: ``factory(options)``; any dataclass. A `renderers.base.Renderer`.
    - encoder: ``factory(options, device=, seed=)``; an `EncoderConfig`. An
      `encoders.base.Encoder`.
    - style: ``factory(options)``; a `StyleConfig`. A mesh, or an image of shape (height, width, 3)
      in [0, 1].
    - field: ``factory(options, points=, generator=, sigma=, bound=)``; a `FieldConfig`. A
      `method.fields.Field`.
    - loss: ``factory(options, encoder=)``; a `LossConfig`. A `method.losses.Loss`.
    - baseline: ``factory(options)``; any dataclass. A `method.base.Method`.
    - logger: ``factory(options, folder=, record=, step=)``; any dataclass. A
      `plugins.loggers.Logger` for the run in that folder, whose ``run.json`` is ``record``,
      starting at ``step``.

    ``config`` may add fields to the class named, and limits with `system.options.option`.
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
