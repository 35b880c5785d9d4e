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
    mesh's own relief, for a picture, which doesn't tell, 0.05, both at the pattern's size."""
    patch: float = 0.6
    """Mesh styles: radius of the patch that the height map is taken from, in the style's radii."""
    sharpness: float = 8.0
    """Power of the normal's components by which the three projections are blended."""


@dataclass
class SynthesisConfig:
    """The style's relief laid on by example, the default; see docs/synthesis.md."""

    name: str = "synthesis"
    bank: int = 10_000
    """Patches that are taken of the style at each scale."""
    flatten: float = 0.0
    """Share of the source's own relief, 0 to 1, that is taken off where it is as fine as the
    pattern: for a source whose bumps hide it."""


@dataclass
class GeometricTexturesConfig:
    """A GAN on triangles, after Hertz et al. 2020. Sizes are for a CPU."""

    name: str = "geometric_textures"
    levels: int = 3
    """Of subdivision; each has four times the faces of the one before."""
    base: int = 1000
    """Vertices of the exemplar at its lowest level. The source gets triangles of the same size, at
    the size that ``style.scale`` gives the pattern."""
    iterations: int = 20
    """Updates of the generator in each of ``optim.steps`` steps."""
    critic_steps: int = 2
    """Updates of the critic before each."""
    patch: int = 1500
    """Faces of the exemplar that one update looks at."""
    width: int = 32
    """Channels of the networks."""
    depth: int = 4
    """Face convolutions of each network."""


def _geometric_textures(config: GeometricTexturesConfig) -> Method:
    from styleexp.baselines.geometric_textures import GeometricTextures

    return GeometricTextures(config)


def _displacement_map(config: DisplacementMapConfig) -> Method:
    from styleexp.baselines.displacement_map import DisplacementMap

    return DisplacementMap(config)


def _synthesis(config: SynthesisConfig) -> Method:
    from styleexp.synthesis.method import Synthesis

    return Synthesis(config)


# field.sigma tells how far source.refine=auto goes.
BASELINES: dict[str, Spec] = {
    "displacement_map": Spec(
        "displacement_map",
        "a height map of the style laid on by triplanar projection: no learning, no steps",
        DisplacementMapConfig,
        _displacement_map,
        reads=("field.sigma",),
    ),
    "geometric_textures": Spec(
        "geometric_textures",
        "a GAN on triangles, level by level (Hertz et al. 2020); mesh styles only",
        GeometricTexturesConfig,
        _geometric_textures,
        reads=("field.sigma", "optim.steps", "optim.rate", "optim.checkpoint_every"),
    ),
    "synthesis": Spec(
        "synthesis",
        "the relief laid on by example, patch by patch (texture synthesis on the surface): seconds",
        SynthesisConfig,
        _synthesis,
        reads=("field.sigma", "field.unfold"),
    ),
}
