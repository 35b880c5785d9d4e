"""How near a result's relief is to a style's: with a network's features, and without.

Both look at the windows of ``patches``, so neither sees the shape below the relief. How far each
can be trusted was measured on results with a known answer: see ``truth`` and docs/metrics.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch.nn import functional

from styleexp import meshes, pictures, styles
from styleexp.losses import gram_matrix, layer_mask
from styleexp.metrics.patches import SIZE, WINDOW, Relief, Windows, blurred, relief_of_mesh, windows
from styleexp.renderers.base import Shading
from styleexp.views import step_generator

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Bool, Float
    from torch import Tensor

    from styleexp.config import Config
    from styleexp.encoders import Encoder
    from styleexp.losses import Grams

LAYERS = ("conv3_1", "conv4_1")
"""Shallower layers took scales for other styles on the truth board; conv5_1 has only six cells on a
window's side."""
RIM = 3
"""Cells at a window's border that see the zeros beyond it, at each of these layers."""
STYLE_WINDOWS = 48
HEIGHT_GAIN = 5.0
"""Grey levels per window width of height: a relief of a tenth of the window fills the range."""
BANDS = (1.0, 2.0, 4.0, 8.0, 16.0)
"""Gaussian widths, in pixels, between which the bands of ``Statistics`` lie."""
ENERGY_WEIGHT, SKEWNESS_WEIGHT = 0.3, 0.5
"""So that each statistic differs about as much between styles."""
FLOOR = 1e-3
"""Energies below this share of the style's count as this share."""


@dataclass(frozen=True)
class Statistics:
    """What filters find in a relief's windows; a value for each band, from fine to coarse.

    The windows are flat and small, so that bands of a planar filter stand for those of the
    surface's Laplace-Beltrami operator.
    """

    energy: Float[Tensor, " bands"]
    skewness: Float[Tensor, " bands"]
    """Above 0 for bumps, below for dents."""
    upright: Float[Tensor, " bands"]
    """From -1, where all slopes point sideways (vertical ridges), to 1 (horizontal ridges)."""
    coherence: Float[Tensor, " bands"]
    """From 0, no direction, to 1, ridges."""


@dataclass(frozen=True)
class Looks:
    """All that is compared of one relief or picture."""

    shaded: Grams
    height: Grams | None = None
    """None for a photograph: its heights are not known."""
    statistics: Statistics | None = None
    """Of a picture with its brightness for a height, whose unit means nothing."""


def judged(relief: Relief, unit: float, encoder: Encoder, count: int, seed: int = 0) -> Looks:
    """What the judge sees of a relief whose pattern has the size ``unit``, in the relief's units.

    No window at all, on a surface that is nowhere wide enough, gives empty Grams.
    """
    seen = windows(relief, WINDOW * unit, count, seed)
    found = statistics(seen) if len(seen.mask) else None
    return Looks(grams(encoder, shaded(seen.height), seen.mask), height_grams(encoder, seen), found)


def height_grams(encoder: Encoder, seen: Windows) -> Grams:
    """Grams of the windows as height images: grey is the mean height, white is high."""
    return grams(encoder, (0.5 + HEIGHT_GAIN * seen.height).clamp(0, 1), seen.mask)


def judged_style(
    style: meshes.Mesh | np.ndarray, config: Config, encoder: Encoder, unit: float
) -> Looks:
    """The same of the style itself. A picture is taken for a photograph of the shaded relief.

    ``unit`` is the pattern's size on the source, of which a picture's own size is a multiple.
    """
    if isinstance(style, meshes.Mesh):
        return judged(relief_of_mesh(style), 1.0, encoder, STYLE_WINDOWS)
    return judged_picture(style, config, picture_span(config, unit) / unit, encoder)


def judged_picture(
    picture: Float[np.ndarray, "height width 3"], config: Config, span: float, encoder: Encoder
) -> Looks:
    """What the judge sees of a picture whose longer side is ``span`` patterns long."""
    level = float(shaded(torch.zeros(1, 8, 8)).mean())
    rgb = torch.from_numpy(picture)
    heights = pictures.picture_height(config, picture)

    def cut(grey: Float[Tensor, "height width"]) -> Float[Tensor, "n size size"]:
        places = step_generator(0, 0, stream=12)
        pixels = span / WINDOW * SIZE
        return styles.picture_windows(grey, pixels, SIZE, STYLE_WINDOWS, places).image[..., 0]

    height = cut(heights.height)
    everywhere = torch.ones_like(height, dtype=torch.bool)
    if heights.in_proportion:  # as of a mesh, in widths of the window
        seen = Windows(height * (span / WINDOW), everywhere)
        lit = grams(encoder, shaded(seen.height), everywhere)
        return Looks(lit, height_grams(encoder, seen), statistics(seen))
    shown = cut(styles.tone(rgb, level, config.style))
    return Looks(grams(encoder, shown, everywhere), None, statistics(Windows(height, everywhere)))


def picture_span(config: Config, unit: float) -> float:
    """How long a style picture's longer side is on the result, in radii: see ``styles``."""
    if config.loss.target == "same_views":  # the picture is a whole view, as in the paper
        return 2 * config.views.distance * math.tan(math.radians(config.views.fov) / 2)
    return config.style.image_tile * math.sqrt(4 * math.pi) * unit


def judged_plain(encoder: Encoder) -> Looks:
    """The same of a surface without any relief: where every source starts."""
    flat = torch.zeros(1, SIZE, SIZE)
    everywhere = torch.ones(1, SIZE, SIZE, dtype=torch.bool)
    return Looks(
        grams(encoder, shaded(flat), everywhere), grams(encoder, flat + 0.5, everywhere), None
    )


def style_distance(result: Looks, style: Looks, plain: Looks) -> float:
    """0 for the style's own look, 1 for a surface without relief; above 1 is worse than none.

    Distance of the correlations of features of height images, over that of the plain surface. A
    picture has no heights: against one it is `appearance_distance`, over the plain surface's.
    """
    return pattern_distance(result, style) / pattern_distance(plain, style)


def pattern_distance(result: Looks, style: Looks) -> float:
    """What `style_distance` is a ratio of."""
    if style.height is None or result.height is None:
        return appearance_distance(result, style)
    return _apart(result.height, style.height)


def appearance_distance(result: Looks, style: Looks) -> float:
    """Distance of the correlations of features of shaded windows."""
    return _apart(result.shaded, style.shaded)


def gram_distance(result: Looks, style: Looks, plain: Looks) -> float:
    """As `style_distance`, but of the Grams themselves, squared, as losses have it: a relief that
    is a little too high then counts for more than one of another pattern."""
    assert result.height is not None
    assert style.height is not None
    assert plain.height is not None
    parts = [
        (a - b).square().sum() / (p - b).square().sum().clamp(min=1e-20)
        for a, b, p in zip(result.height, style.height, plain.height, strict=True)
    ]
    return float(torch.stack(parts).mean())


def relief_distance(result: Looks, style: Looks) -> float | None:
    """Without a neural network: how much two reliefs' `Statistics` differ. 0 is equal.

    Energies by the logarithm of their ratio; the rest weighted by how much of the energy is in the
    band. A picture's brightness stands for its height, up to a factor: against it energies are
    shares of their sum, and how high the relief is doesn't count. None where no window was seen.
    """
    if result.statistics is None or style.statistics is None:
        return None
    a, b = result.statistics, style.statistics
    ea, eb = a.energy, b.energy
    if style.height is None:
        ea, eb = (e / e.sum().clamp(min=1e-16) for e in (ea, eb))
    floor = float(FLOOR * eb.sum())
    ea, eb = ea.clamp(min=floor), eb.clamp(min=floor)
    weight = (ea / ea.sum()).sqrt() + (eb / eb.sum()).sqrt()
    weight = weight / weight.sum()
    rest = SKEWNESS_WEIGHT * (a.skewness - b.skewness).abs()
    rest = rest + (a.upright - b.upright).abs() + (a.coherence - b.coherence).abs()
    return float(ENERGY_WEIGHT * (ea / eb).log().abs().mean() + (weight * rest).sum())


# ------------------------------------------------------------------------------------- measurement


@torch.no_grad()
def grams(
    encoder: Encoder, grey: Float[Tensor, "n size size"], mask: Bool[Tensor, "n size size"]
) -> Grams:
    """One Gram for each of ``LAYERS``, over the masked cells alone that see nothing but window."""
    sums: list[Tensor] = []
    counts = [0.0] * len(LAYERS)
    for at in range(0, max(len(grey), 1), 16):
        part, cover = grey[at : at + 16], mask[at : at + 16].float()
        features = encoder(part[:, None].expand(-1, 3, -1, -1), list(LAYERS))
        for k, layer in enumerate(LAYERS):
            found = features[layer].float()
            keep = layer_mask(cover, (found.shape[2], found.shape[3]), erosion=0)
            keep = functional.pad(keep[:, RIM:-RIM, RIM:-RIM], (RIM, RIM, RIM, RIM))
            cells = float(keep.sum())
            gram = gram_matrix(found, keep) * cells
            if len(sums) <= k:
                sums.append(gram)
            else:
                sums[k] = sums[k] + gram
            counts[k] += cells
    return [total / max(count, 1.0) for total, count in zip(sums, counts, strict=True)]


def shaded(height: Float[Tensor, "n size size"]) -> Float[Tensor, "n size size"]:
    """The windows under the light that runs are trained under, as grey levels."""
    rows, columns = torch.gradient(blurred(height, 0.7) * height.shape[-1], dim=(1, 2))
    normal = functional.normalize(
        torch.stack([-columns, rows, torch.ones_like(rows)], dim=-1), dim=-1
    )
    light = Shading()
    lit = light.ambient + (normal * normal.new_tensor(light.light)).sum(-1)
    return (light.albedo * lit).clamp(0, 1)


def statistics(seen: Windows) -> Statistics:
    """Energy, skewness and direction of the relief in each band."""
    mask = seen.mask
    rest = seen.height - seen.height[mask].mean()
    rows: list[list[Tensor]] = []
    for width in BANDS:
        smooth = blurred(rest, width)
        band, rest = rest - smooth, smooth
        energy = band[mask].square().mean()
        skewness = band[mask].pow(3).mean() / energy.clamp(min=1e-16).pow(1.5)
        dy, dx = torch.gradient(band, dim=(1, 2))
        xx, yy, xy = (blurred(p, 2 * width) for p in (dx * dx, dy * dy, dx * dy))
        total = (xx + yy)[mask].sum().clamp(min=1e-16)
        upright = (yy - xx)[mask].sum() / total
        coherence = ((xx - yy).square() + 4 * xy.square()).sqrt()[mask].sum() / total
        rows.append([energy, skewness, upright, coherence])
    return Statistics(*(torch.stack(column) for column in zip(*rows, strict=True)))


def _apart(result: Grams, style: Grams) -> float:
    """Frobenius distance of the correlation matrices over their size, the mean over layers."""
    parts = [
        (_correlation(a) - _correlation(b)).norm() / len(a)
        for a, b in zip(result, style, strict=True)
    ]
    return float(torch.stack(parts).mean())


def _correlation(gram: Tensor) -> Tensor:
    root = gram.diagonal().clamp(min=1e-12).sqrt()
    return gram / (root[:, None] * root)
