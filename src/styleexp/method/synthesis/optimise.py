"""Optimise heights on a mesh to look like an exemplar everywhere: patch by patch, coarse to
fine."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
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

ROUNDS = 3
"""Rounds per level."""
COMPONENTS = 24
"""Number of principal components for comparing patches."""
MEASURED = 500
"""Number of patches used to measure a bank's noise."""
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
"""The quilt's own patch is kept while its misfit times this factor is below that of the best patch,
plus `Bank.noise`. The first applies to the first level, where seams are repaired: the quilt, with
its seams, matches itself."""
AT_ONCE = 256
"""Grids compared with the whole bank per batch, so that the distances fit a cache."""
DISORDERED = 0.18
"""`Bank.disorder` above which a level that isn't the last is skipped: 0.21 to 0.28 for terrain,
bark, grass and gravel; 0.13 to 0.15 for circles, wool and cracks, less for what is regular."""
CHOICE = 0.3
"""Number of quilt pieces to choose from, per patch of a bank."""
SIMILAR = 12
"""Number of patches, similar to the previous best one, to compare instead of the whole bank."""
TRUST = 0.6
"""A patch's vote is weighted by its misfit to the power of minus this."""


@dataclass(frozen=True)
class Bank:
    """Patches of the exemplar at one spacing."""

    patches: Float[Tensor, "patches cells"]
    mean: Float[Tensor, " cells"]
    basis: Float[Tensor, "cells components"]
    """Maps a mean-free patch to its comparison features; the centre counts more than the rim."""
    reduced: Float[Tensor, "patches components"]
    noise: float
    """Median squared distance of a patch to the one most similar to it elsewhere on the exemplar:
    how well any patch of it can be matched. Where no two are alike, as in gravel, the nearest is a
    blurred one."""

    @property
    def disorder(self) -> float:
        """`noise` relative to the mean squared distance of two patches."""
        half = len(self.reduced) // 2
        pairs = self.reduced[:half] - self.reduced[half : 2 * half]
        return self.noise / max(float(pairs.square().sum(1).mean()), 1e-20)

    @property
    def middles(self) -> Float[Tensor, " patches"]:
        """Heights at the patch centres."""
        return self.patches[:, self.patches.shape[1] // 2]

    def compared(self, patches: Float[Tensor, "... cells"]) -> Float[Tensor, "... components"]:
        """Comparison features of patches."""
        return (patches - self.mean) @ self.basis

    def nearest(self, features: Float[Tensor, "grids components"]) -> tuple[Tensor, Tensor]:
        """For each grid, the most similar patch and the squared distance to it."""
        best, least = self._search(features, 1)
        return best[:, 0], least[:, 0]

    def found(
        self, features: Float[Tensor, "grids components"], before: Int[Tensor, " grids"]
    ) -> tuple[Tensor, Tensor]:
        """`nearest` where nothing was found ``before``, which is -1 there, else `nearer`."""
        new = before < 0
        best, least = torch.empty_like(before), features.new_empty(len(before))
        best[new], least[new] = self.nearest(features[new])
        best[~new], least[~new] = self.nearer(features[~new], before[~new])
        return best, least

    def nearer(
        self, features: Float[Tensor, "grids components"], before: Int[Tensor, " grids"]
    ) -> tuple[Tensor, Tensor]:
        """Like `nearest`, among the patches similar to that found ``before``. A round changes a
        grid little, and this takes a tenth of the time."""
        known, place = before.unique(return_inverse=True)
        similar = self.similar(known)
        best, least = [], []
        for some, at in zip(features.split(16 * AT_ONCE), place.split(16 * AT_ONCE), strict=True):
            candidates = similar[at]
            away = (self.reduced[candidates] - some[:, None]).square().sum(2).min(dim=1)
            best.append(candidates.gather(1, away.indices[:, None])[:, 0])
            least.append(away.values)
        return torch.cat(best), torch.cat(least)

    def similar(self, some: Int[Tensor, " some"]) -> Int[Tensor, "some similar"]:
        """For these patches, the most similar ones, including themselves."""
        return self._search(self.reduced[some], min(SIMILAR, len(self.reduced)))[0]

    def _search(
        self, features: Float[Tensor, "grids components"], count: int
    ) -> tuple[Int[Tensor, "grids count"], Float[Tensor, "grids count"]]:
        """The ``count`` nearest patches for each query, and the squared distances."""
        own = self.reduced.square().sum(1)
        best, least = [], []
        for some in features.split(AT_ONCE):
            away = torch.addmm(own[None], some, self.reduced.T, alpha=-2)
            # A minimum is ten times as fast as the smallest few.
            found = away.min(1, True) if count == 1 else away.topk(count, 1, largest=False)
            best.append(found.indices)
            least.append((found.values + some.square().sum(1, keepdim=True)).clamp(min=0))
        return torch.cat(best), torch.cat(least)


def bank(
    patches: Float[Tensor, "patches side side"],
    centres: Float[np.ndarray, "patches axes"],
    spacing: float,
) -> Bank:
    """Build a bank from patches with these centres and sample spacing."""
    side = patches.shape[1]
    flat = patches.flatten(1)
    mean = flat.mean(0)
    weight = _gaussian(side, 0.3).sqrt()
    weighted = (flat - mean) * weight
    some = weighted[:: max(1, len(flat) // 4000)]
    directions = torch.linalg.svd(some, full_matrices=False)[2][:COMPONENTS].T
    basis = weight[:, None] * directions
    reduced = (flat - mean) @ basis
    step = max(1, len(flat) // MEASURED)
    away = torch.cdist(reduced[::step], reduced).square()
    where = torch.from_numpy(centres).float()
    away[torch.cdist(where[::step], where) < side * spacing / 2] = torch.inf
    least = away.min(dim=1).values
    seen = least[least.isfinite()]  # all of a tiny exemplar may be near
    noise = float(seen.median()) if len(seen) else 0.0
    return Bank(flat, mean, basis, reduced, noise)


def synthesise(
    sheet: Sheet,
    ahead: Float[np.ndarray, "vertices 3"],
    exemplar: Exemplar,
    spacings: list[float],
    unit: float,
    any_way: bool,
    seed: int,
    most: int = 10_000,
) -> Iterator[tuple[int, Float[Tensor, " vertices"]]]:
    """Yield the vertices' heights, in units of the pattern, after every round, with its number;
    that of the quilt, from which the first round starts, is 0.

    ``ahead`` is the direction of the pattern's up, ``spacings`` are those of a patch's samples at
    each level, from coarse to fine, in units of the pattern, ``unit`` is the length of such a unit
    on the mesh, ``most`` the maximum size of a level's bank.
    """
    doing("covering the source with pieces of the style")
    choice = round(CHOICE * most)
    laid = quilt(sheet, ahead, exemplar, spacings[0], spacings[-1], unit, any_way, seed, choice)
    height = laid.heights()
    done = 0
    yield done, height
    rng = np.random.default_rng(seed)
    for number, spacing in enumerate(spacings, 1):
        first, fine = number == 1, 1 < number == len(spacings)
        side, density = (FINE_SIDE, FINE_DENSITY) if fine else (SIDE, DENSITY)
        weight = _gaussian(side, VOTE)
        doing("taking patches of the style")
        patches, places = sampled(exemplar, most, side, spacing, (seed, number), any_way)
        known = bank(patches, exemplar.centres(places), spacing)
        if number < len(spacings) and known.disorder > DISORDERED:
            done += ROUNDS
            continue  # no patch fits its neighbours better than the quilt's
        middle = sheet.spread(density * spacing * unit, rng)
        sample = sheet.sampling(middle, ahead[middle], side, spacing * unit)
        spread = sample.T
        quilted = laid.patches(torch.from_numpy(middle), side, spacing)
        compared = known.compared(quilted)
        factor = KEEP if first else KEEP_FINE
        best = torch.full((len(middle),), -1)
        for _ in range(ROUNDS):
            features = known.compared(_apply(sample, height).view(len(middle), -1))
            own = (compared - features[:, None]).square().sum(2).min(dim=1)
            misfit, chosen = own.values, quilted[torch.arange(len(middle)), own.indices]
            # Where the quilt fits as well as anything can, there is no need to search.
            at = (factor * misfit >= known.noise).nonzero()[:, 0]
            best[at], least = known.found(features[at], best[at])
            better = factor * misfit[at] >= least + known.noise
            at, least = at[better], least[better]
            misfit[at], chosen[at] = least, known.patches[best[at]]
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
