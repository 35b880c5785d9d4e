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


@dataclass
class ModernGLDeferredConfig:
    """Options of ``moderngl_deferred``."""

    name: str = "moderngl_deferred"
    visibility_gradient: str = "contour"
    """As for ``soft_raster``."""


def _soft_raster(config: SoftRasterConfig) -> Renderer:
    from styleexp.renderers.soft_raster import SoftRaster

    return SoftRaster(visibility_gradient=config.visibility_gradient)


def _moderngl_deferred(config: ModernGLDeferredConfig) -> Renderer:
    from styleexp.renderers.moderngl_deferred import ModernGLDeferred

    return ModernGLDeferred(visibility_gradient=config.visibility_gradient)


@dataclass
class MitsubaADConfig:
    """Options of ``mitsuba_ad``. Counts are samples per pixel, used where outlines are soft."""

    name: str = "mitsuba_ad"
    spp: int = 16
    """Of the picture, rounded up to a number that can be spread evenly; 1 is the pixel's centre."""
    sppc: int = 4
    """Of the gradient of shading, rounded likewise."""
    sppp: int = 1
    """Of the gradient of outlines; they are spread over the outlines, not over the pixels."""
    seed: int = 0
    """Of all samples; every render starts from it anew."""


def _mitsuba_ad(config: MitsubaADConfig) -> Renderer:
    from styleexp.renderers.mitsuba_ad import MitsubaAD

    return MitsubaAD(config.spp, config.sppc, config.sppp, config.seed)


RENDERERS = {
    "soft_raster": Spec(
        "soft_raster",
        "pure-torch rasteriser with contour-edge visibility gradients; CPU and CUDA",
        SoftRasterConfig,
        _soft_raster,
    ),
    "moderngl_deferred": Spec(
        "moderngl_deferred",
        "faces found by OpenGL through EGL, the rest as soft_raster; needs the extra gl",
        ModernGLDeferredConfig,
        _moderngl_deferred,
        requires=("moderngl",),
        extra="gl",
    ),
    "mitsuba_ad": Spec(
        "mitsuba_ad",
        "Mitsuba 3, path-space gradients of outlines; CPU, extra 'mitsuba'",
        MitsubaADConfig,
        _mitsuba_ad,
        requires=("mitsuba", "drjit"),
        extra="mitsuba",
    ),
}
