"""The default backend: an exact rasteriser in pure torch, with shading and visibility gradients."""

from __future__ import annotations

from typing import TYPE_CHECKING

from styleexp.renderers.soft_raster import boxes, raster
from styleexp.renderers.soft_raster.deferred import DeferredRenderer, Projected

if TYPE_CHECKING:
    from styleexp.renderers.soft_raster.raster import Visible


class SoftRaster(DeferredRenderer):
    """Visibility in pure torch; see ``DeferredRenderer`` for the rest.

    On the CPU, results and gradients are bitwise reproducible. On a GPU the gradients aren't: they
    are summed by float atomics.
    """

    def find_visible(self, projected: Projected) -> Visible:
        """Rasterise watertightly; ties go to the lowest face index."""
        on_cpu = projected.points.device.type == "cpu"
        return (raster if on_cpu else boxes).rasterise(
            projected.points,
            projected.corners,
            projected.pairs,
            projected.near,
            projected.resolution,
        )
