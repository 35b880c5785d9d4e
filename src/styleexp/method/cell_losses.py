"""Losses that compare an encoder's cells themselves, where Gram matrices compare their second
moments: sliced Wasserstein distances and nearest neighbours."""

from __future__ import annotations

import copy
from abc import abstractmethod
from typing import TYPE_CHECKING

import torch
from torch.nn import functional

from styleexp.method.losses import LayerLoss
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Self

    from jaxtyping import Bool, Float
    from torch import Tensor

    from styleexp.encoders.base import Encoder
    from styleexp.method.losses import Statistics
    from styleexp.method.options import CellLossConfig, NeighbourConfig, SlicedConfig
    from styleexp.method.viewer import Images

LEAST = 0.02
"""Least divisor of a layer's distance with ``loss.relative=source``, as a fraction of
`CellLoss.size`: a layer in which source and style hardly differ must not dominate the others."""


def sampled(
    features: Float[Tensor, "views channels rows columns"],
    mask: Bool[Tensor, "views rows columns"] | None,
    count: int,
    generator: torch.Generator,
) -> Float[Tensor, "count channels_and_one"]:
    """At most ``count`` of the masked cells of all views, as rows; differentiable in ``features``.

    The last column is 1 in a cell's row, and 0 in the rest, which are all zeros. Random positions,
    the same in every view, decide which cells are taken, so that a view has as large a share of the
    sample as of the cells, and the order of the views doesn't matter.
    """
    views, channels, rows, columns = features.shape
    rank = torch.rand(rows * columns, generator=generator).to(features.device).expand(views, -1)
    if mask is not None:
        rank = rank.masked_fill(~mask.flatten(1), 2.0)
    first = rank.flatten().topk(min(count, rank.numel()), largest=False)
    taken = first.indices[first.values < 2]
    cells = features.permute(0, 2, 3, 1).reshape(-1, channels).index_select(0, taken).float()
    return padded(torch.cat([cells, cells.new_ones(len(cells), 1)], dim=1), count)


def padded(cells: Float[Tensor, "cells columns"], count: int) -> Float[Tensor, "count columns"]:
    """Rows of zeros added up to ``count``."""
    return functional.pad(cells, (0, 0, 0, count - len(cells)))


def cells_of(
    statistic: Float[Tensor, "count channels_and_one"],
) -> Float[Tensor, "cells channels"]:
    """The features of the rows that hold a cell, which come first."""
    return statistic[: int(statistic[:, -1].sum()), :-1]


class CellLoss(LayerLoss):
    """A loss that compares sets of feature cells, layer by layer.

    A layer's statistic is a sample of its cells, (`CellLossConfig.cells`, channels + 1), as
    `sampled` draws it: pooled over all views, as Gram matrices are, so that the cells of a view
    count as the area that they cover. Comparing view by view would ask of every view of the result,
    of a few bumps perhaps, to have all that the style has. Other cells are drawn in every step.

    A layer counts for nothing where either side shows no cell. ``loss.normalisation`` has no
    effect; layers of weight zero aren't computed.
    """

    config: CellLossConfig

    def __init__(self, config: CellLossConfig, encoder: Encoder):
        super().__init__(config, encoder)
        weighted = [pair for pair in zip(self.layers, self.weights, strict=True) if pair[1] > 0]
        if not weighted:
            raise UserError(
                f"loss={config.name}: every one of loss.layers={list(config.layers)} has the "
                f"weight zero in loss.block_weights={list(config.block_weights)}."
            )
        self.layers = tuple(name for name, _ in weighted)
        self.weights = [weight for _, weight in weighted]
        self.seed = 0

    def for_step(self, generator: torch.Generator) -> Self:
        """The loss with other random numbers."""
        loss = copy.copy(self)
        loss.seed = int(torch.randint(1 << 62, (), generator=generator))
        return loss

    def _generator(self, layer: int, stream: int = 0) -> torch.Generator:
        """Random numbers of this step for the layer of this index."""
        return torch.Generator().manual_seed(self.seed + 2 * layer + stream)

    def describe(self, seen: Images) -> Statistics:
        """A sample of each layer's cells, of the foreground alone if configured."""
        features = self.encoder(seen.image.permute(0, 3, 1, 2), self.layers)
        found = [features[name] for name in self.layers]
        masks = self._masks(seen, [(each.shape[2], each.shape[3]) for each in found])
        return [
            sampled(each, mask, self.config.cells, self._generator(layer))
            for layer, (each, mask) in enumerate(zip(found, masks, strict=True))
        ]

    def pooled(self, batches: Sequence[Statistics]) -> Statistics:
        """A sample of all batches' cells, as large as that of one: its share of each batch, which
        `sampled` has in random order, from the front. The order of the batches doesn't matter."""
        found = []
        for parts in zip(*batches, strict=True):
            cells = [part[part[:, -1] > 0] for part in parts]
            total = sum(map(len, cells))
            if total > self.config.cells:
                cells = [each[: self.config.cells * len(each) // total] for each in cells]
            found.append(padded(torch.cat(cells), self.config.cells))
        return found

    @abstractmethod
    def apart(
        self,
        found: Float[Tensor, "cells channels"],
        goal: Float[Tensor, "goals channels"],
        layer: int,
    ) -> Float[Tensor, ""]:
        """Distance of a layer's cells from the style's, neither of them none; zero if equal.
        ``layer`` is the index in ``layers``."""

    @abstractmethod
    def size(self, goal: Float[Tensor, "goals channels"]) -> Tensor | float:
        """A distance that counts as large, for a layer of the style with these cells."""

    def distance(
        self, found: Statistics, target: Statistics, scales: list[Tensor]
    ) -> Float[Tensor, ""]:
        """Weighted sum over layers of `apart`, each divided by its layer's scale."""
        total = found[0].new_zeros(())
        for layer, (own, goal, weight, scale) in enumerate(
            zip(found, target, self.weights, scales, strict=True)
        ):
            cells, goals = cells_of(own), cells_of(goal)
            if len(cells) and len(goals):
                total = total + weight * self.apart(cells, goals, layer) / scale
        return total

    def scales(self, target: Statistics, source: Statistics) -> list[Tensor]:
        """The divisor of each layer's distance, infinite without cells. ``loss.relative=target``
        divides by `size`, ``source`` by the source's own distance, but at least `LEAST` sizes."""
        divisors = []
        for layer, (goal, own) in enumerate(zip(target, source, strict=True)):
            goals, cells = cells_of(goal), cells_of(own)
            scale = goal.new_ones(())
            if len(goals) == 0:
                scale = scale * torch.inf
            elif self.config.relative != "none":
                scale = scale * self.size(goals)
                if self.config.relative == "source":
                    scale = LEAST * scale
                    if len(cells):
                        scale = torch.maximum(self.apart(cells, goals, layer).detach(), scale)
            divisors.append(scale)
        return divisors


class SlicedLoss(CellLoss):
    """Sliced Wasserstein distance of the features' distributions (Heitz et al. 2021, *A Sliced
    Wasserstein Loss for Neural Texture Synthesis*)."""

    config: SlicedConfig

    def __init__(self, config: SlicedConfig, encoder: Encoder):
        super().__init__(config, encoder)

    def directions(self, channels: int, layer: int) -> Float[Tensor, "channels directions"]:
        """This step's unit vectors, uniform on the sphere."""
        generator = self._generator(layer, stream=1)
        drawn = torch.randn(channels, self.config.directions, generator=generator)
        return functional.normalize(drawn, dim=0)

    def apart(
        self,
        found: Float[Tensor, "cells channels"],
        goal: Float[Tensor, "goals channels"],
        layer: int,
    ) -> Float[Tensor, ""]:
        """Mean over directions of the squared 2-Wasserstein distance of the projections."""
        towards = self.directions(found.shape[1], layer).to(found)
        own, wanted = (found @ towards).t(), (goal @ towards).t()
        with torch.no_grad():
            order = sorting(own)
            quantiles = resampled(wanted.gather(1, sorting(wanted)), own.shape[1])
        return (own.gather(1, order) - quantiles).square().mean()

    def size(self, goal: Float[Tensor, "goals channels"]) -> Tensor | float:
        """The expected distance to features that are zero, whatever the direction."""
        return goal.square().mean()


def sorting(values: Float[Tensor, "rows columns"]) -> Tensor:
    """Indices that sort each row, as ``values.argsort(1)``, but six times as fast on a CPU."""
    if values.device.type != "cpu":
        return values.argsort(1)
    return torch.from_numpy(values.detach().contiguous().numpy().argsort(axis=1))


def resampled(ordered: Float[Tensor, "rows columns"], count: int) -> Float[Tensor, "rows count"]:
    """Rows of sorted values as ``count`` quantiles, those in the middle of ``count`` equal shares;
    linear between values. As many as there are values: the same values."""
    columns = ordered.shape[1]
    if count == columns:
        return ordered
    place = torch.arange(count, dtype=torch.float64, device=ordered.device)
    place = ((place + 0.5) * (columns / count) - 0.5).clamp(0, columns - 1)
    below = place.floor().long()
    above = (below + 1).clamp(max=columns - 1)
    return torch.lerp(ordered[:, below], ordered[:, above], (place - below).to(ordered.dtype))


class NeighbourLoss(CellLoss):
    """Cosine distance of every cell to its nearest among the style's (Kolkin et al. 2022, *Neural
    Neural Style Transfer*; Li and Wand 2016, CNNMRF, on patches), and of the style's cells to the
    nearest of the result (`NeighbourConfig.completeness`).

    Features are relative to the style's mean: cells after the ReLU all lie in one corner, at small
    angles (Mechrez et al. 2018, *The Contextual Loss*).
    """

    config: NeighbourConfig

    def __init__(self, config: NeighbourConfig, encoder: Encoder):
        super().__init__(config, encoder)

    def apart(
        self,
        found: Float[Tensor, "cells channels"],
        goal: Float[Tensor, "goals channels"],
        layer: int,
    ) -> Float[Tensor, ""]:
        """Mean of one minus the cosine to the nearest cell, from 0 to 2."""
        goal = goal.detach()
        centre = goal.mean(0)
        goal = goal - centre
        # Cells near the mean have no direction, and without a least length huge gradients.
        least = 0.01 * goal.square().sum(1).mean().sqrt() + 1e-12
        own, wanted = _directions(found - centre, least), _directions(goal, least)
        with torch.no_grad():
            near = own @ wanted.t()
            to_style = near.argmax(1)
        # Half the squared distance of unit vectors is one minus their cosine, and exactly zero for
        # equal ones.
        distance = (own - wanted[to_style]).square().sum(1).mean() / 2
        share = self.config.completeness
        if share > 0:
            with torch.no_grad():
                to_own = near.t().contiguous().argmax(1)
            back = (own.index_select(0, to_own) - wanted).square().sum(1).mean() / 2
            distance = (distance + share * back) / (1 + share)
        return distance

    def size(self, goal: Float[Tensor, "goals channels"]) -> Tensor | float:
        """The distance of directions at right angles."""
        return 1.0


def _directions(cells: Float[Tensor, "cells channels"], least: Tensor) -> Tensor:
    """Cells divided by their length, or by ``least`` if that is more."""
    length = cells.square().sum(1, keepdim=True).clamp_min(least.square()).sqrt()
    return cells / length
