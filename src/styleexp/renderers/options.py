"""Options of the built-in renderers. Imports nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass

from styleexp.system.options import option


@dataclass
class SoftRasterConfig:
    """Options of ``soft_raster``."""

    name: str = "soft_raster"
    visibility_gradient: str = option("contour", choices=("contour", "none"))
    """``contour`` (anti-aliased outlines with gradients) or ``none``."""


@dataclass
class ModernGLDeferredConfig:
    """Options of ``moderngl_deferred``."""

    name: str = "moderngl_deferred"
    visibility_gradient: str = option("contour", choices=("contour", "none"))
    """``contour`` or ``none``, as for ``soft_raster``."""


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
