"""The built-in baselines, by name. Imports none of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from styleexp.registry import Spec

if TYPE_CHECKING:
    from styleexp.baselines import Method


@dataclass
class DisplacementMapConfig:
    """A height map laid on the source by triplanar projection."""

    name: str = "displacement_map"
    height: float | None = None
    """Half the range of the relief, in radii of the normalised source. null: that of the style
    mesh's own relief at the pattern's size; for a picture, which doesn't tell, 0.05."""
    patch: float = 0.6
    """Mesh styles: radius of the patch that the height map is taken from, in the style's radii."""
    sharpness: float = 8.0
    """Power of the normal's components by which the three projections are blended."""


def _displacement_map(config: DisplacementMapConfig) -> Method:
    from styleexp.baselines.displacement_map import DisplacementMap

    return DisplacementMap(config)


BASELINES: dict[str, Spec] = {
    "displacement_map": Spec(
        "displacement_map",
        "a height map of the style laid on by triplanar projection: no learning, no steps",
        DisplacementMapConfig,
        _displacement_map,
    ),
}
