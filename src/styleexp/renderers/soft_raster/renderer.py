"""The default backend: an exact rasteriser in plain torch, differentiable where it matters."""

from __future__ import annotations

from typing import TYPE_CHECKING

from styleexp.renderers.soft_raster.deferred import DeferredRenderer, Projected
from styleexp.renderers.soft_raster.raster import rasterise

if TYPE_CHECKING:
    from styleexp.renderers.soft_raster.raster import Visible


class SoftRaster(DeferredRenderer):
    """Visibility found in plain torch; all else is ``DeferredRenderer``'s.

    On the CPU the same input gives the same bits, also in the gradients.
    """

    def find_visible(self, projected: Projected) -> Visible:
        """Rasterise watertightly; equal depth goes to the lowest face index."""
        return rasterise(
            projected.points,
            projected.corners,
            projected.pairs,
            projected.near,
            projected.resolution,
        )
