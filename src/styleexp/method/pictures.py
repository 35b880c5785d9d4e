"""Heights of a style image: a photo's tone, a height map, or an integrated normal map.

A photo doesn't determine the amplitude of its relief; height maps and normal maps do, relative to
the image's longer side.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch.nn import functional

from styleexp.inputs.images import is_normal_map, luminance
from styleexp.method.relief import half_range
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from styleexp.method.options import StyleConfig

DEPTH = 0.1
"""Default of ``style.image_depth``."""
LEAST_CONTRAST = 1e-3
"""Standard deviation of an image's tone in [0, 1], below which it is only rounding noise."""
STEEPEST = 0.05
"""Minimum z of a normal; steeper ones are clamped to a slope of about 20."""
MOST_AT_ONCE = 32
"""Most that an image is shrunk at once on a GPU."""
SEAM = 2.0
"""An image counts as tileable if its opposite borders differ by at most this multiple of the
difference between neighbouring rows or columns."""


@dataclass(frozen=True)
class Heights:
    """Height of each pixel of a style image."""

    kind: str
    """``photo``, ``height``, ``normal`` or ``normal_dx``."""
    height: Float[Tensor, "height width"]
    """Row 0 at the top. For a photo the tone, without a unit; else in fractions of the image's
    longer side."""

    @property
    def in_proportion(self) -> bool:
        """Whether the heights are in fractions of the image's longer side."""
        return self.kind != "photo"


def kind_of(kind: str, picture: Float[np.ndarray, "height width 3"], as_tone: bool = False) -> str:
    """Resolve ``style.kind``. ``auto`` detects a normal map by its colours, and the direction of
    green by which one integrates better; with ``as_tone``, for methods that compare renders with
    the image's tone, it is ``photo``."""
    if kind != "auto":
        return kind
    if as_tone or not is_normal_map(picture):
        return "photo"
    misfit = [integrated(*slopes(picture, down))[1] for down in (False, True)]
    return "normal_dx" if misfit[1] < 0.9 * misfit[0] else "normal"


def picture_height(
    style: StyleConfig, picture: Float[np.ndarray, "height width 3"], as_tone: bool = False
) -> Heights:
    """The image's heights, according to ``style.kind`` (see `kind_of`), ``style.image_depth`` and
    ``style.invert``.

    Raises `UserError` for an image without relief, or one that doesn't match its kind.
    """
    kind = kind_of(style.kind, picture, as_tone)
    _check(style, kind, picture)
    if kind.startswith("normal"):
        found, _ = integrated(*slopes(picture, kind == "normal_dx"))
        height = found / max(picture.shape[:2])
    else:
        height = luminance(picture).astype(np.float64)
        if kind == "height":
            height = height * (DEPTH if style.image_depth is None else style.image_depth)
    return Heights(kind, torch.from_numpy(-height if style.invert else height).float())


def spread(height: Float[Tensor, "height width"]) -> float:
    """Half the percentile range of heights; for a map that is flat almost everywhere, half its full
    range."""
    values = height.cpu().numpy().ravel()
    return max(half_range(values), 0.05 * float(np.ptp(values)), 1e-9)


def _check(config: StyleConfig, kind: str, picture: np.ndarray) -> None:
    name = config.path or config.name
    if config.image_depth is not None and kind != "height":
        raise UserError(
            f"style.image_depth={config.image_depth} only applies to style.kind=height, but "
            f"'{name}' is read as {kind}: add style.kind=height, or leave the depth out."
        )
    if kind.startswith("normal") and not is_normal_map(picture):
        raise UserError(
            f"style.kind={kind}: '{name}' is not a tangent-space normal map: its colours are not "
            "unit vectors that point up on average; give style.kind=photo or style.kind=height."
        )
    tone = picture if kind.startswith("normal") else luminance(picture)[..., None]
    if tone.std(axis=(0, 1)).max() < LEAST_CONTRAST:
        raise UserError(
            f"the style '{name}' is a picture of uniform tone, so there is nothing to transfer: "
            "give one with contrast."
        )


def slopes(
    picture: Float[np.ndarray, "height width 3"], green_down: bool
) -> tuple[Float[np.ndarray, "height width"], Float[np.ndarray, "height width"]]:
    """Slopes of a normal map, per pixel to the right and per pixel down, without its mean tilt.

    ``(n + 1) / 2`` is red to the right, green up (OpenGL) or ``green_down`` (DirectX), blue out.
    """
    x, y, z = np.moveaxis(2.0 * picture.astype(np.float64) - 1.0, -1, 0)
    z = z.clip(STEEPEST)
    right, down = -x / z, (-y if green_down else y) / z
    return right - right.mean(), down - down.mean()


def integrated(
    right: Float[np.ndarray, "height width"], down: Float[np.ndarray, "height width"]
) -> tuple[Float[np.ndarray, "height width"], float]:
    """Least-squares heights, in pixels, for the given slopes (Frankot and Chellappa 1988), and the
    fraction of the slopes' energy that isn't integrable.

    Tileable maps are solved as periodic, others by mirroring.
    """
    rows, columns = right.shape
    if not (_tiles(right, down) and _tiles(right.T, down.T)):
        right = np.concatenate([right, -right[:, ::-1]], 1)
        down = np.concatenate([down, down[:, ::-1]], 1)
        right = np.concatenate([right, right[::-1]], 0)
        down = np.concatenate([down, -down[::-1]], 0)
    size = right.shape
    v = 2j * np.pi * np.fft.fftfreq(size[0])[:, None]
    u = 2j * np.pi * np.fft.rfftfreq(size[1])[None]
    x, y = np.fft.rfft2(right), np.fft.rfft2(down)
    square = np.abs(u) ** 2 + np.abs(v) ** 2
    square[0, 0] = 1.0
    found = (u.conj() * x + v.conj() * y) / square
    found[0, 0] = 0.0
    height = np.fft.irfft2(found, size)
    left = np.abs(x - u * found) ** 2 + np.abs(y - v * found) ** 2
    energy = np.abs(x) ** 2 + np.abs(y) ** 2
    return height[:rows, :columns], float(left.sum() / max(energy.sum(), 1e-300))


def _tiles(*columns: np.ndarray) -> bool:
    """Whether the last column continues into the first."""
    inner = sum(np.abs(np.diff(each, axis=1)).mean() for each in columns)
    return sum(np.abs(each[:, 0] - each[:, -1]).mean() for each in columns) <= SEAM * inner


def resized(
    picture: Float[Tensor, "height width"], longer_side: float
) -> Float[Tensor, "rows columns"]:
    """Resize an image to about ``longer_side`` pixels on its longer side, with antialiasing."""
    factor = longer_side / max(picture.shape)
    return shrunk(picture, [max(8, round(side * factor)) for side in picture.shape])


def shrunk(
    picture: Float[Tensor, "height width"], shape: Sequence[int]
) -> Float[Tensor, "rows columns"]:
    """Resize an image with antialiasing. CUDA's filter must fit a block's shared memory, up to
    about 94 times smaller (float32), so there the image shrinks by steps."""
    if picture.device.type != "cpu":
        while any(old > MOST_AT_ONCE * new for old, new in zip(picture.shape, shape, strict=True)):
            step = [
                max(new, -(-old // MOST_AT_ONCE))
                for old, new in zip(picture.shape, shape, strict=True)
            ]
            picture = _interpolated(picture, step)
    return _interpolated(picture, shape)


def _interpolated(picture: Tensor, shape: Sequence[int]) -> Tensor:
    shape = list(shape)
    return functional.interpolate(picture[None, None], shape, mode="bilinear", antialias=True)[0, 0]


def picture_side(config: StyleConfig, unit: float) -> float:
    """Length of a style image's longer side on the result, in radii of the normalised source."""
    return unit * config.image_tile * math.sqrt(4 * math.pi)
