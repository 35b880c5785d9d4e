"""The style as an example of a relief: heights over a smooth shape, or a picture's tone.

All lengths are in units of the pattern: radii of a style mesh; a picture's are what
``style.image_tile`` says.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Protocol, TypeAlias

import numpy as np
import torch
from torch.nn import functional

from styleexp.metrics.patches import blurred
from styleexp.relief import mesh_frequency, smoother
from styleexp.synthesis.direction import UP, direction_field, turned
from styleexp.synthesis.walk import Sheet

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
    from torch import Tensor

Y = (0.0, 1.0, 0.0)
FLAT_UP = (0.0, 0.0, -1.0)
LEAST_SEEN = 0.98
"""Share of a patch that has to lie on the style mesh, not beyond its boundary, and where its relief
is as usual; or the best `BEST` of all patches do."""
BEST = 0.25
UPRIGHT = 0.35
"""Sine of the angle between a style mesh's normal and its up below which no patch is taken there:
round a pole of the direction field patterns turn."""
SPECTRUM = 25
"""Samples on a side of the patches that the pattern's wavelength is measured on."""

CLEAR = 0.05
"""A rise of the heights' likeness, in shares of their variance, that is no chance."""


Places: TypeAlias = "Float[np.ndarray, 'places numbers']"
"""Where patches are taken, a row of numbers each, which only their exemplar understands."""


class Exemplar(Protocol):
    """Where patches come from."""

    @property
    def extent(self) -> float:
        """Length of the whole."""
        ...

    def sample(
        self, count: int, side: int, spacing: float, rng: np.random.Generator, any_way: bool
    ) -> tuple[Float[Tensor, "patches side side"], Places]:
        """At most ``count`` patches of heights at a spacing, blurred to it, row 0 up, and where
        they are from. ``any_way`` turns each by an angle of its own."""
        ...

    def patches(
        self, places: Places, side: int, spacing: float
    ) -> Float[Tensor, "patches side side"]:
        """The patches of these places."""
        ...


@dataclass(frozen=True)
class MeshExemplar:
    """The relief of a style mesh, sampled by walking over its smooth shape."""

    sheet: Sheet
    """The smooth shape, in the unit sphere."""
    height: Float[np.ndarray, " vertices"]
    usual: Bool[np.ndarray, " vertices"] | None = None
    """Where the relief is the pattern; None is everywhere. Elsewhere are a rim, a flat base."""
    extent: float = 2.0

    @cached_property
    def up(self) -> tuple[float, float, float]:
        """+Y; of a surface that lies flat, as a terrain does, -Z, as on a map."""
        lying = np.linalg.norm(np.cross(self.sheet.normals, Y), axis=1) <= UPRIGHT
        return FLAT_UP if np.average(lying, weights=self._weights) > 0.5 else Y

    @cached_property
    def ahead(self) -> Float[np.ndarray, "vertices 3"]:
        """Which way is up."""
        return direction_field(self.sheet, np.broadcast_to(self.up, self.sheet.vertices.shape), UP)

    @property
    def frequency(self) -> float:
        """Root mean square frequency of the relief, in cycles per radius, where it is as usual."""
        faces = self.sheet.faces
        if self.usual is not None:
            faces = faces[self.usual[faces].all(axis=1)]
        return mesh_frequency(self.height, self.sheet.vertices, faces)

    @cached_property
    def _weights(self) -> Float[np.ndarray, " vertices"]:
        """Vertices stand for the area around them: dense parts of a mesh don't count more."""
        areas = self.sheet.areas
        return areas if self.usual is None else areas * self.usual

    def sample(
        self, count: int, side: int, spacing: float, rng: np.random.Generator, any_way: bool
    ) -> tuple[Float[Tensor, "patches side side"], Places]:
        """See `Exemplar`. A place is a vertex and the unit tangent that is up there."""
        sheet = self.sheet
        standing = np.linalg.norm(np.cross(sheet.normals, self.up), axis=1)
        allowed = np.flatnonzero((standing > UPRIGHT) | any_way)
        share = self._weights[allowed]
        start = rng.choice(allowed, count, p=share / share.sum())
        ahead = self.ahead[start]
        if any_way:
            ahead = turned(ahead, sheet.normals[start], rng.uniform(0, 2 * np.pi, count))
        places = np.concatenate([start[:, None], ahead], axis=1)
        patches, seen = self._patches(places, side, spacing)
        whole = seen >= min(LEAST_SEEN, np.quantile(seen, 1 - BEST))
        return patches[torch.from_numpy(whole)], places[whole]

    def patches(
        self, places: Places, side: int, spacing: float
    ) -> Float[Tensor, "patches side side"]:
        """See `Exemplar`."""
        return self._patches(places, side, spacing)[0]

    def _patches(
        self, places: Places, side: int, spacing: float
    ) -> tuple[Float[Tensor, "patches side side"], Float[np.ndarray, " patches"]]:
        """Patches, and how much of each lies on the mesh where its relief is as usual."""
        sheet = self.sheet
        start = places[:, 0].astype(np.int64)
        points, nears, _ = sheet.grids(start, places[:, 1:], side, spacing)
        seen = sheet.on_the_mesh(points, nears)
        if self.usual is not None:
            seen &= self.usual[nears]
        height = self.height
        if spacing > 1.5 * sheet.edge:
            height = smoother(sheet.vertices, sheet.faces, 2 * spacing)(height)
        sampling = sheet.interpolation(points.reshape(-1, 3), nears.ravel())
        sampled = sampling @ height.astype(np.float32)
        return torch.from_numpy(sampled).float().view(-1, side, side), seen.mean(axis=(1, 2))


@dataclass(frozen=True)
class PictureExemplar:
    """A picture's tone as heights; it is mirrored at its borders."""

    height: Float[Tensor, "rows columns"]
    pixel: float
    """Length of a pixel."""

    @property
    def extent(self) -> float:
        """Length of the longer side."""
        return self.pixel * max(self.height.shape)

    def sample(
        self, count: int, side: int, spacing: float, rng: np.random.Generator, any_way: bool
    ) -> tuple[Float[Tensor, "patches side side"], Places]:
        """See `Exemplar`. A place is a row, a column, and the angle of up, clockwise."""
        reach = (side // 2) * spacing / self.pixel * (np.sqrt(2) if any_way else 1.0)
        middle = [
            rng.uniform(min(reach, size / 2), max(size - reach, size / 2), count)
            for size in self.height.shape
        ]
        angle = rng.uniform(0, 2 * np.pi, count) if any_way else np.zeros(count)
        places = np.stack([*middle, angle], axis=1)
        return self.patches(places, side, spacing), places

    def patches(
        self, places: Places, side: int, spacing: float
    ) -> Float[Tensor, "patches side side"]:
        """See `Exemplar`."""
        step = spacing / self.pixel
        height = self.height[None]
        if step > 1:
            height = blurred(height, 0.45 * step)
        rows, columns = self.height.shape
        across = (torch.arange(side) - side // 2) * step
        down, right = torch.meshgrid(across, across, indexing="ij")
        y, x, angle = (torch.from_numpy(each).float()[:, None, None] for each in places.T)
        y = y + torch.cos(angle) * down + torch.sin(angle) * right
        x = x - torch.sin(angle) * down + torch.cos(angle) * right
        grid = torch.stack([2 * x / columns - 1, 2 * y / rows - 1], dim=-1)
        sampled = functional.grid_sample(
            height[None], grid.view(1, -1, side, 2), padding_mode="reflection", align_corners=False
        )
        return sampled.view(-1, side, side)


@dataclass(frozen=True)
class Pattern:
    """What an exemplar's patches tell of it."""

    wavelength: float
    """Twice the distance at which heights first are least alike, in whatever direction."""
    directed: float
    """How much the likeness of heights at that distance depends on the direction: its deviation
    over that of the likeness at all distances."""
    low: float
    high: float
    """1st and 99th percentile of the heights."""


def measure(exemplar: Exemplar, rng: np.random.Generator) -> Pattern:
    """Wavelength, direction and height of an exemplar, by the autocovariance of its heights."""
    for samples in (60, 150, 375):
        spacing = exemplar.extent / samples
        patches, _ = exemplar.sample(1000, SPECTRUM, spacing, rng, any_way=False)
        centred = patches - patches.mean()
        middle = centred[:, SPECTRUM // 2, SPECTRUM // 2, None, None]
        likeness = (middle * centred).mean(0) / centred.square().mean().clamp(min=1e-20)
        radii = torch.arange(0, SPECTRUM // 2 + 0.01, 0.5)
        along = _polar(likeness, radii, torch.arange(0, 24) * (np.pi / 24))
        half = _first_trough(along, radii)
        if half >= 3:
            break  # else the pattern is too fine for these samples
    ring = along[:, (radii >= 0.8 * half) & (radii <= 1.2 * half)].mean(dim=1)
    directed = float(ring.std() / along.std().clamp(min=1e-6))
    low, high = np.percentile(patches.numpy(), [1, 99])
    return Pattern(2 * half * spacing, directed, float(low), float(high))


def _first_trough(along: Float[Tensor, "angles radii"], radii: Float[Tensor, " radii"]) -> float:
    """The smallest radius at which likeness falls and clearly rises again in some direction; where
    it never does, as in patterns without any order, where it has fallen to a tenth."""
    least = along[:, 1:-1]
    trough = (least <= along[:, :-2]) & (least < along[:, 2:])
    rise = torch.stack([along[:, at + 1 : at + 9].amax(1) for at in range(1, len(radii) - 1)], 1)
    rise = torch.where(trough, rise - least, 0.0)
    if float(rise.max()) > CLEAR:
        clear = rise > 0.5 * rise.max()
        return float(radii[1:-1][clear.any(dim=0)][0])
    low = along.mean(dim=0) < 0.1
    return float(radii[low][0]) if bool(low.any()) else float(radii[-1])


def _polar(values: Tensor, radii: Tensor, angles: Tensor) -> Tensor:
    """A square map at (angles, radii) in pixels from its middle."""
    half = values.shape[0] // 2
    x = radii[None] * torch.cos(angles)[:, None] / (half + 0.5)
    y = radii[None] * torch.sin(angles)[:, None] / (half + 0.5)
    grid = torch.stack([x, y], dim=-1).float()[None]
    return functional.grid_sample(values[None, None].float(), grid, align_corners=False)[0, 0]
