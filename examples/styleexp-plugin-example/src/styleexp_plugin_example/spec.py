"""What styleexp reads at every start: keep it light, no torch here."""

from dataclasses import dataclass

from styleexp.plugins import FieldConfig, LossConfig, Spec, option


@dataclass
class NormalsOptions:
    """Options of ``example_normals``."""

    name: str = "example_normals"
    turn: float = option(120.0, between=(-360, 360))
    """Degrees about the viewing axis from one colour's light to the next."""


@dataclass
class MomentsOptions(LossConfig):
    """Options of ``example_moments``."""

    name: str = "example_moments"
    spread: float = option(1.0, between=(0, 100))
    """Weight of the features' mean square beside their mean."""


@dataclass
class WavesOptions(FieldConfig):
    """Options of ``example_waves``."""

    name: str = "example_waves"
    count: int = option(512, between=(1, 100_000))
    """Number of waves."""


def _normals(options):
    from styleexp_plugin_example.renderer import Normals

    return Normals(options.turn)


def _moments(options, *, encoder):
    from styleexp_plugin_example.loss import Moments

    return Moments(encoder, options.layers, options.spread)


def _waves(options, *, points, generator, sigma, bound):
    from styleexp_plugin_example.field import Waves

    return Waves(options.count, generator, sigma, bound)


EXAMPLE_NORMALS = Spec(
    "example_normals", "normals as colours: three lights", NormalsOptions, _normals
)
EXAMPLE_MOMENTS = Spec(
    "example_moments", "mean and mean square of every feature", MomentsOptions, _moments
)
EXAMPLE_WAVES = Spec("example_waves", "a sum of plane waves, no network", WavesOptions, _waves)
