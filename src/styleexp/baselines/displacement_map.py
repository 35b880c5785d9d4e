"""Baseline that only applies the style's height map: see `styleexp.height_maps`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from styleexp.errors import UserError
from styleexp.height_maps import displacement
from styleexp.masks import masked
from styleexp.scene import load
from styleexp.stylize import Result, Step

if TYPE_CHECKING:
    from styleexp.baselines.specs import DisplacementMapConfig
    from styleexp.config import Config
    from styleexp.scene import Subject


class DisplacementMap:
    """The displacement-map baseline: see the module."""

    def __init__(self, config: DisplacementMapConfig):
        self.config = config
        if config.height is not None and not 0 <= config.height <= 1:
            raise UserError(f"baseline.height={config.height} is not allowed: give 0 to 1.")
        if not 0.05 <= config.patch <= 0.95:
            raise UserError(f"baseline.patch={config.patch} is not allowed: give 0.05 to 0.95.")
        if not 1 <= config.sharpness <= 64:
            raise UserError(f"baseline.sharpness={config.sharpness} is not allowed: give 1 to 64.")

    def prepare(self, config: Config) -> Subject:
        """Load source and style; needs neither renderer nor encoder."""
        return load(config)

    def start(self, scene: Subject) -> None:
        """Return None: there are no steps."""

    def optimise(self, scene: Subject, state: None) -> Iterator[Step]:
        """Yield nothing: there are no steps."""
        return iter(())

    def finish(self, scene: Subject, state: None) -> Result:
        """Displace the source by the map, with zero mean over the surface."""
        options = self.config
        raised = displacement(scene, options.height, options.patch, options.sharpness).double()
        raised = masked(raised, scene.mask)
        moved = raised.cpu().numpy() * scene.config.strength * scene.frame.scale
        offset = moved[:, None] * scene.surface.normals.double().cpu().numpy()
        return Result(scene, moved, scene.source.vertices + offset)
