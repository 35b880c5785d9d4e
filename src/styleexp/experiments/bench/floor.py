"""Lower bounds on the time of the encoder's convolutions, measured in the same process.

Two bounds. ``floor``: their arithmetic at the best rate that any matrix product or convolution
reaches on this machine. ``convolutions``: each convolution alone, forward and input gradient, with
warm caches; the remaining time is ReLU, pooling and copies.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from styleexp.experiments.bench.measuring import interleaved

if TYPE_CHECKING:
    from styleexp.encoders.vgg import VGG

Shape = tuple[int, int, int, int, int]
"""Images, input channels, output channels, height and width of a size-preserving 3x3
convolution."""
Call = tuple[tuple[int, ...], tuple[str, ...], bool]
"""An encoder call: shape of the images, layers, whether gradients are computed."""
Key = tuple[Shape, bool] | None
"""A convolution and whether to time its gradient, or None for the matrix product."""
PRODUCT = 2048
"""Rows and columns of the timed matrix product."""


@dataclass(frozen=True)
class Floor:
    """Bounds in CPU seconds per step, and rates."""

    flops: float
    """Floating-point operations of the convolutions, forward and, if computed, backward."""
    rates: dict[str, float]
    """Operations per CPU second of the matrix product, and of the best convolution."""
    convolutions: float
    """Sum over the convolutions, each timed alone."""

    @property
    def seconds(self) -> float:
        """Time of all operations at the best rate."""
        return self.flops / max(self.rates.values())


def encoder_floor(encoder: VGG, calls: Iterable[Call], repeats: int = 3) -> Floor:
    """Lower bounds of a step that makes these encoder calls."""
    forward: Counter[Shape] = Counter()
    backward: Counter[Shape] = Counter()
    for images, layers, gradients in calls:
        for shape in convolutions(encoder, images, layers):
            forward[shape] += 1
            backward[shape] += gradients
    weight = next(encoder.convs.parameters())
    work: dict[Key, Callable[[], object]] = {}
    for shape in forward:
        ahead, back = _convolution(shape, weight)
        work[shape, False] = ahead
        if backward[shape]:
            work[shape, True] = back
    square = torch.randn(PRODUCT, PRODUCT, device=weight.device).to(weight.dtype)
    work[None] = lambda: square @ square
    # The minimum, not the median: the best the machine can do.
    best = {key: min(times.cpu) for key, times in interleaved(work, repeats).items()}
    counts: dict[tuple[Shape, bool], int] = {(shape, False): n for shape, n in forward.items()}
    counts |= {(shape, True): n for shape, n in backward.items() if n}
    return Floor(
        sum(n * operations(shape) for (shape, _), n in counts.items()),
        {
            "product": 2 * PRODUCT**3 / best[None],
            "convolution": max(operations(key[0]) / best[key] for key in counts),
        },
        sum(n * best[key] for key, n in counts.items()),
    )


def convolutions(encoder: VGG, images: tuple[int, ...], layers: Iterable[str]) -> list[Shape]:
    """The convolutions of a forward pass, up to the deepest layer."""
    deepest = max(layers, key=encoder.layer_names.index)
    names = encoder.layer_names[: encoder.layer_names.index(deepest) + 1]
    found = []
    for name in names:
        out, into = encoder.convs[name].get_parameter("weight").shape[:2]
        stride = encoder.stride(name)
        found.append((images[0], into, out, images[2] // stride, images[3] // stride))
    return found


def operations(shape: Shape) -> float:
    """Floating-point operations: two per multiply-add."""
    images, into, out, height, width = shape
    return 2.0 * 9 * images * into * out * height * width


def _convolution(shape: Shape, like: torch.Tensor) -> tuple[Callable[[], object], ...]:
    images, into, out, height, width = shape

    def random(*sizes: int) -> torch.Tensor:
        values = torch.randn(*sizes, device=like.device).to(like.dtype)
        return values.to(memory_format=torch.channels_last)

    x, grad = random(images, into, height, width), random(images, out, height, width)
    weight = random(out, into, 3, 3)
    one = [1, 1]

    def ahead() -> object:
        return torch.nn.functional.conv2d(x, weight, padding=1)

    def back() -> object:
        wanted = [True, False, False]
        return torch.ops.aten.convolution_backward(
            grad, x, weight, None, one, one, one, False, [0, 0], 1, wanted
        )

    return ahead, back
