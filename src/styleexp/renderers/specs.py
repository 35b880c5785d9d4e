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
}
