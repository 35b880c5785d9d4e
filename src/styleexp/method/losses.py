"""Gram matrices and the style loss (Sec. 3.3.2 and 3.3.3, Eqs. 3-8), and Text2Mesh's loss for
comparison."""

from __future__ import annotations

import copy
import functools
import math
import re
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch.autograd.function import once_differentiable
from torch.nn import functional

from styleexp.encoders.vgg import VGG
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from typing import Self

    from jaxtyping import Bool, Float
    from torch import Tensor

    from styleexp.encoders.base import Encoder
    from styleexp.inputs.style import Style
    from styleexp.method.options import LossConfig
    from styleexp.method.viewer import Images

Statistics = list["Tensor"]
"""What a loss compares of a set of views, averaged over them: for `GramLoss` one matrix per style
layer. Any number of tensors of any shapes, always the same for one loss."""


class Loss(ABC):
    """The contract of a loss: it describes views, and measures how far descriptions are apart.
    `testing.check_loss` checks all of this.

    The loop describes global and local views of the generated mesh in every step, and those of the
    style once or in every step (``loss.target``). What is minimised is ``lambda_global`` times the
    distance of the global views plus ``lambda_local`` times that of the local ones (Eq. 7); the
    loop reads these weights itself.
    """

    masked: bool = False
    """Whether only pixels that show the mesh count, so that views without it are skipped."""

    def for_style(self, style: Style) -> Loss:
        """The loss to use for this style; called once, before anything is described."""
        return self

    def for_step(self, generator: torch.Generator) -> Loss:
        """The loss to use in one step, for losses with random parts: what they draw comes from
        ``generator``, which depends on the run's seed and the step alone, so that a resumed run
        draws the same. Called in every step, and once for the style's bank of views."""
        return self

    @abstractmethod
    def describe(self, seen: Images) -> Statistics:
        """Statistics of views, averaged over them; differentiable in ``seen.image``, of shape
        (views, height, width, channels).

        A statistic for which no cell counts, such as a masked one without foreground
        (``seen.coverage``), is all zeros, never NaN. A bank of views is described in several calls,
        whose statistics `pooled` makes one.
        """

    def pooled(self, batches: Sequence[Statistics]) -> Statistics:
        """One description of several batches of views that count equally. The default is the mean
        of each statistic."""
        return [torch.stack(layer).mean(0) for layer in zip(*batches, strict=True)]

    @abstractmethod
    def distance(
        self, found: Statistics, target: Statistics, scales: list[Tensor]
    ) -> Float[Tensor, ""]:
        """How far the generated mesh's statistics are from the style's; zero if they are equal.
        ``scales`` are those that `scales` returned."""

    def scales(self, target: Statistics, source: Statistics) -> list[Tensor]:
        """A divisor for each statistic's part of the distance, from the style's statistics and
        those of the source; called once each for global and for local views. Infinite for a
        statistic of the style that is all zeros. The default doesn't scale."""
        return [torch.where(each.any(), 1.0, torch.inf) for each in target]


UNDIVIDED = 1e6
"""Common divisor of all Gram matrices with ``loss.normalisation=none``: it changes no ratio, and
keeps the squares of gradients within float32."""


def gram_matrix(
    features: Float[Tensor, "views channels height width"],
    mask: Bool[Tensor, "views height width"] | None = None,
    normalisation: str = "channels_cells",
) -> Float[Tensor, "channels channels"]:
    """G = F^T F over all views, normalised as in ``LossConfig.normalisation``.

    The paper's Eqs. 3-6 sum over views and add matrices of different layers; here this is read as
    one Gram per layer, averaged over views. With a mask, only masked cells are summed and counted,
    so the result doesn't depend on how much of the frame the object fills. An empty mask gives
    zeros.
    """
    cells = features[:, 0].numel()
    return mean_gram(_Gram.apply(features, mask), mask, cells, normalisation)


def mean_gram(
    total: Float[Tensor, "channels channels"],
    mask: Bool[Tensor, "views height width"] | None,
    cells: int,
    normalisation: str = "channels_cells",
) -> Float[Tensor, "channels channels"]:
    """Normalise a sum of F^T F over the masked cells, as in ``LossConfig.normalisation``."""
    if normalisation == "none":
        return total / UNDIVIDED
    count = cells if mask is None else mask.sum().clamp(min=1)
    # Dividing by C before squaring turns the sum of C x C squares into their mean.
    channels = {"cells": 1, "channels_cells": len(total), "mean": len(total) ** 2}[normalisation]
    return total / (channels * count)


class _Gram(torch.autograd.Function):
    """Sum over views and masked cells. Its gradient F (D + D^T) takes one product; plain autograd,
    unaware that both factors are equal, takes two and a masking."""

    @staticmethod
    def forward(ctx, features, mask):
        views, channels, height, width = features.shape
        cells = features.permute(0, 2, 3, 1).reshape(views, height * width, channels)
        if mask is not None:
            cells = cells * mask.reshape(views, height * width, 1)
        ctx.save_for_backward(cells)
        ctx.cells = (height, width)
        # Sum views in float32 (or better) to keep the rounding error small with bfloat16 features.
        per_view = torch.bmm(cells.transpose(1, 2), cells)
        return per_view.sum(0, dtype=torch.promote_types(per_view.dtype, torch.float32))

    @staticmethod
    @once_differentiable
    def backward(ctx, grad):
        (cells,) = ctx.saved_tensors
        views, _, channels = cells.shape
        both = (grad + grad.t()).to(cells.dtype)
        flat = cells.reshape(-1, channels) @ both  # masked cells are zero, and so is their gradient
        return flat.view(views, *ctx.cells, channels).permute(0, 3, 1, 2), None


def layer_mask(
    coverage: Float[Tensor, "views height width"], shape: tuple[int, int], erosion: int
) -> Bool[Tensor, "views cells_y cells_x"]:
    """Cells of a layer that see only foreground: fully covered, and ``erosion`` cells from the
    nearest cell that isn't. The frame's border doesn't erode."""
    return layer_masks(coverage, [shape], erosion)[0]


def layer_masks(
    coverage: Float[Tensor, "views height width"], shapes: Sequence[tuple[int, int]], erosion: int
) -> list[Bool[Tensor, "views cells_y cells_x"]]:
    """`layer_mask` for several layers, from one summed-area table of uncovered pixels: a cell and
    its neighbours form one rectangle of pixels."""
    background = ~(1 - coverage.detach() < 0.5)
    summed = functional.pad(background, (1, 0, 1, 0)).to(torch.int32)
    for dim in (1, 2):
        summed = summed.cumsum(dim, dtype=torch.int32)
    rows_of_all, columns_of_all = zip(*shapes, strict=True)
    rows = _between(summed, 1, rows_of_all, erosion)
    if coverage.device.type != "cpu":  # every layer's rows and columns: more work, fewer kernels
        free = (_between(rows, 2, columns_of_all, erosion) == 0).split(rows_of_all, 1)
        return [some.split(columns_of_all, 2)[i] for i, some in enumerate(free)]
    return [
        _between(some, 2, (columns,), erosion) == 0
        for some, columns in zip(rows.split(rows_of_all, 1), columns_of_all, strict=True)
    ]


def _between(summed: Tensor, dim: int, cells: tuple[int, ...], erosion: int) -> Tensor:
    """Sums over each cell and its neighbours along a dimension of a summed-area table, for layers
    of so many cells, one after the other."""
    begin, end = _bounds(summed.shape[dim] - 1, cells, erosion, summed.device)
    return summed.index_select(dim, end) - summed.index_select(dim, begin)


@functools.cache  # small, always the same, and a dozen kernels each
def _bounds(
    size: int, cells: tuple[int, ...], erosion: int, device: torch.device
) -> tuple[Tensor, Tensor]:
    """First pixel of each cell's neighbourhood, and the one after its last."""
    bounds = []
    for count in cells:
        cell = torch.arange(count)
        first, last = (cell - erosion).clamp_min(0), (cell + erosion).clamp_max(count - 1)
        # Sizes that don't divide evenly: a cell covers all pixels it touches.
        begin, end = first * size // count, ((last + 1) * size + count - 1) // count
        bounds.append(torch.stack([begin, end]))
    begin, end = torch.cat(bounds, 1).to(device, non_blocking=True)
    return begin, end


class LayerLoss(Loss):
    """A loss of an encoder's layers, weighted by their block and masked as configured."""

    def __init__(self, config: LossConfig, encoder: Encoder):
        self.config = config
        self.masked = config.masked not in (False, "pictures")
        self.encoder = encoder
        self.layers = encoder.resolve(config.layers)
        self.weights = [
            config.block_weights[block_of(name, config.name) - 1] for name in self.layers
        ]

    def for_style(self, style: Style) -> Self:
        """Decide ``loss.masked=pictures`` for this style."""
        if self.config.masked != "pictures":
            return self
        loss = copy.copy(self)
        loss.masked = style.picture is not None
        return loss

    def _masks(
        self, seen: Images, cells: Sequence[tuple[int, int]]
    ) -> Sequence[Bool[Tensor, "n rows columns"] | None]:
        """Masks of the cells that count, for layers of these sizes."""
        if not self.masked:
            return [None] * len(cells)
        return layer_masks(seen.coverage, cells, self.config.erosion)


class GramLoss(LayerLoss):
    """Distances of the Gram matrices of an encoder's layers (Eqs. 3-8), one per style layer."""

    def describe(self, seen: Images) -> Statistics:
        """One Gram per style layer, over the foreground only if configured."""
        images = seen.image.permute(0, 3, 1, 2)
        # A subclass may use activations other than those that the fused path sums.
        if type(self.encoder) is VGG and self.encoder.is_fused:
            cells = [
                (images.shape[2] // stride, images.shape[3] // stride)
                for stride in map(self.encoder.stride, self.layers)
            ]
            by_name = dict(zip(self.layers, self._masks(seen, cells), strict=True))
            sums = self.encoder.gram_sums(images, by_name)
            return [
                mean_gram(
                    sums[name],
                    by_name[name],
                    len(images) * math.prod(shape),
                    self.config.normalisation,
                )
                for name, shape in zip(self.layers, cells, strict=True)
            ]
        features = self.encoder(images, self.layers)
        found = [features[name] for name in self.layers]
        masks = self._masks(seen, [(each.shape[2], each.shape[3]) for each in found])
        how = self.config.normalisation
        return [gram_matrix(each, mask, how) for each, mask in zip(found, masks, strict=True)]

    def distance(
        self, found: Statistics, target: Statistics, scales: list[Tensor]
    ) -> Float[Tensor, ""]:
        """Weighted sum over layers of the squared Frobenius distances (Eq. 8), each divided by its
        layer's scale."""
        if found[0].device.type != "cpu":  # all layers at once, in a tenth of the kernels
            ours, theirs = (
                torch.cat([gram.flatten() for gram in each]) for each in (found, target)
            )
            weights = torch.tensor(self.weights).to(ours.device, non_blocking=True)
            factors = (weights / torch.stack(scales)).unbind()
            pairs = zip(factors, found, strict=True)
            each = torch.cat([factor.expand(gram.numel()) for factor, gram in pairs])
            return ((ours - theirs).square() * each).sum()
        total = found[0].new_zeros(())
        for gram, goal, weight, scale in zip(found, target, self.weights, scales, strict=True):
            total = total + weight * (gram - goal).square().sum() / scale
        return total

    def scales(self, target: Statistics, source: Statistics) -> list[Tensor]:
        """The divisor of each layer's distance: see ``LossConfig.relative``.

        Infinite, which disables the layer, if the target is empty because no cell at that
        resolution sees only foreground.
        """
        divisors = []
        for goal, own in zip(target, source, strict=True):
            norm = goal.square().sum()
            if self.config.relative == "none":
                scale = torch.ones_like(norm)
            elif self.config.relative == "target":
                scale = norm
            else:
                # A layer in which source and style hardly differ must not dominate the others.
                scale = torch.maximum((own - goal).square().sum(), 0.02 * norm)
            divisors.append(torch.where(norm > 0, scale, torch.inf))
        return divisors


def block_of(layer: str, loss: str = "gram") -> int:
    """VGG block of a layer named ``convB_I``, 1 to 5. Raises `UserError` for another name."""
    match = re.match(r"conv([1-5])_", layer)
    if match is None:
        raise UserError(
            f"loss={loss} weighs layers by their block: name them convB_I with B from 1 to 5, "
            f"not '{layer}'."
        )
    return int(match[1])


class ClipLoss(Loss):
    """Text2Mesh's loss (Michel et al. 2022): one minus the cosine between two mean embeddings."""

    def __init__(self, encoder: Encoder):
        from styleexp.encoders.clip import ClipEncoder

        if not isinstance(encoder, ClipEncoder):
            raise UserError("loss=clip compares embeddings of whole pictures: use encoder=clip.")
        self.clip = encoder

    def describe(self, seen: Images) -> Statistics:
        """The mean embedding of the pictures, background included."""
        return [self.clip.embed(seen.image.permute(0, 3, 1, 2)).mean(0)]

    def distance(
        self, found: Statistics, target: Statistics, scales: list[Tensor]
    ) -> Float[Tensor, ""]:
        """One minus the cosine, from 0 (same direction) to 2 (opposite)."""
        return 1 - functional.cosine_similarity(found[0], target[0], dim=0)
