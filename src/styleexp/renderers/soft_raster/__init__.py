"""Pure-torch rasteriser with shading and visibility gradients: ``SoftRaster``."""

from styleexp.renderers.soft_raster.renderer import SoftRaster

__all__ = ["SoftRaster"]
