"""Baseline that only applies the style's height map: see `styleexp.method.height_maps`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from styleexp.method.gram import Result, Step
from styleexp.method.height_maps import displacement
from styleexp.method.masks import masked
from styleexp.method.scene import load
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from styleexp.config.schema import Config
    from styleexp.method.baselines.specs import DisplacementMapConfig
    from styleexp.method.scene import Subject


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
