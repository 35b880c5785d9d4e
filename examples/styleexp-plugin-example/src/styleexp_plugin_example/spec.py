"""What styleexp reads at every start: keep it light, no torch here."""

from dataclasses import dataclass

from styleexp.plugins.spec import Spec


@dataclass
class Options:
    """Options of ``example_normals``."""

    name: str = "example_normals"
    turn: float = 120.0
    """Degrees about the viewing axis from one colour's light to the next."""


def _build(options: Options):
    from styleexp_plugin_example.renderer import Normals

    return Normals(options.turn)


EXAMPLE_NORMALS = Spec("example_normals", "normals as colours: three lights", Options, _build)
