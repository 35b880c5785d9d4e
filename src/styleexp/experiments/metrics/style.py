"""Distance between a result's relief and a style's, with and without network features.

Both use the windows of ``patches``, so neither sees the base shape. Their reliability was measured
on results with a known answer: see ``truth`` and docs/metrics.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import torch
from torch.nn import functional

from styleexp.inputs import measured
from styleexp.method import pictures, targets
from styleexp.method.losses import gram_matrix, layer_mask
from styleexp.method.patches import SIZE, WINDOW, Relief, Windows, blurred, relief_of_mesh, windows
from styleexp.method.views import step_generator
from styleexp.renderers.base import Shading
from styleexp.system.transfer import to_host

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
    from torch import Tensor

    from styleexp.config.schema import Config
    from styleexp.encoders import Encoder
    from styleexp.inputs.style import Style

LAYERS = ("conv3_1", "conv4_1")
"""Judging layers. Shallower ones confused scales with other styles on the truth board; conv5_1 has
only six cells per window side."""
RIM = 3
"""Cells at a window's border that see the zero padding, at each of these layers."""
STYLE_WINDOWS = 48
HEIGHT_GAIN = 5.0
"""Grey levels per window width of height: heights within 0.1 of the mean fill the range."""
BANDS = (1.0, 2.0, 4.0, 8.0, 16.0)
"""Gaussian widths, in pixels, that bound the bands of ``Statistics``."""
ENERGY_WEIGHT, SKEWNESS_WEIGHT = 0.3, 0.5
"""Weights that equalise the variation of the statistics between styles."""
FLOOR = 1e-3
"""Lower bound for energies, as a fraction of the style's."""


Grams: TypeAlias = "list[Tensor]"
"""One Gram matrix per layer."""


@dataclass(frozen=True)
class Statistics:
    """Filter statistics of a relief's windows; one value per band, from fine to coarse.

    The windows are flat and small, so planar filter bands approximate those of the surface's
    Laplace-Beltrami operator.
    """

    energy: Float[Tensor, " bands"]
    skewness: Float[Tensor, " bands"]
    """Skewness: positive for bumps, negative for dents."""
    upright: Float[Tensor, " bands"]
    """Orientation, from -1 (all slopes point sideways: vertical ridges) to 1 (horizontal
    ridges)."""
    coherence: Float[Tensor, " bands"]
    """Coherence, from 0 (no direction) to 1 (ridges)."""


@dataclass(frozen=True)
class Looks:
    """All features compared for one relief or image."""

    shaded: Grams
    height: Grams | None = None
    """Grams of the height images; None for a photo, whose heights are unknown."""
    statistics: Statistics | None = None
    """Filter statistics; for an image, of its brightness as a height without a unit."""


def judged(relief: Relief, unit: float, encoder: Encoder, count: int, seed: int = 0) -> Looks:
    """Features of a relief whose pattern has the size ``unit``, in the relief's units.

    Grams are empty if the surface is nowhere wide enough for a window.
    """
    seen = windows(relief, WINDOW * unit, count, seed)
    found = statistics(seen) if len(seen.mask) else None
    return Looks(grams(encoder, shaded(seen.height), seen.mask), height_grams(encoder, seen), found)


def height_grams(encoder: Encoder, seen: Windows) -> Grams:
    """Grams of the windows as height images; grey is the mean height, white is high."""
    return grams(encoder, (0.5 + HEIGHT_GAIN * seen.height).clamp(0, 1), seen.mask)


def judged_style(style: Style, config: Config, encoder: Encoder, unit: float) -> Looks:
    """Features of the style itself. An image is treated as a photo of the shaded relief.

    ``unit`` is the pattern's size on the source; an image's size is a multiple of it.
    """
    given = {f"encoder.{name}": each for name, each in encoder.state_dict().items()}
    about = f"{type(encoder).__qualname__} {encoder.precision}"
    if style.mesh is not None:
        mesh = style.mesh
        given |= {"vertices": mesh.vertices, "faces": mesh.faces}

        def look() -> Looks:
            return judged(relief_of_mesh(mesh), 1.0, encoder, STYLE_WINDOWS)
    else:
        picture = style.picture
        assert picture is not None
        span = picture_span(config, unit) / unit
        given |= {"picture": picture}
        about += f" {span} {config.style} {config.baseline is None}"

        def look() -> Looks:
            return judged_picture(picture, config, span, encoder)

    on_cpu = next(encoder.parameters()).device.type == "cpu"
    if not on_cpu or not type(encoder).__module__.startswith("styleexp."):
        return look()  # neither a device nor a plugin's code is part of the key
    return _looks(measured.kept("looks", given, about, lambda: _arrays(look())))


def _arrays(looks: Looks) -> measured.Arrays:
    """A look's tensors by name, to be kept; in order, since there are fewer than a hundred."""
    made = {f"shaded.{n:02}": each.cpu().numpy() for n, each in enumerate(looks.shaded)}
    made |= {f"height.{n:02}": each.cpu().numpy() for n, each in enumerate(looks.height or ())}
    if looks.statistics is not None:
        made |= {
            f"of.{f.name}": getattr(looks.statistics, f.name).cpu().numpy()
            for f in fields(Statistics)
        }
    return made | {"has_height": np.array(looks.height is not None)}


def _looks(made: measured.Arrays) -> Looks:
    def named(prefix: str) -> list[Tensor]:
        return [torch.from_numpy(made[name]) for name in sorted(made) if name.startswith(prefix)]

    known = {f.name: made.get(f"of.{f.name}") for f in fields(Statistics)}
    found = None
    if all(each is not None for each in known.values()):
        found = Statistics(**{name: torch.from_numpy(each) for name, each in known.items()})
    return Looks(named("shaded."), named("height.") if made["has_height"] else None, found)


def judged_picture(
    picture: Float[np.ndarray, "height width 3"], config: Config, span: float, encoder: Encoder
) -> Looks:
    """Features of an image whose longer side is ``span`` patterns long."""
    level = float(shaded(torch.zeros(1, 8, 8)).mean())
    rgb = torch.from_numpy(picture)
    heights = pictures.picture_height(config.style, picture, config.baseline is None)

    def cut(grey: Float[Tensor, "height width"]) -> Float[Tensor, "n size size"]:
        places = step_generator(0, 0, stream=12)
        pixels = span / WINDOW * SIZE
        return targets.picture_windows(grey, pixels, SIZE, STYLE_WINDOWS, places).image[..., 0]

    height = cut(heights.height)
    everywhere = torch.ones_like(height, dtype=torch.bool)
    if heights.in_proportion:  # as for a mesh, in window widths
        seen = Windows(height * (span / WINDOW), everywhere)
        lit = grams(encoder, shaded(seen.height), everywhere)
        return Looks(lit, height_grams(encoder, seen), statistics(seen))
    shown = cut(targets.tone(rgb, level, config.style))
    return Looks(grams(encoder, shown, everywhere), None, statistics(Windows(height, everywhere)))


def picture_span(config: Config, unit: float) -> float:
    """Length of a style image's longer side on the result, in radii; see ``styles``."""
    if config.loss.target == "same_views":  # the image is a whole view, as in the paper
        return 2 * config.views.distance * math.tan(math.radians(config.views.fov) / 2)
    return config.style.image_tile * math.sqrt(4 * math.pi) * unit


def judged_plain(encoder: Encoder) -> Looks:
    """Features of a surface without relief, the start of every source."""
    flat = torch.zeros(1, SIZE, SIZE)
    everywhere = torch.ones(1, SIZE, SIZE, dtype=torch.bool)
    return Looks(
        grams(encoder, shaded(flat), everywhere), grams(encoder, flat + 0.5, everywhere), None
    )


def style_distance(result: Looks, style: Looks, plain: Looks) -> float:
    """0 for the style itself, 1 for a surface without relief; above 1 is worse than none.

    Distance between feature correlations of height images, divided by that of the plain surface.
    For a photo, which has no heights, it is `appearance_distance` divided by the plain surface's.
    """
    return pattern_distance(result, style) / pattern_distance(plain, style)


def pattern_distance(result: Looks, style: Looks) -> float:
    """Unnormalised distance used in `style_distance`."""
    if style.height is None or result.height is None:
        return appearance_distance(result, style)
    return _apart(result.height, style.height)


def appearance_distance(result: Looks, style: Looks) -> float:
    """Distance between feature correlations of shaded windows."""
    return _apart(result.shaded, style.shaded)


def gram_distance(result: Looks, style: Looks, plain: Looks) -> float:
    """Like `style_distance`, but with squared distances of the Grams themselves, as in the loss. A
    slightly too high relief then counts more than a different pattern."""
    assert result.height is not None
    assert style.height is not None
    assert plain.height is not None
    parts = [
        (a - b).square().sum() / (p - b).square().sum().clamp(min=1e-20)
        for a, b, p in zip(result.height, style.height, plain.height, strict=True)
    ]
    return float(torch.stack(parts).mean())


def relief_distance(result: Looks, style: Looks) -> float | None:
    """Difference of two reliefs' `Statistics`, without a neural network. 0 is equal.

    Energies are compared by their log ratio; the rest is weighted by the band's share of the
    energy. An image's brightness is used as its height up to a factor, so energies are normalised
    to their sum and the height of the relief doesn't matter. None if there is no window.
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
    """One Gram per layer in ``LAYERS``, over masked cells that see only the window; on the CPU,
    computed where the encoder is."""
    device = next(encoder.parameters()).device
    grey, mask = grey.to(device), mask.to(device)
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
    totals = to_host(sums)
    return [total / max(count, 1.0) for total, count in zip(totals, counts, strict=True)]


def shaded(height: Float[Tensor, "n size size"]) -> Float[Tensor, "n size size"]:
    """Shade the windows with the training light, as grey levels."""
    rows, columns = torch.gradient(blurred(height, 0.7) * height.shape[-1], dim=(1, 2))
    normal = functional.normalize(
        torch.stack([-columns, rows, torch.ones_like(rows)], dim=-1), dim=-1
    )
    light = Shading()
    lit = light.ambient + (normal * normal.new_tensor(light.light)).sum(-1)
    return (light.albedo * lit).clamp(0, 1)


def statistics(seen: Windows) -> Statistics:
    """Energy, skewness and direction of the relief, per band."""
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
    """Frobenius distance of the correlation matrices divided by their size, averaged over
    layers."""
    parts = [
        (_correlation(a) - _correlation(b)).norm() / len(a)
        for a, b in zip(result, style, strict=True)
    ]
    return float(torch.stack(parts).mean())


def _correlation(gram: Tensor) -> Tensor:
    root = gram.diagonal().clamp(min=1e-12).sqrt()
    return gram / (root[:, None] * root)
