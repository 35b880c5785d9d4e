"""Which parts of a result carry the style's pattern, in the pattern's own frame.

Square patches of a few wavelengths are taken by walking over the surface, those of the style in any
rotation, so that neither the surface's shape nor the direction of the pattern matters. A patch is
known by its slopes, scaled to length 1, so that neither its height nor a slow bend matters, and is
as like the style as its nearest patch of the style. Two scales make that a number: 1 is as near as
other patches of the style are to these, 0 is as near as noise of the style's spectrum.

Chosen on one half of the rated results, and tested on the other: see docs/metrics.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.spatial.distance import cdist

from styleexp.inputs import measured
from styleexp.method.relief import smoother
from styleexp.method.synthesis.direction import frames, turned
from styleexp.method.synthesis.exemplar import measure
from styleexp.method.synthesis.walk import Sheet

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
    from torch import Tensor

    from styleexp.method.patches import Relief
    from styleexp.method.synthesis.exemplar import Exemplar

PER_WAVE = 10
"""Samples per wavelength of the style."""
SIDE = 15
"""Samples per side of a patch: one and a half wavelengths."""
BANK, HELD_OUT, POINTS = 5000, 500, 400
"""Patches of the style to compare with, others to measure its own likeness, patches of a result."""
LEAST_APART = 0.03
"""Lower bound of the difference between the style's own likeness and that of noise."""
CARRIED = 0.5
"""How much of the style a point must carry to count as covered."""
REPEATS = 0.3
"""Difference of the style's own likeness from that of noise above which it counts as ordered."""
BEND = 3.0
"""Wavelengths above which undulations count as shape."""


@dataclass(frozen=True)
class Bank:
    """A style's patches."""

    slopes: Float[Tensor, "patches features"]
    """Slopes of each patch, as a unit vector."""
    wavelength: float
    """In units of the pattern."""
    own: float
    """Cosine between a patch of the style and the nearest that doesn't overlap it; median."""
    chance: float
    """The same for noise with the style's spectrum."""
    height: float
    """RMS height of a patch in units of the pattern; median."""

    @property
    def spacing(self) -> float:
        """Distance of samples, in units of the pattern."""
        return self.wavelength / PER_WAVE

    @property
    def order(self) -> float:
        """How far the style's patches repeat: 0 as little as noise, as gravel does; 1 as bubbles
        do. Without order, likeness means little."""
        return min(max((self.own - self.chance) / REPEATS, 0.0), 1.0)


@dataclass(frozen=True)
class Likeness:
    """Likeness at points spread over a result, each of the same share of its area."""

    points: Float[np.ndarray, "points 3"]
    alike: Float[np.ndarray, " points"]
    """1 is as like the style as the style's other patches, 0 as noise; clipped."""
    height: Float[np.ndarray, " points"]
    """RMS height around the point, relative to the style's."""

    @property
    def carried(self) -> Float[np.ndarray, " points"]:
        """How much of the style each point carries, 0 to 1: likeness, times the fourth root of the
        height where that is below the style's, since raters mind a low pattern little."""
        return self.alike * self.height.clip(0, 1) ** 0.25

    @property
    def coverage(self) -> float:
        """Share of the surface that carries at least half of the style."""
        return float((self.carried >= CARRIED).mean())

    def by_region(self) -> dict[str, float]:
        """The coverage of the third of the surface that is farthest out (limbs, head, tail), and
        of the thirds at the top, the bottom (Y), the front and the back (Z)."""
        outward = np.linalg.norm(self.points - self.points.mean(axis=0), axis=1)
        _, y, z = self.points.T
        along = {"outer": outward, "top": y, "bottom": -y, "front": z, "back": -z}
        return {
            name: float((self.carried[values >= np.quantile(values, 2 / 3)] >= CARRIED).mean())
            for name, values in along.items()
        }


def bank_of(exemplar: Exemplar) -> Bank:
    """The patches of a style, and how like each other and noise they are."""
    found = measured.kept("bank", exemplar.arrays(), "", lambda: _measured(exemplar))
    wavelength, own, chance, height = map(float, found["numbers"])
    return Bank(torch.from_numpy(found["slopes"]), wavelength, own, chance, height)


def _measured(exemplar: Exemplar) -> measured.Arrays:
    rng = np.random.default_rng(0)
    wavelength = measure(exemplar, rng).wavelength
    spacing = wavelength / PER_WAVE
    patches, places = exemplar.sample(BANK, SIDE, spacing, rng, any_way=True)
    others, held_out = exemplar.sample(
        HELD_OUT, SIDE, spacing, np.random.default_rng(5), any_way=True
    )
    bank = unit_slopes(patches)
    apart = cdist(exemplar.centres(held_out), exemplar.centres(places)) > SIDE * spacing
    numbers = (
        wavelength,
        float(nearest(unit_slopes(others), bank, torch.from_numpy(apart)).median()),
        float(nearest(unit_slopes(like_noise(others)), bank).median()),
        float(others.std(dim=(1, 2)).median()),
    )
    return {"slopes": bank.numpy(), "numbers": np.array(numbers)}


def likeness(
    bank: Bank,
    relief: Relief,
    unit: float,
    seed: int = 0,
    mask: Float[np.ndarray, " vertices"] | None = None,
) -> Likeness:
    """Compare a result's relief, whose pattern has the size ``unit``, with the style's patches: on
    all of its surface, or where ``mask``, 0 to 1, asked for relief.

    Undulations of its height longer than `BEND` wavelengths are ignored.
    """
    sheet = Sheet(relief.base, relief.faces)
    wavelength = bank.wavelength * unit
    height = relief.height - smoother(relief.base, relief.faces, BEND * wavelength)(relief.height)
    patches, start = sample(sheet, height / unit, bank.spacing * unit, seed, mask)
    near = nearest(unit_slopes(patches), bank.slopes)
    alike = (near - bank.chance) / max(bank.own - bank.chance, LEAST_APART)
    high = patches.std(dim=(1, 2)) / max(bank.height, 1e-12)
    return Likeness(sheet.vertices[start], alike.clamp(0, 1).numpy(), high.numpy())


def sample(
    sheet: Sheet,
    height: Float[np.ndarray, " vertices"],
    spacing: float,
    seed: int,
    mask: Float[np.ndarray, " vertices"] | None = None,
) -> tuple[Float[Tensor, "points side side"], np.ndarray]:
    """Patches around vertices drawn in proportion to their area, where the mask is above a half, in
    random directions, blurred to the spacing; and these vertices."""
    rng = np.random.default_rng(seed)
    share = sheet.areas if mask is None else sheet.areas * (mask > 0.5)
    start = rng.choice(len(sheet.vertices), POINTS, p=share / share.sum())
    normals = sheet.normals[start]
    ahead = turned(frames(normals)[0], normals, rng.uniform(0, 2 * np.pi, POINTS))
    points, nears, _ = sheet.grids(start, ahead, SIDE, spacing)
    if spacing > 1.5 * sheet.edge:
        height = smoother(sheet.vertices, sheet.faces, 2 * spacing)(height)
    weights = sheet.interpolation(points.reshape(-1, 3), nears.ravel())
    sampled = torch.from_numpy(weights @ height.astype(np.float32))
    return sampled.float().view(-1, SIDE, SIDE), start


def unit_slopes(patches: Float[Tensor, "n side side"]) -> Float[Tensor, "n features"]:
    """Differences to the next row and column, as one unit vector per patch."""
    corner = patches[:, :-1, :-1]
    slopes = torch.stack([patches[:, 1:, :-1] - corner, patches[:, :-1, 1:] - corner], dim=1)
    flat = slopes.flatten(1)
    return flat / flat.norm(dim=1, keepdim=True).clamp(min=1e-9)


def nearest(
    slopes: Float[Tensor, "n features"],
    bank: Float[Tensor, "patches features"],
    among: Bool[Tensor, "n patches"] | None = None,
) -> Float[Tensor, " n"]:
    """Cosine between each patch and its nearest in the bank, or of those in ``among``."""
    cosines = slopes @ bank.T
    return (cosines if among is None else cosines.where(among, -1.0)).amax(dim=1)


def like_noise(patches: Float[Tensor, "n side side"]) -> Float[Tensor, "n side side"]:
    """Each patch with its own amplitudes and the phases of white noise."""
    generator = torch.Generator().manual_seed(3)
    noise = torch.fft.fft2(torch.randn(patches.shape, generator=generator))
    phases = noise / noise.abs().clamp(min=1e-9)
    return torch.fft.ifft2(torch.fft.fft2(patches).abs() * phases).real
