"""Heights on a mesh that look like an exemplar's everywhere: patch by patch, coarse to fine."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from styleexp.synthesis.walk import Sheet

if TYPE_CHECKING:
    from jaxtyping import Float
    from scipy.sparse import csr_matrix
    from torch import Tensor

    from styleexp.synthesis.exemplar import Exemplar

COMPONENTS = 24
"""Principal components by which patches are compared."""
SAMPLES = 40_000
"""Of the exemplar's heights, for their deviation."""
MOST_GAIN = 1.5
"""Of the heights, against what blur took of them."""
AT_ONCE = 256
"""Grids that are compared with the whole bank at once: the distances then fit a cache."""
TRUST = 0.6
"""A patch's vote counts by its misfit to the power of minus this."""


@dataclass(frozen=True)
class Level:
    """One scale of the synthesis."""

    spacing: float
    """Of a patch's samples, in units of the pattern."""
    rounds: int
    share: float
    """Of the vertices that are the middle of a grid: a coarse level needs fewer."""


@dataclass(frozen=True)
class Bank:
    """Patches of the exemplar at one spacing."""

    patches: Float[Tensor, "patches cells"]
    mean: Float[Tensor, " cells"]
    basis: Float[Tensor, "cells components"]
    """Takes a patch less the mean to what is compared, its middle counting more than its rim."""
    reduced: Float[Tensor, "patches components"]

    @property
    def middles(self) -> Float[Tensor, " patches"]:
        """Heights in the middle of the patches."""
        return self.patches[:, self.patches.shape[1] // 2]

    def nearest(self, grids: Float[Tensor, "grids cells"]) -> tuple[Tensor, Tensor]:
        """For each grid the most similar patch, and the squared distance to it."""
        reduced = (grids - self.mean) @ self.basis
        own = self.reduced.square().sum(1)
        best, least = [], []
        for at in range(0, len(grids), AT_ONCE):
            some = reduced[at : at + AT_ONCE]
            found = torch.addmm(own[None], some, self.reduced.T, alpha=-2).min(dim=1)
            best.append(found.indices)
            least.append((found.values + some.square().sum(1)).clamp(min=0))
        return torch.cat(best), torch.cat(least)


def bank(patches: Float[Tensor, "patches side side"]) -> Bank:
    """A bank of these patches."""
    side = patches.shape[1]
    flat = patches.flatten(1)
    mean = flat.mean(0)
    weight = _gaussian(side, 0.3).sqrt()
    weighted = (flat - mean) * weight
    some = weighted[:: max(1, len(flat) // 4000)]
    directions = torch.linalg.svd(some, full_matrices=False)[2][:COMPONENTS].T
    basis = weight[:, None] * directions
    return Bank(flat, mean, basis, (flat - mean) @ basis)


def synthesise(
    sheet: Sheet,
    ahead: Float[np.ndarray, "vertices 3"],
    exemplar: Exemplar,
    levels: list[Level],
    unit: float,
    any_way: bool,
    rng: np.random.Generator,
    side: int = 9,
    most: int = 10_000,
    vote: float = 0.2,
) -> Iterator[tuple[int, Float[Tensor, " vertices"]]]:
    """Heights of the vertices, in units of the pattern, after every round, with its number.

    ``ahead`` is which way the pattern's up points, ``unit`` the length of such a unit on the mesh.
    """
    count = len(sheet.vertices)
    weight = _gaussian(side, vote)
    height: Tensor | None = None
    done = 0
    for level in levels:
        known = bank(exemplar.patches(most, side, level.spacing, rng, any_way))
        middle = np.sort(rng.permutation(count)[: round(level.share * count)])
        points, nears = sheet.grids(middle, ahead[middle], side, level.spacing * unit)
        sample = sheet.interpolation(points.reshape(-1, 3), nears.ravel())
        spread = sample.T.tocsr()
        if height is None:
            height = known.middles[torch.from_numpy(rng.integers(0, len(known.patches), count))]
        for _ in range(level.rounds):
            grids = _apply(sample, height).view(len(middle), -1)
            best, misfit = known.nearest(grids)
            trust = (misfit + 0.02 * misfit.mean() + 1e-12) ** -TRUST
            say = weight * trust[:, None]
            total = _apply(spread, (known.patches[best] * say).flatten())
            asked = _apply(spread, say.flatten())
            height = torch.where(asked > 0, total / asked.clamp(min=1e-20), height)
            height = matched(height, known.middles)
            done += 1
            yield done, height
    assert height is not None
    # A vote is a mean, and a patch is blurred to its level: some of each vertex's own best patch
    # gives edges back, and a gain the depth. (The exemplar's own distribution, unblurred, would
    # broaden its ridges: a mesh can't hold slopes as steep.)
    height = 0.7 * height + 0.3 * known.middles[best]
    own = exemplar.patches(SAMPLES, 1, 1e-6, rng, any_way)
    gain = float(own.std() / height.std().clamp(min=1e-12))
    yield done, height.mean() + min(gain, MOST_GAIN) * (height - height.mean())


def matched(
    height: Float[Tensor, " vertices"], like: Float[Tensor, " samples"]
) -> Float[Tensor, " vertices"]:
    """The heights in their order, with the distribution of others: averaging would flatten them,
    and the patch nearest to flat ones is flatter still."""
    quantiles = torch.quantile(like[:100_000], torch.linspace(0, 1, 512))
    place = torch.empty_like(height)
    place[height.argsort()] = torch.linspace(0, 511, len(height))
    low = place.floor().long().clamp(max=510)
    return quantiles[low] + (quantiles[low + 1] - quantiles[low]) * (place - low)


def _apply(matrix: csr_matrix, values: Tensor) -> Tensor:
    return torch.from_numpy(matrix @ values.numpy())


def _gaussian(side: int, width: float) -> Float[Tensor, " cells"]:
    """Weights of a patch's cells; ``width`` is the standard deviation over the side."""
    line = torch.exp(-0.5 * ((torch.arange(side) - side // 2) / (width * side)) ** 2)
    return (line[:, None] * line[None]).flatten()
