"""The built-in backends, by name. Imports none of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from styleexp.plugins.spec import Spec

if TYPE_CHECKING:
    from styleexp.renderers.base import Renderer


@dataclass
class SoftRasterConfig:
    """Options of ``soft_raster``."""

    name: str = "soft_raster"
    visibility_gradient: str = "contour"
    """``contour`` (anti-aliased outlines with gradients) or ``none``."""


@dataclass
class ModernGLDeferredConfig:
    """Options of ``moderngl_deferred``."""

    name: str = "moderngl_deferred"
    visibility_gradient: str = "contour"
    """``contour`` or ``none``, as for ``soft_raster``."""


def _soft_raster(config: SoftRasterConfig) -> Renderer:
    from styleexp.renderers.soft_raster import SoftRaster

    return SoftRaster(visibility_gradient=config.visibility_gradient)


def _moderngl_deferred(config: ModernGLDeferredConfig) -> Renderer:
    from styleexp.renderers.moderngl_deferred import ModernGLDeferred

    return ModernGLDeferred(visibility_gradient=config.visibility_gradient)


@dataclass
class MitsubaADConfig:
    """Options of ``mitsuba_ad``. Counts are samples per pixel, for soft outlines."""

    name: str = "mitsuba_ad"
    spp: int = 16
    """Samples per pixel of the image, rounded up to a number that can be stratified; 1: the pixel's
    centre."""
    sppc: int = 4
    """Samples per pixel of the shading gradient, rounded likewise."""
    sppp: int = 1
    """Samples of the outline gradient per pixel; spread over the outlines, not over the pixels."""
    seed: int = 0
    """Seed of all samples; every render restarts from it."""


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
        "visibility by OpenGL through EGL, the rest as in soft_raster; needs the extra gl",
        ModernGLDeferredConfig,
        _moderngl_deferred,
        requires=("moderngl",),
        extra="gl",
    ),
    "mitsuba_ad": Spec(
        "mitsuba_ad",
        "Mitsuba 3, path-space gradients of outlines; CPU, needs the extra mitsuba",
        MitsubaADConfig,
        _mitsuba_ad,
        requires=("mitsuba", "drjit"),
        extra="mitsuba",
    ),
}
