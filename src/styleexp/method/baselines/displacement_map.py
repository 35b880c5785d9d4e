"""Baseline that only applies the style's height map: see `height_maps`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from styleexp.method.base import Method, Result, Scene, displaced
from styleexp.method.height_maps import displacement
from styleexp.method.masks import masked

if TYPE_CHECKING:
    from styleexp.method.base import State
    from styleexp.method.baselines.options import DisplacementMapConfig


@dataclass(frozen=True)
class DisplacementMap(Method[Scene]):
    """The displacement-map baseline: see the module. It has no steps."""

    config: DisplacementMapConfig

    def finish(self, scene: Scene, state: State | None) -> Result:
        """Displace the source by the map, with zero mean over the surface."""
        subject, options = scene.subject, self.config
        raised = displacement(subject, options.height, options.patch, options.sharpness).double()
        return displaced(subject, masked(raised, subject.mask) * subject.settings.strength)
