"""The optimiser's rate and gradient, and checks of a step's numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from styleexp.method.base import Diverged

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from styleexp.method.options import OptimConfig

EXPLODED = 1e6
"""The run counts as diverged above this multiple of one plus the first loss."""

MAX_SPEEDUP = 10.0
"""Most that ``optim.nominal_steps`` raises the rate: beyond, displacements saturate within a few
steps."""

WARM_UP = 0.1
"""Fraction of the run over which the cosine schedule warms up. Adam's first steps are as long as
any other, but their direction is mostly noise."""


def learning_rate(optim: OptimConfig, step: int) -> float:
    """Learning rate of a step; see ``OptimConfig.schedule``."""
    if optim.schedule == "step":
        speedup = min((optim.nominal_steps or optim.steps) / optim.steps, MAX_SPEEDUP)
        decays = math.floor(step * speedup / optim.decay_every)
        return optim.rate * speedup * optim.decay**decays
    rising = min(1.0, (step + 1) / (WARM_UP * optim.steps))
    falling = 0.5 * (1 + math.cos(math.pi * step / optim.steps))
    return optim.rate * rising * (0.05 + 0.95 * falling)


def gradient_norm(field: torch.nn.Module) -> Float[Tensor, ""]:
    """Norm of the gradient over all parameters."""
    return torch.nn.utils.get_total_norm([p.grad for p in field.parameters() if p.grad is not None])


def normalise_gradient(field: torch.nn.Module, length: Float[Tensor, ""]) -> None:
    """Divide the gradient of all parameters by ``length``, its norm; zero stays zero."""
    gradients = [p.grad for p in field.parameters() if p.grad is not None]
    if gradients:
        torch._foreach_div_(gradients, length.clamp(min=1e-30))


@dataclass(frozen=True)
class Read:
    """A step's numbers, read from the device at once: each read would have the host wait."""

    ranges: dict[str, tuple[float, float]]
    """Least and largest value of each part; NaN if any value is."""
    numbers: dict[str, float]


def read(parts: dict[str, Tensor], numbers: dict[str, Tensor]) -> Read:
    """Read the ranges of ``parts``, and ``numbers``, tensors without dimensions."""
    # Minimum and maximum are NaN if any value is: four times as fast as checking each value.
    ends = [
        end
        for values in parts.values()
        for end in (values.aminmax() if values.dim() else (values, values))
    ]
    together = torch.stack([each.detach().float() for each in (*ends, *numbers.values())]).tolist()
    pairs = zip(together[: len(ends) : 2], together[1 : len(ends) : 2], strict=True)
    rest = together[len(ends) :]
    return Read(dict(zip(parts, pairs, strict=True)), dict(zip(numbers, rest, strict=True)))


def check_finite(step: int, ranges: dict[str, tuple[float, float]]) -> None:
    """Raise `Diverged` for the first part that isn't finite. All parts are checked, because a
    fused ReLU turns NaN into 0, so NaN in a picture may not reach the loss."""
    for part, (least, most) in ranges.items():
        if not (math.isfinite(least) and math.isfinite(most)):
            raise Diverged(step, f"{part} became NaN or infinite")


def check_loss(step: int, total: float, first: float) -> None:
    """Raise `Diverged` if the loss exceeds `EXPLODED` times one plus the ``first`` one of this
    process."""
    if abs(total) > EXPLODED * (1 + abs(first)):
        raise Diverged(step, f"the loss exploded, from {first:.3g} to {total:.3g},")
