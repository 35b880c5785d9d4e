"""From a configuration to objects: the method with its parts, and what it works on.

The method itself takes objects, and never sees the configuration.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import torch

from styleexp import plugins
from styleexp.config import sources
from styleexp.config.checks import check
from styleexp.method.gram_cache import GramCache, uncached
from styleexp.method.paper import PaperLoop
from styleexp.method.scene import Parts
from styleexp.method.subject import Subject, measure
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from styleexp.config.schema import Config
    from styleexp.method.base import Method, Scene
    from styleexp.method.scene import Cache


def prepare(config: Config) -> tuple[Method[Any], Scene]:
    """The method of a run and its prepared scene; raises `UserError` for anything that's wrong with
    the configuration or the files."""
    check(config)
    device = device_of(config)
    method = method_of(config, device)
    return method, method.prepare(subject_of(config, method.separates_relief, device))


def method_of(config: Config, device: torch.device | None = None) -> Method[Any]:
    """The method named in ``config.baseline``, or the learned one with its parts, on this device
    instead of that of ``config``."""
    if config.baseline is not None:
        return plugins.build("baseline", config.baseline)
    device = device or device_of(config)
    renderer = plugins.build("renderer", config.renderer)
    encoder = plugins.build("encoder", config.encoder, device=device, seed=config.optim.seed)
    return PaperLoop(
        parts=Parts(renderer, encoder, plugins.build("loss", config.loss, encoder=encoder)),
        field=partial(plugins.build, "field", config.field),
        separates_relief=separates(config),
        cache=cache_of(config, encoder),
    )


def subject_of(
    config: Config, separate: bool = False, device: torch.device | None = None
) -> Subject:
    """Load source and style, and measure them, on this device instead of that of ``config``; see
    `method.subject.measure`."""
    device = device or device_of(config)
    source = sources.load_source(config.source)
    style = sources.load_style(config.style)
    as_tone = config.baseline is None
    return measure(config, source, style, device, separate=separate, as_tone=as_tone)


def separates(config: Config) -> bool:
    """Whether the run's method separates a style mesh's relief from its shape."""
    if config.baseline is not None:
        return plugins.build("baseline", config.baseline).separates_relief
    return config.field.start == "synthesis"


def cache_of(config: Config, encoder: Any) -> Cache:
    """Cache of the style's statistics. Those that involve plugins, whose code may depend on
    more than its own files, are never cached."""
    parts = (("renderer", config.renderer), ("encoder", config.encoder), ("loss", config.loss))
    own = all(plugins.find(kind, part.name).origin == plugins.OWN for kind, part in parts)
    if not own or config.loss.name != "gram":
        return uncached
    options = (config.views, config.shading, config.encoder, config.loss, config.renderer)
    return GramCache((*options, config.optim.seed), encoder)


def device_of(config: Config) -> torch.device:
    """The device of a run: of a learned method, one that its renderer can use."""
    if config.baseline is not None:
        return choose_device(config.device)
    capabilities = plugins.build("renderer", config.renderer).capabilities
    return choose_device(config.device, config.renderer.name, capabilities.devices)


def choose_device(
    name: str, renderer: str | None = None, devices: Sequence[str] = ("cpu", "cuda")
) -> torch.device:
    """The requested device; ``auto`` is CUDA if there is one and ``renderer`` can use it.

    ``devices`` are the kinds of device that the renderer can use (``capabilities.devices``). Raises
    `UserError` for one that can't be used, whether by the renderer or at all: a kernel is tried.
    """
    if name == "auto":
        there = torch.cuda.is_available() and "cuda" in devices
        return _tried("cuda", "auto") if there else torch.device("cpu")
    device = _tried(name, name)
    if device.type not in devices:
        raise UserError(
            f"renderer={renderer} can't use device={name}, only {', '.join(devices)}: use "
            f"device={devices[0]}, or another renderer."
        )
    return device


def _tried(name: str, asked: str) -> torch.device:
    """The device, on which a kernel has run: a card can be too old for this build of torch."""
    try:
        device = torch.device(name)
        torch.ones(1, device=device).add_(1).item()
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise UserError(f"device={asked} can't be used ({reason}): use device=cpu.") from error
    return device
