"""The built-in backends, by name. Imports none of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from styleexp.registry import Spec

if TYPE_CHECKING:
    from styleexp.renderers.base import Renderer


@dataclass
class SoftRasterConfig:
    """Options of ``soft_raster``."""

    name: str = "soft_raster"
    visibility_gradient: str = "contour"
    """``contour`` (outlines are anti-aliased and carry gradients) or ``none``."""


def _soft_raster(config: SoftRasterConfig) -> Renderer:
    from styleexp.renderers.soft_raster import SoftRaster

    return SoftRaster(visibility_gradient=config.visibility_gradient)


RENDERERS = {
    "soft_raster": Spec(
        "soft_raster",
        "pure-torch rasteriser with contour-edge visibility gradients; CPU and CUDA",
        SoftRasterConfig,
        _soft_raster,
    ),
}
