"""Time of a step by part, forward and backward, in the real loop.

A part is a function whose calls are timed. Its inputs and outputs pass through a marker that
notifies the clock when a gradient passes: the backward pass enters a part at its outputs and leaves
it at its inputs. Every moment counts for exactly one part, so they sum to the total.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass, replace
from functools import partial, wraps
from typing import Any

import torch
from torch import Tensor, nn

from styleexp.encoders import fused
from styleexp.renderers.soft_raster import SoftRaster, deferred, shading

OTHER = "other"
BACKWARD = " backward"


class Parts:
    """Accumulates wall and CPU seconds of the active part."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.begin()

    def begin(self) -> None:
        """Reset and start."""
        self.spent: dict[str, list[float]] = defaultdict(lambda: [0.0, 0.0])
        self.within = [OTHER]
        self.last = self._now()

    def end(self) -> dict[str, tuple[float, float]]:
        """Wall and CPU seconds of each part since ``begin``."""
        self.turn(OTHER)
        return {name: (wall, cpu) for name, (wall, cpu) in self.spent.items()}

    def turn(self, name: str) -> None:
        """Make ``name`` the active part, at the current call depth."""
        self._count()
        self.within[-1] = name

    def timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Wrap a function as a part."""

        @wraps(function)
        def run(*given: Any, **named: Any) -> Any:
            if len(self.within) == 1 and torch.is_grad_enabled():
                self.turn(OTHER)  # the backward pass has ended
            around = self.within[-1]
            self._count()
            self.within.append(name)
            try:
                beyond = OTHER if around == OTHER else f"{around}{BACKWARD}"
                leave, enter = partial(self.turn, beyond), partial(self.turn, f"{name}{BACKWARD}")
                given, named = _marked(given, leave), _marked(named, leave)
                return _marked(function(*given, **named), enter)
            finally:
                self._count()
                self.within.pop()

        return run

    def wrap(self, name: str, owner: Any, attribute: str) -> None:
        """Wrap a method or submodule of an object as a part, permanently."""
        found = getattr(owner, attribute)
        if isinstance(found, nn.Module):
            owner, attribute, found = found, "forward", found.forward
        setattr(owner, attribute, self.timed(name, found))

    def _count(self) -> None:
        wall, cpu = self._now()
        spent = self.spent[self.within[-1]]
        spent[0] += wall - self.last[0]
        spent[1] += cpu - self.last[1]
        self.last = wall, cpu

    def _now(self) -> tuple[float, float]:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        return time.perf_counter(), time.process_time()


class _Mark(torch.autograd.Function):
    """Identity that notifies when the gradient passes."""

    @staticmethod
    def forward(ctx: Any, value: Tensor, tell: Callable[[], None]) -> Tensor:
        ctx.tell = tell
        return value.view_as(value)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        ctx.tell()
        return grad, None


def _marked(value: Any, tell: Callable[[], None]) -> Any:
    """Copy of a value with a marker on each tensor that carries a gradient."""
    if isinstance(value, Tensor):
        marks = torch.is_grad_enabled() and value.requires_grad
        return _Mark.apply(value, tell) if marks else value
    if isinstance(value, dict):
        return {key: _marked(each, tell) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_marked(each, tell) for each in value)
    if is_dataclass(value) and not isinstance(value, type):
        tensors = {f.name: getattr(value, f.name) for f in fields(value)}
        found = {k: _marked(v, tell) for k, v in tensors.items() if isinstance(v, Tensor)}
        changed = {k: v for k, v in found.items() if v is not tensors[k]}
        return replace(value, **changed) if changed else value
    return value


@contextmanager
def timed_stages(clock: Parts, stages: Sequence[tuple[str, Any, str]]) -> Iterator[None]:
    """Temporarily wrap functions or autograd functions of modules or classes as parts.

    Each stage is the part's name, the module or class, and the attribute's name.
    """
    before = [(owner, name, getattr(owner, name)) for _, owner, name in stages]
    try:
        for part, owner, name in stages:
            stage = getattr(owner, name)
            if hasattr(stage, "apply"):
                apply = staticmethod(clock.timed(part, stage.apply))
                setattr(owner, name, type(name, (), {"apply": apply}))
            else:
                setattr(owner, name, clock.timed(part, stage))
        yield
    finally:
        for owner, name, stage in before:
            setattr(owner, name, stage)


NORMALS = [("normals", deferred, "FaceNormals"), ("normals", shading, "vertex_normals")]
GRAMS = [
    ("Gram matrices", fused, "gram"),
    (f"Gram matrices{BACKWARD}", fused, "add_gram_gradient"),
]
"""Stages of the encoder's fused Gram computation."""
STAGES = [
    *NORMALS,
    ("projection", deferred, "Project"),
    ("visibility", deferred, "facing"),
    ("visibility", deferred, "candidate_pairs"),
    ("visibility", SoftRaster, "find_visible"),
    ("shading", shading, "NormalMatrices"),
    ("shading", shading, "LightPixels"),
    ("outlines", deferred, "find_crossings"),
    ("outlines", deferred, "CrossingDistance"),
    ("outlines", deferred, "Compose"),
]
"""Stages of ``soft_raster``, which shades and anti-aliases only visible pixels."""
