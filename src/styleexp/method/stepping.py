"""The optimiser's rate and gradient, and checks of a step's numbers."""

from __future__ import annotations

import math
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
    for parameter in field.parameters():
        if parameter.grad is not None:
            parameter.grad /= length.clamp(min=1e-30)


def check_numbers(
    step: int, parts: dict[str, Tensor], total: float = 0.0, first: float = 0.0
) -> None:
    """Raise `Diverged` for the first part that isn't finite, or if the loss ``total`` exceeds
    `EXPLODED` times one plus the ``first`` one of this process. All parts are checked, because a
    fused ReLU turns NaN into 0, so NaN in a picture may not reach the loss. The field is still
    unchanged by the step."""
    # Minimum and maximum are NaN if any value is: four times as fast as checking each value. All
    # parts are checked together, since each transfer synchronises the GPU.
    ranges = [torch.stack(values.detach().aminmax()) for values in parts.values()]
    finite = torch.stack([each.isfinite().all() for each in ranges]).tolist()
    for part, is_finite in zip(parts, finite, strict=True):
        if not is_finite:
            raise Diverged(step, f"{part} became NaN or infinite")
    if abs(total) > EXPLODED * (1 + abs(first)):
        raise Diverged(step, f"the loss exploded, from {first:.3g} to {total:.3g},")
