"""Optimise heights on a mesh to look like an exemplar everywhere: patch by patch, coarse to
fine."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch

from styleexp.method.synthesis.exemplar import sampled
from styleexp.method.synthesis.quilting import quilt
from styleexp.method.synthesis.walk import Sheet
from styleexp.system.progress import doing

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from scipy.sparse import csr_matrix
    from torch import Tensor

    from styleexp.method.synthesis.exemplar import Exemplar

COMPONENTS = 24
"""Number of principal components for comparing patches."""
SAMPLES = 40_000
"""Number of exemplar heights used to estimate their distribution."""
MOST_GAIN = 1.5
"""Maximum factor on the heights to compensate for blur."""
SIDE = 9
"""Samples per patch side."""
FINE_SIDE = 7
"""Samples per patch side at the finest of several levels, which has the most patches and the fewest
ambiguities."""
DENSITY, FINE_DENSITY = 0.8, 1.3
"""Distance between patch centres, in sample spacings; the second at the finest level."""
VOTE = 0.2
"""Standard deviation of a patch's Gaussian weights, relative to its side."""
KEEP, KEEP_FINE = 4.0, 1.0
"""The quilt's own patch is kept while its misfit times this factor is below that of the best patch.
The first applies to the first level, where seams are repaired: the quilt, with its seams, matches
itself."""
AT_ONCE = 256
"""Grids compared with the whole bank per batch, so that the distances fit a cache."""
CHOICE = 0.3
"""Number of quilt pieces to choose from, per patch of a bank."""
SIMILAR = 12
"""Number of patches, similar to the previous best one, to compare instead of the whole bank."""
TRUST = 0.6
"""A patch's vote is weighted by its misfit to the power of minus this."""


@dataclass(frozen=True)
class Level:
    """One scale of the synthesis."""

    spacing: float
    """Sample spacing of a patch, in units of the pattern."""
    rounds: int


@dataclass(frozen=True)
class Bank:
    """Patches of the exemplar at one spacing."""

    patches: Float[Tensor, "patches cells"]
    mean: Float[Tensor, " cells"]
    basis: Float[Tensor, "cells components"]
    """Maps a mean-free patch to its comparison features; the centre counts more than the rim."""
    reduced: Float[Tensor, "patches components"]

    @property
    def middles(self) -> Float[Tensor, " patches"]:
        """Heights at the patch centres."""
        return self.patches[:, self.patches.shape[1] // 2]

    def nearest(self, grids: Float[Tensor, "grids cells"]) -> tuple[Tensor, Tensor]:
        """For each grid, the most similar patch and the squared distance to it."""
        best, least = self._search(self.compared(grids), 1)
        return best[:, 0], least[:, 0]

    def compared(self, patches: Float[Tensor, "... cells"]) -> Float[Tensor, "... components"]:
        """Comparison features of patches."""
        return (patches - self.mean) @ self.basis

    def nearer(
        self, grids: Float[Tensor, "grids cells"], before: Int[Tensor, " grids"]
    ) -> tuple[Tensor, Tensor]:
        """Like `nearest`, among the patches similar to that found ``before``. A round changes a
        grid little, and this takes a tenth of the time."""
        reduced = self.compared(grids)
        best, least = [], []
        for at in range(0, len(grids), 16 * AT_ONCE):
            some = slice(at, at + 16 * AT_ONCE)
            candidates = self.similar[before[some]]
            away = (self.reduced[candidates] - reduced[some, None]).square().sum(2).min(dim=1)
            best.append(candidates.gather(1, away.indices[:, None])[:, 0])
            least.append(away.values)
        return torch.cat(best), torch.cat(least)

    @cached_property
    def similar(self) -> Int[Tensor, "patches similar"]:
        """For each patch, the most similar ones, including itself."""
        return self._search(self.reduced, min(SIMILAR, len(self.reduced)))[0]

    def _search(
        self, reduced: Float[Tensor, "grids components"], count: int
    ) -> tuple[Int[Tensor, "grids count"], Float[Tensor, "grids count"]]:
        """The ``count`` nearest patches for each query, and the squared distances."""
        own = self.reduced.square().sum(1)
        best, least = [], []
        for at in range(0, len(reduced), AT_ONCE):
            some = reduced[at : at + AT_ONCE]
            away = torch.addmm(own[None], some, self.reduced.T, alpha=-2)
            # A minimum is ten times as fast as the smallest few.
            found = away.min(1, True) if count == 1 else away.topk(count, 1, largest=False)
            best.append(found.indices)
            least.append((found.values + some.square().sum(1, keepdim=True)).clamp(min=0))
        return torch.cat(best), torch.cat(least)


def bank(patches: Float[Tensor, "patches side side"]) -> Bank:
    """Build a bank from patches."""
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
    seed: int,
    most: int = 10_000,
) -> Iterator[tuple[int, Float[Tensor, " vertices"]]]:
    """Yield the vertices' heights, in units of the pattern, after every round, with its number;
    that of the quilt, from which the first round starts, is 0.

    ``ahead`` is the direction of the pattern's up, ``unit`` the length of a pattern unit on the
    mesh, ``most`` the maximum size of a level's bank.
    """
    doing("covering the source with pieces of the style")
    first, last = levels[0], levels[-1]
    choice = round(CHOICE * most)
    laid = quilt(sheet, ahead, exemplar, first.spacing, last.spacing, unit, any_way, seed, choice)
    height = laid.heights()
    done = 0
    yield done, height
    rng = np.random.default_rng(seed)
    for number, level in enumerate(levels, 1):
        fine = level is last and level is not first
        side, density = (FINE_SIDE, FINE_DENSITY) if fine else (SIDE, DENSITY)
        weight = _gaussian(side, VOTE)
        doing("taking patches of the style")
        known = bank(sampled(exemplar, most, side, level.spacing, (seed, number), any_way)[0])
        middle = sheet.spread(density * level.spacing * unit, rng)
        sample = sheet.sampling(middle, ahead[middle], side, level.spacing * unit)
        spread = sample.T
        quilted = laid.patches(torch.from_numpy(middle), side, level.spacing)
        compared = known.compared(quilted)
        best: Tensor | None = None
        for _ in range(level.rounds):
            grids = _apply(sample, height).view(len(middle), -1)
            best, misfit = known.nearest(grids) if best is None else known.nearer(grids, best)
            own = (compared - known.compared(grids)[:, None]).square().sum(2).min(dim=1)
            kept = (KEEP if level is first else KEEP_FINE) * own.values < misfit
            misfit = torch.where(kept, own.values, misfit)
            stays = quilted[torch.arange(len(middle)), own.indices]
            chosen = torch.where(kept[:, None], stays, known.patches[best])
            trust = (misfit + 0.02 * misfit.mean() + 1e-12) ** -TRUST
            say = weight * trust[:, None]
            total = _apply(spread, (chosen * say).flatten())
            asked = _apply(spread, say.flatten())
            height = torch.where(asked > 0, total / asked.clamp(min=1e-20), height)
            height = matched(height, known.middles)
            done += 1
            yield done, height
    # Averaging votes reduces the depth. (Matching the exemplar's unblurred distribution would
    # broaden its ridges, because a mesh can't represent slopes that steep.)
    own_heights = sampled(exemplar, SAMPLES, 1, 1e-6, (seed,), any_way)[0]
    gain = float(own_heights.std() / height.std().clamp(min=1e-12))
    yield done, height.mean() + min(gain, MOST_GAIN) * (height - height.mean())


def matched(
    height: Float[Tensor, " vertices"], like: Float[Tensor, " samples"]
) -> Float[Tensor, " vertices"]:
    """Histogram matching: keep the order of the heights, with another distribution. Averaging would
    flatten them, and the patches nearest to flat ones are flatter still."""
    quantiles = torch.quantile(like[:100_000], torch.linspace(0, 1, 512))
    place = torch.empty_like(height)
    place[height.argsort()] = torch.linspace(0, 511, len(height))
    low = place.floor().long().clamp(max=510)
    return quantiles[low] + (quantiles[low + 1] - quantiles[low]) * (place - low)


def _apply(matrix: csr_matrix, values: Tensor) -> Tensor:
    return torch.from_numpy(matrix @ values.numpy())


def _gaussian(side: int, width: float) -> Float[Tensor, " cells"]:
    """Gaussian weights of a patch's cells; ``width`` is the standard deviation relative to the
    side."""
    line = torch.exp(-0.5 * ((torch.arange(side) - side // 2) / (width * side)) ** 2)
    return (line[:, None] * line[None]).flatten()
