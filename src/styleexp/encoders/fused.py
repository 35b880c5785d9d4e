"""Gram matrices of a VGG's layers as a single autograd function, for CPUs with oneDNN.

Apart from convolutions, plain autograd spends most time on passes over fresh memory: masked copies,
separate gradients per layer, and their sums. Here a convolution and its ReLU are one pass, a
layer's Gram matrix is computed while its activations are in cache, and its gradient is accumulated
into that of the layers above by the same matrix product. Images go through a block in parts, so
that no array is large enough for the allocator to return it to the system and map fresh pages for
the next.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

    Mask = Bool[Tensor, "images rows columns"] | None

BITS = {torch.float32: torch.int32, torch.bfloat16: torch.int16}
"""Supported dtypes, and integer dtypes of the same size. Activations are non-negative, so they sort
like their bits, and torch is three times as fast with 16-bit integers as with bfloat16."""

PART = 16 << 20
"""Bytes of activations per part. glibc maps fresh pages for arrays above 32 MB."""
ROWS = 2048
"""Cells per partial product, which is rounded; partial products are summed in float32."""
EVEN = 256
"""Masked cells are zero-padded to a multiple of this. oneDNN caches code and memory for up to a
thousand shapes; masks with new shapes in every step filled 9 GB in a hundred steps."""

_ONE, _TWO = [1, 1], [2, 2]
_PORTION = 1 << 20
"""Bytes of activations pooled at once, so that intermediates fit the cache."""


class Layer(NamedTuple):
    """A convolution; ``back`` is the kernel of its input gradient."""

    name: str
    weight: Float[Tensor, "out in 3 3"]
    bias: Float[Tensor, " out"]
    back: Float[Tensor, "in out 3 3"]


@dataclass
class _Part:
    """Saved state of the backward pass, for some images in a block."""

    images: slice
    activations: list[Tensor] = field(default_factory=list)
    ahead: Tensor | None = None
    """For max-pooling: by how much the second of each two cells exceeds the first; see `_pool`."""


class GramSums(torch.autograd.Function):
    """F^T F per layer, summed over images and masked cells, in the order of ``masks``.

    Takes normalised images (channels last), the layers grouped by block, a mask or None for each
    requested layer, and ``max`` or ``avg``. The last layer must be a requested one.
    """

    @staticmethod
    def forward(
        ctx: Any,
        images: Tensor,
        blocks: Sequence[Sequence[Layer]],
        masks: Mapping[str, Mask],
        pooling: str,
    ) -> tuple[Tensor, ...]:
        """Process blocks in order, and each block part by part."""
        sums: dict[str, list[Tensor]] = {name: [] for name in masks}
        ctx.kept, ctx.given = [], (blocks, masks, pooling)
        x = images
        for block in blocks:
            parts, pooled = [], []
            for now, part in _split(x, len(block[0].bias)):
                parts.append(_Part(now))
                for layer in block:
                    part = _convolve(part, layer.weight, layer.bias, "relu")
                    if layer.name in masks:
                        sums[layer.name].append(gram(part, _at(masks[layer.name], now)))
                    if ctx.needs_input_grad[0]:
                        parts[-1].activations.append(part)
                if block is not blocks[-1]:
                    part, parts[-1].ahead = _pool(part, pooling)
                    pooled.append(part)
            x = torch.cat(pooled) if pooled else part
            if ctx.needs_input_grad[0]:
                ctx.kept.append((parts, x))
        return tuple(torch.stack(found).sum(0) for found in sums.values())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        """Frees activations on the way, so it can only run once."""
        if not ctx.kept:
            raise RuntimeError("the encoder frees its activations: backward can only run once")
        blocks, masks, pooling = ctx.given
        factors = {name: grad + grad.t() for name, grad in zip(masks, grads, strict=True)}
        grad: Tensor | None = None
        for block in reversed(blocks):
            parts, pooled = ctx.kept.pop()
            is_off = pooling == "max" and block[-1].name not in masks
            if grad is not None and is_off:
                # Zero after max-pooling implies zero before it, where there are four times as many
                # cells.
                zero_where_zero(grad, pooled)
            del pooled
            into = []
            while parts:
                part = parts.pop(0)
                last = part.activations[-1]
                if grad is None:
                    here = torch.zeros_like(last)
                else:
                    here = _unpool(grad[part.images], last, part.ahead, pooling)
                for layer in reversed(block):
                    activation = part.activations.pop()
                    if layer.name in masks:
                        mask = _at(masks[layer.name], part.images)
                        add_gram_gradient(here, activation, mask, factors[layer.name])
                    if layer is not block[-1] or not is_off:
                        zero_where_zero(here, activation)
                    here = _convolve(here, layer.back, None, "none")
                into.append(here)
            grad = torch.cat(into)
        return grad, None, None, None


def gram(activation: Tensor, mask: Mask) -> Float[Tensor, "channels channels"]:
    """F^T F over masked cells, summed in float32 every ``ROWS`` cells, which keeps the rounding
    error of bfloat16 below 0.2 %."""
    cells = activation.permute(0, 2, 3, 1).flatten(0, 2)
    if mask is not None:
        seen = mask.flatten().nonzero().view(-1)
        count = len(seen)
        cells = cells.index_select(0, functional.pad(seen, (0, -count % EVEN)))
        cells[count:] = 0
    total = torch.zeros(cells.shape[1], cells.shape[1])
    for some in cells.split(ROWS):
        total += some.t() @ some
    return total


def add_gram_gradient(grad: Tensor, activation: Tensor, mask: Mask, factor: Tensor) -> None:
    """Add F (D + D^T), 0 outside the mask, to the gradient in place."""
    cells = activation.permute(0, 2, 3, 1)
    if mask is not None:
        bits = BITS[activation.dtype]
        # Same dtype: converting booleans on the fly takes longer than the product.
        cells = (cells.view(bits) * mask.to(bits)[..., None]).view(activation.dtype)
    rows = grad.permute(0, 2, 3, 1).flatten(0, 2)
    rows.addmm_(cells.flatten(0, 2), factor.to(activation.dtype))


def zero_where_zero(grad: Tensor, activation: Tensor) -> None:
    """Set the gradient to 0 where the ReLU output is 0, in place."""
    bits = BITS[activation.dtype]
    out = grad.view(bits)
    torch.ops.aten.threshold_backward.grad_input(out, activation.view(bits), 0, grad_input=out)


def _split(x: Tensor, channels: int) -> Iterator[tuple[slice, Tensor]]:
    """Yield chunks of images whose activations, with this many channels, take about ``PART``
    bytes."""
    size = channels * x.shape[2] * x.shape[3] * x.element_size()
    step = max(1, PART // size)
    for start in range(0, len(x), step):
        now = slice(start, start + step)
        yield now, x[now]


def _pool(x: Tensor, pooling: str) -> tuple[Tensor, Tensor | None]:
    """2x2 pooling. For ``max``, also return what `_unpool` needs, a sixth of the size of torch's
    indices."""
    if pooling == "avg":
        return functional.avg_pool2d(x, 2), None
    bits = x.permute(0, 2, 3, 1).view(BITS[x.dtype])
    images, height, width, channels = bits.shape
    shape = (images, height // 2, width // 2, channels)
    out, ahead = bits.new_empty(shape), bits.new_empty(3, *shape)
    for here, (a, b, c, d) in _quarters(bits):
        upper, lower = torch.maximum(a, b), torch.maximum(c, d)
        torch.maximum(upper, lower, out=out[here])
        for i, (first, second) in enumerate(((a, b), (c, d), (upper, lower))):
            torch.sub(second, first, out=ahead[i][here])
    return out.view(x.dtype).permute(0, 3, 1, 2), ahead


def _unpool(grad: Tensor, x: Tensor, ahead: Tensor | None, pooling: str) -> Tensor:
    """Gradient of ``_pool``; ties go to the first cell."""
    if ahead is None:
        return torch.ops.aten.avg_pool2d_backward(grad, x, _TWO, _TWO, [0, 0], False, True, None)
    towards = grad.permute(0, 2, 3, 1).contiguous().view(BITS[x.dtype])
    out = torch.empty_like(x, memory_format=torch.channels_last)
    bits = out.permute(0, 2, 3, 1).view(BITS[x.dtype])
    bits[:, towards.shape[1] * 2 :] = 0
    bits[:, :, towards.shape[2] * 2 :] = 0
    below = torch.ops.aten.threshold_backward
    for here, (a, b, c, d) in _quarters(bits):
        lower = below(towards[here], ahead[2][here], 0)
        upper = towards[here] ^ lower
        for both, first, second, i in ((upper, a, b, 0), (lower, c, d, 1)):
            second.copy_(below(both, ahead[i][here], 0))
            torch.bitwise_xor(both, second, out=first)
    return out


def _quarters(cells: Tensor) -> Iterator[tuple[tuple[int, slice], tuple[Tensor, ...]]]:
    """Yield portions of (images, rows, columns, channels) that fit the cache: the index into the
    pooled array, and the four cells of each 2x2 block."""
    images, height, width, channels = cells.shape
    rows = max(1, _PORTION // (2 * width * channels * cells.element_size()))
    for image in range(images):
        for begin in range(0, height // 2, rows):
            end = min(begin + rows, height // 2)
            some = cells[image, 2 * begin : 2 * end, : width // 2 * 2]
            upper, lower = some[::2], some[1::2]
            yield (
                (image, slice(begin, end)),
                (upper[:, ::2], upper[:, 1::2], lower[:, ::2], lower[:, 1::2]),
            )


def _at(mask: Mask, images: slice) -> Mask:
    return None if mask is None else mask[images]


def _convolve(x: Tensor, weight: Tensor, bias: Tensor | None, then: str) -> Tensor:
    """A 3x3 convolution with padding 1, fused with ``then``: ``relu`` or ``none``."""
    convolution = torch.ops.mkldnn._convolution_pointwise
    return convolution(x, weight, bias, _ONE, _ONE, _ONE, 1, then, [], "")
