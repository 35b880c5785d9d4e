"""Options of the methods other than the learned one. Imports nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass

from styleexp.system.options import option


@dataclass
class DisplacementMapConfig:
    """A height map applied to the source by triplanar projection."""

    name: str = "displacement_map"
    height: float | None = option(None, between=(0, 1))
    """Half the range of the relief, in radii of the normalised source. null: that of the style
    mesh's own relief, or 0.05 for an image, both scaled with the pattern."""
    patch: float = option(0.6, between=(0.05, 0.95))
    """Mesh styles: radius of the patch that the height map is taken from, in radii of the style."""
    sharpness: float = option(8.0, between=(1, 64))
    """Exponent of the normal's components in the blend of the three projections."""


@dataclass
class SynthesisConfig:
    """Texture synthesis of the style's relief on the source (default); see docs/synthesis.md."""

    name: str = "synthesis"
    bank: int = option(10_000, between=(500, 200_000))
    """Number of patches sampled from the style at each scale."""


@dataclass
class GeometricTexturesConfig:
    """A GAN on triangles, after Hertz et al. 2020. Default sizes are for a CPU."""

    name: str = "geometric_textures"
    levels: int = option(3, between=(1, 6))
    """Number of subdivision levels; each has four times the faces of the one before."""
    base: int = option(1000, between=(50, 50_000))
    """Vertices of the exemplar at its lowest level. The source gets triangles of the same size
    relative to the pattern, see ``style.scale``."""
    iterations: int = option(20, between=(1, 10_000))
    """Generator updates per step (``optim.steps``)."""
    critic_steps: int = option(2, between=(1, 20))
    """Critic updates per generator update."""
    patch: int = option(1500, between=(100, 1_000_000))
    """Faces of the exemplar per update."""
    width: int = option(32, between=(4, 512))
    """Channels of the networks."""
    depth: int = option(4, between=(1, 16))
    """Face convolutions of each network."""
