"""Covered pixels, outlines and background, put together into images."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from torch import Tensor

    from styleexp.renderers.soft_raster.raster import Visible


class Compose(torch.autograd.Function):
    """Composite intensities over a background and blend pixels across outlines.

    Takes the visible pixels' intensities (channels, winners) and indices, the background, and for n
    crossings the distances ``s`` (n), the intensities just inside the outline (channels, n), and
    the inner and outer pixels (n), or None for all four. Returns images (channels, pixels) and
    coverage (pixels).

    A pixel is blended with its neighbour by ``|s - 0.5|``. If the weights of its neighbours sum to
    more than one, they are scaled to one, so that the result stays within the range of its inputs.

    The area that an outline sweeps changes from the outer pixel's value to that at the outline. So
    the derivative by the distance uses the value at the outline, not that half a pixel inside: on
    round objects shading changes fast near the outline, and the inner pixel's value would be up to
    15 % off.
    """

    @staticmethod
    def forward(
        ctx: Any,
        intensities: Tensor,
        visible: Visible,
        background: float,
        distance: Tensor | None,
        outline: Tensor | None,
        inner: Tensor | None,
        outer: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        """Blend each pixel towards its neighbours."""
        image = intensities.new_full((len(intensities), visible.depth.numel()), background)
        for row, values in zip(image, intensities, strict=True):
            row.scatter_(0, visible.pixel, values)
        coverage = image.new_zeros(image.shape[1]).scatter_(0, visible.pixel, 1.0)
        ctx.pixel = visible.pixel
        ctx.set_materialize_grads(False)
        if distance is None or outline is None or inner is None or outer is None:
            ctx.mark_non_differentiable(coverage)
            ctx.save_for_backward()
            return image, coverage
        shrinks = distance < 0.5
        target, source = torch.where(shrinks, inner, outer), torch.where(shrinks, outer, inner)
        part = (distance - 0.5).abs_()
        total = part.new_zeros(len(coverage)).scatter_add_(0, target, part).index_select(0, target)
        scale = 1 / total.clamp_min(1)
        weight = part.mul_(scale)
        # Where weights are scaled, increasing one decreases the others.
        shared = torch.where(total > 1, 2 * shrinks.to(scale.dtype) - 1, 0.0)
        if image.device.type != "cpu":
            rows = torch.cat([image, coverage[None]])
            given = outline, target, source, outer, weight, shared, scale
            image, coverage, together = _blended(rows, *given)
            ctx.save_for_backward(target, source, weight, together)
            return image, coverage
        jumps = []
        for row, at_outline in zip(
            [*image, coverage], [*outline, torch.ones_like(weight)], strict=True
        ):
            before = row.index_select(0, target)
            jump = at_outline - row.index_select(0, outer)
            change = row.index_select(0, source).sub_(before).mul_(weight)
            if len(target):
                low, high = torch.aminmax(row)
                row.scatter_add_(0, target, change)
                # Clamp, because rounding could leave the range of the inputs.
                row.scatter_(0, target, row.index_select(0, target).clamp_(low, high))
            moved = row.index_select(0, target).sub_(before)
            jumps.append(jump.addcmul_(moved, shared).mul_(scale))
        ctx.save_for_backward(target, source, weight, *jumps)
        return image, coverage

    @staticmethod
    def backward(
        ctx: Any, to_image: Tensor | None, to_coverage: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        """Propagate to both pixels' values, and to distances by the jump in value."""
        nothing = (None,) * 4
        if not ctx.saved_tensors:
            given = None if to_image is None else to_image.index_select(1, ctx.pixel)
            return given, None, None, *nothing
        target, source, weight, *jumps = ctx.saved_tensors
        if target.device.type != "cpu":
            return *_unblended(ctx, to_image, to_coverage, *ctx.saved_tensors), None, None, None
        rows = [None] * (len(jumps) - 1) if to_image is None else list(to_image)
        to_distance = torch.zeros_like(weight)
        to_intensities = None
        if to_image is not None:
            to_intensities = to_image.new_empty(len(to_image), len(ctx.pixel))
        for i, (row, jump) in enumerate(zip([*rows, to_coverage], jumps, strict=True)):
            if row is None:
                continue
            at_target = row.index_select(0, target)
            to_distance.addcmul_(at_target, jump)
            if to_intensities is not None and i < len(rows):
                moved = at_target.mul_(weight)
                row = row.clone().scatter_add_(0, source, moved).scatter_add_(0, target, -moved)
                torch.index_select(row, 0, ctx.pixel, out=to_intensities[i])
        return to_intensities, None, None, to_distance, None, None, None


def _blended(
    rows: Float[Tensor, "channels+1 pixels"],
    outline: Float[Tensor, "channels n"],
    target: Int[Tensor, " n"],
    source: Int[Tensor, " n"],
    outer: Int[Tensor, " n"],
    weight: Float[Tensor, " n"],
    shared: Float[Tensor, " n"],
    scale: Float[Tensor, " n"],
) -> tuple[Tensor, Tensor, Float[Tensor, "channels+1 n"]]:
    """`Compose` for all channels at once, the coverage last: image, coverage, and jumps."""
    before = rows.index_select(1, target)
    jump = torch.cat([outline, torch.ones_like(outline[:1])]) - rows.index_select(1, outer)
    if len(target):
        low, high = rows.aminmax(dim=1, keepdim=True)
        rows.index_add_(1, target, rows.index_select(1, source).sub_(before).mul_(weight))
        rows.index_copy_(1, target, rows.index_select(1, target).clamp_(low, high))
    moved = rows.index_select(1, target).sub_(before)
    return rows[:-1], rows[-1].clone(), jump.addcmul_(moved, shared).mul_(scale)


def _unblended(
    ctx: Any,
    to_image: Tensor | None,
    to_coverage: Tensor | None,
    target: Tensor,
    source: Tensor,
    weight: Tensor,
    jumps: Tensor,
) -> tuple[Tensor | None, None, None, Tensor]:
    """Gradients of `_blended` for the intensities and the distances."""
    rows = [] if to_image is None else [to_image]
    rows += [] if to_coverage is None else [to_coverage[None]]
    grad = torch.cat(rows) if len(rows) > 1 else rows[0].clone()
    kept = jumps[:-1] if to_coverage is None else jumps if to_image is not None else jumps[-1:]
    at_target = grad.index_select(1, target)
    to_distance = (at_target * kept).sum(0)
    if to_image is None:
        return None, None, None, to_distance
    moved = at_target.mul_(weight)
    grad.index_add_(1, source, moved).index_add_(1, target, moved, alpha=-1)
    return grad[: len(to_image)].index_select(1, ctx.pixel), None, None, to_distance
