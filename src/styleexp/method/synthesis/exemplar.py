"""Exemplars of a relief: a style mesh's heights above a smooth shape, or an image's tone.

All lengths are in units of the pattern: radii of a style mesh, or as set by ``style.image_tile``
for an image.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Protocol, TypeAlias

import numpy as np
import torch
from torch.nn import functional

from styleexp.inputs import measured
from styleexp.method.patches import blurred
from styleexp.method.relief import heat_smoother, mesh_frequency, picture_frequency
from styleexp.method.synthesis.direction import UP, direction_field, turned
from styleexp.method.synthesis.walk import Sheet

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
    from torch import Tensor

Y = (0.0, 1.0, 0.0)
FLAT_UP = (0.0, 0.0, -1.0)
LEAST_SEEN = 0.98
"""Minimum fraction of a patch that must be on the style mesh and on its usual relief. If too few
patches qualify, the best fraction `BEST` of all patches is used."""
BEST = 0.25
UPRIGHT = 0.35
"""Sine of the angle between the style mesh's normal and its up direction below which no patch is
taken, because patterns rotate around poles of the direction field."""
SPECTRUM = 25
"""Samples per side of the patches used to measure the wavelength."""

MEASURED = 300
"""Patches used to measure the pattern."""

CLEAR = 0.05
"""Significant rise of the heights' autocovariance, as a fraction of their variance."""


Places: TypeAlias = "Float[np.ndarray, 'places numbers']"
"""Positions of patches, one row of numbers each, in a format private to their exemplar."""


class Exemplar(Protocol):
    """A source of patches."""

    @property
    def extent(self) -> float:
        """Length of the whole exemplar."""
        ...

    def arrays(self) -> dict[str, np.ndarray]:
        """All that the patches depend on."""
        ...

    def sample(
        self, count: int, side: int, spacing: float, rng: np.random.Generator, any_way: bool
    ) -> tuple[Float[Tensor, "patches side side"], Places]:
        """Up to ``count`` patches of heights at a spacing, blurred accordingly, row 0 up, and their
        positions. ``any_way`` rotates each patch randomly."""
        ...

    def patches(
        self, places: Places, side: int, spacing: float
    ) -> Float[Tensor, "patches side side"]:
        """The patches at these positions."""
        ...

    def centres(self, places: Places) -> Float[np.ndarray, "places axes"]:
        """The centres of the patches at these positions, in the exemplar's space."""
        ...


@dataclass(frozen=True)
class MeshExemplar:
    """A style mesh's relief, sampled by walking over its smooth shape."""

    sheet: Sheet
    """The smooth shape, in the unit sphere."""
    height: Float[np.ndarray, " vertices"]
    usual: Bool[np.ndarray, " vertices"] | None = None
    """Vertices where the relief is the pattern, not a rim or a flat base; None means all."""
    extent: float = 2.0

    def arrays(self) -> dict[str, np.ndarray]:
        """See `Exemplar`."""
        sheet, usual = self.sheet, self.usual
        given = {"vertices": sheet.vertices, "faces": sheet.faces, "normals": sheet.normals}
        given |= {"height": self.height, "extent": np.array(self.extent)}
        return given if usual is None else given | {"usual": usual}

    @cached_property
    def up(self) -> tuple[float, float, float]:
        """Up direction: +Y; for a flat surface such as a terrain -Z, as on a map."""
        lying = np.linalg.norm(np.cross(self.sheet.normals, Y), axis=1) <= UPRIGHT
        return FLAT_UP if np.average(lying, weights=self._weights) > 0.5 else Y

    @cached_property
    def ahead(self) -> Float[np.ndarray, "vertices 3"]:
        """Unit tangent that points up, per vertex."""
        return direction_field(self.sheet, np.broadcast_to(self.up, self.sheet.vertices.shape), UP)

    @property
    def frequency(self) -> float:
        """RMS frequency of the usual relief, in cycles per radius."""
        faces = self.sheet.faces
        if self.usual is not None:
            faces = faces[self.usual[faces].all(axis=1)]
        return mesh_frequency(self.height, self.sheet.vertices, faces)

    @cached_property
    def _weights(self) -> Float[np.ndarray, " vertices"]:
        """Area weights of the vertices, so that dense parts of a mesh don't count more."""
        areas = self.sheet.areas
        return areas if self.usual is None else areas * self.usual

    def sample(
        self, count: int, side: int, spacing: float, rng: np.random.Generator, any_way: bool
    ) -> tuple[Float[Tensor, "patches side side"], Places]:
        """See `Exemplar`. A position is a vertex and its up tangent."""
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

    def centres(self, places: Places) -> Float[np.ndarray, "places 3"]:
        """See `Exemplar`."""
        return self.sheet.vertices[places[:, 0].astype(np.int64)]

    def _patches(
        self, places: Places, side: int, spacing: float
    ) -> tuple[Float[Tensor, "patches side side"], Float[np.ndarray, " patches"]]:
        """Patches, and the fraction of each that is on the mesh's usual relief."""
        sheet = self.sheet
        start = places[:, 0].astype(np.int64)
        points, nears, _ = sheet.grids(start, places[:, 1:], side, spacing)
        seen = sheet.on_the_mesh(points, nears)
        if self.usual is not None:
            seen &= self.usual[nears]
        height = self.height
        if spacing > 1.5 * sheet.edge:
            height = heat_smoother(sheet.vertices, sheet.faces, 2 * spacing)(height)
        sampling = sheet.interpolation(points.reshape(-1, 3), nears.ravel())
        sampled = sampling @ height.astype(np.float32)
        return torch.from_numpy(sampled).float().view(-1, side, side), seen.mean(axis=(1, 2))


@dataclass(frozen=True)
class PictureExemplar:
    """An image's tone as heights, mirrored at its borders."""

    height: Float[Tensor, "rows columns"]
    pixel: float
    """Side length of a pixel."""

    def arrays(self) -> dict[str, np.ndarray]:
        """See `Exemplar`."""
        return {"height": self.height.numpy(), "pixel": np.array(self.pixel)}

    @property
    def extent(self) -> float:
        """Length of the longer side."""
        return self.pixel * max(self.height.shape)

    @property
    def frequency(self) -> float:
        """RMS frequency of the heights, in cycles per unit."""
        return picture_frequency(self.height.numpy()) / self.extent

    def sample(
        self, count: int, side: int, spacing: float, rng: np.random.Generator, any_way: bool
    ) -> tuple[Float[Tensor, "patches side side"], Places]:
        """See `Exemplar`. A position is a row, a column, and the clockwise angle of up."""
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

    def centres(self, places: Places) -> Float[np.ndarray, "places 2"]:
        """See `Exemplar`."""
        return places[:, :2] * self.pixel


def sampled(
    exemplar: Exemplar,
    count: int,
    side: int,
    spacing: float,
    seed: tuple[int, ...],
    any_way: bool,
) -> tuple[Float[Tensor, "patches side side"], Places]:
    """`Exemplar.sample` with the random numbers of a seed. A mesh's patches, which take a walk over
    it, are kept for the next run with the same style, on whatever source."""

    def make() -> tuple[Tensor, Places]:
        return exemplar.sample(count, side, spacing, np.random.default_rng(seed), any_way)

    if isinstance(exemplar, PictureExemplar):
        return make()
    about = f"{count} {side} {spacing!r} {seed} {any_way}"
    found = measured.kept("patches", exemplar.arrays(), about, lambda: _named(*make()))
    return torch.from_numpy(found["patches"]), found["places"]


def _named(patches: Tensor, places: Places) -> measured.Arrays:
    return {"patches": patches.numpy(), "places": places}


@dataclass(frozen=True)
class Pattern:
    """Measurements of an exemplar's patches."""

    wavelength: float
    """Twice the distance of the first minimum of the autocovariance, in any direction."""
    directed: float
    """Anisotropy: standard deviation of the autocovariance over directions at that distance,
    relative to that over all distances."""
    coherence: float
    """How much the slopes share one axis, 0 to 1: the coherence of their structure tensor (Bigün
    and Granlund 1987). High for long forms without a common spacing, such as bark."""
    low: float
    high: float
    """``low`` and ``high`` are the 1st and 99th percentiles of the heights."""


def pattern_of(exemplar: Exemplar) -> Pattern:
    """`measure`, kept for the next run with the same style."""

    def make() -> measured.Arrays:
        found = measure(exemplar, np.random.default_rng(0))
        return {name: np.array([each]) for name, each in asdict(found).items()}

    found = measured.kept("pattern", exemplar.arrays(), "", make)
    return Pattern(**{name: each.item() for name, each in found.items()})


def measure(exemplar: Exemplar, rng: np.random.Generator) -> Pattern:
    """Measure wavelength, direction and height of an exemplar from its autocovariance."""
    for samples in (60, 150, 375):
        spacing = exemplar.extent / samples
        patches, _ = exemplar.sample(MEASURED, SPECTRUM, spacing, rng, any_way=False)
        likeness = _autocorrelation(patches - patches.mean())
        radii = torch.arange(0, SPECTRUM // 2 + 0.01, 0.5)
        along = _polar(likeness, radii, torch.arange(0, 24) * (np.pi / 24))
        half = _first_trough(along, radii)
        if half >= 3:
            break  # else the pattern is too fine for these samples
    ring = along[:, (radii >= 0.8 * half) & (radii <= 1.2 * half)].mean(dim=1)
    directed = float(ring.std() / along.std().clamp(min=1e-6))
    low, high = np.percentile(patches.numpy(), [1, 99])
    coherence = _coherence(patches)
    return Pattern(2 * half * spacing, directed, coherence, float(low), float(high))


def _autocorrelation(centred: Float[Tensor, "patches side side"]) -> Float[Tensor, "side side"]:
    """Mean product of two heights, by their offset, over all pairs within the patches; 1 at offset
    0, which is in the middle."""
    side = centred.shape[1]
    size = (2 * side, 2 * side)  # so that nothing wraps around
    power = torch.fft.rfft2(centred.double(), s=size).abs().square().mean(0)
    among = torch.fft.rfft2(torch.ones(side, side, dtype=torch.float64), s=size).abs().square()
    products, pairs = (
        torch.fft.irfft2(each, s=size).roll((side // 2, side // 2), (0, 1))[:side, :side]
        for each in (power, among)
    )
    return (products / pairs / centred.square().mean().clamp(min=1e-20)).float()


def _coherence(patches: Float[Tensor, "patches side side"]) -> float:
    down = (patches[:, 1:, :-1] - patches[:, :-1, :-1]).flatten()
    right = (patches[:, :-1, 1:] - patches[:, :-1, :-1]).flatten()
    across, along = (right**2).mean() - (down**2).mean(), 2 * (right * down).mean()
    energy = (right**2).mean() + (down**2).mean()
    return float(torch.hypot(across, along) / energy.clamp(min=1e-20))


def _first_trough(along: Float[Tensor, "angles radii"], radii: Float[Tensor, " radii"]) -> float:
    """Smallest radius at which the autocovariance has a clear minimum in some direction; without
    one, as in unordered patterns, the radius at which it drops to a tenth."""
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
    """Sample a square map at (angles, radii), in pixels from its centre."""
    half = values.shape[0] // 2
    x = radii[None] * torch.cos(angles)[:, None] / (half + 0.5)
    y = radii[None] * torch.sin(angles)[:, None] / (half + 0.5)
    grid = torch.stack([x, y], dim=-1).float()[None]
    return functional.grid_sample(values[None, None].float(), grid, align_corners=False)[0, 0]
