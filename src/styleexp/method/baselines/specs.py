"""The built-in baselines, by name. Imports none of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from styleexp.plugins.spec import Spec

if TYPE_CHECKING:
    from styleexp.method.baselines import Method


@dataclass
class DisplacementMapConfig:
    """A height map applied to the source by triplanar projection."""

    name: str = "displacement_map"
    height: float | None = None
    """Half the range of the relief, in radii of the normalised source. null: that of the style
    mesh's own relief, or 0.05 for an image, both scaled with the pattern."""
    patch: float = 0.6
    """Mesh styles: radius of the patch that the height map is taken from, in radii of the style."""
    sharpness: float = 8.0
    """Exponent of the normal's components in the blend of the three projections."""


@dataclass
class SynthesisConfig:
    """Texture synthesis of the style's relief on the source (default); see docs/synthesis.md."""

    name: str = "synthesis"
    bank: int = 10_000
    """Number of patches sampled from the style at each scale."""
    flatten: float = 0.0
    """Fraction of the source's own relief to remove, 0 to 1, at scales as fine as the pattern: for
    a source whose bumps hide the pattern."""


@dataclass
class GeometricTexturesConfig:
    """A GAN on triangles, after Hertz et al. 2020. Default sizes are for a CPU."""

    name: str = "geometric_textures"
    levels: int = 3
    """Number of subdivision levels; each has four times the faces of the one before."""
    base: int = 1000
    """Vertices of the exemplar at its lowest level. The source gets triangles of the same size
    relative to the pattern, see ``style.scale``."""
    iterations: int = 20
    """Generator updates per step (``optim.steps``)."""
    critic_steps: int = 2
    """Critic updates per generator update."""
    patch: int = 1500
    """Faces of the exemplar per update."""
    width: int = 32
    """Channels of the networks."""
    depth: int = 4
    """Face convolutions of each network."""


def _geometric_textures(config: GeometricTexturesConfig) -> Method:
    from styleexp.method.baselines.geometric_textures import GeometricTextures

    return GeometricTextures(config)


def _displacement_map(config: DisplacementMapConfig) -> Method:
    from styleexp.method.baselines.displacement_map import DisplacementMap

    return DisplacementMap(config)


def _synthesis(config: SynthesisConfig) -> Method:
    from styleexp.method.synthesis.method import Synthesis

    return Synthesis(config)


# source.refine=auto depends on field.sigma.
BASELINES: dict[str, Spec] = {
    "displacement_map": Spec(
        "displacement_map",
        "the style's height map, applied by triplanar projection: no learning, no steps",
        DisplacementMapConfig,
        _displacement_map,
        reads=("field.sigma", "field.unit"),
    ),
    "geometric_textures": Spec(
        "geometric_textures",
        "a GAN on triangles, level by level (Hertz et al. 2020); mesh styles only",
        GeometricTexturesConfig,
        _geometric_textures,
        reads=("field.sigma", "field.unit", "optim.steps", "optim.rate", "optim.checkpoint_every"),
    ),
    "synthesis": Spec(
        "synthesis",
        "the style's relief by texture synthesis on the surface, patch by patch: seconds",
        SynthesisConfig,
        _synthesis,
        reads=("field.sigma", "field.unit", "field.unfold"),
    ),
}
