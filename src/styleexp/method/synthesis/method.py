"""``method=synthesis``: synthesise the style's relief on the source; see the package."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np
import torch

from styleexp.inputs import attributes
from styleexp.inputs.attributes import ATTRIBUTE
from styleexp.method import height_maps
from styleexp.method.fields import zero_mean
from styleexp.method.gram import Result, Step
from styleexp.method.masks import masked
from styleexp.method.relief import half_range, mesh_relief, smoother
from styleexp.method.scene import load
from styleexp.method.surface import unfolded
from styleexp.method.synthesis.direction import FLOW, UP, direction_field, turned
from styleexp.method.synthesis.exemplar import MeshExemplar, Pattern, PictureExemplar, measure
from styleexp.method.synthesis.optimise import Level, synthesise
from styleexp.method.synthesis.room import ball_radius
from styleexp.method.synthesis.shape import exemplar_of
from styleexp.method.synthesis.walk import Sheet
from styleexp.system.errors import UserError
from styleexp.system.progress import doing, tell

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from styleexp.config.schema import Config
    from styleexp.inputs import meshes
    from styleexp.method.baselines.specs import SynthesisConfig
    from styleexp.method.scene import Subject

DIRECTED = 0.25
"""A pattern has a direction if its `Pattern.directed` exceeds this."""
PER_WAVE = 5.4
"""Samples per wavelength at the coarsest level. The quilt already determines everything larger than
a patch at this spacing; coarser patches would smooth it away."""
COARSEST = 0.06
"""Maximum sample spacing, in units of the pattern; larger quilt pieces fit on few parts of a
mesh."""
ROUNDS = (10, 6, 3)
"""Rounds per level, from coarse to fine."""
EVEN = 1.5
"""Smoothing length in edges; removes finer relief, which would turn steep walls into sawteeth."""
ROOM = 0.6
"""Maximum fraction of the free space inside and outside the surface that the relief may use."""


class Synthesis:
    """The synthesis method: see the module."""

    def __init__(self, config: SynthesisConfig):
        self.config = config
        if not 500 <= config.bank <= 200_000:
            raise UserError(f"baseline.bank={config.bank} is not allowed: give 500 to 200000.")
        if not 0 <= config.flatten <= 1:
            raise UserError(f"baseline.flatten={config.flatten} is not allowed: give 0 to 1.")

    def prepare(self, config: Config) -> Subject:
        """Load source and style; needs neither renderer nor encoder."""
        return load(config, relief_of(config))

    def start(self, scene: Subject) -> None:
        """Return None: there are no steps to checkpoint."""

    def optimise(self, scene: Subject, state: None) -> Iterator[Step]:
        """Yield nothing: there are no steps."""
        return iter(())

    def finish(self, scene: Subject, state: None) -> Result:
        """Displace the source by the relief, with zero mean over the surface."""
        if scene.smooth:
            still = np.zeros(len(scene.source.vertices))
            return Result(scene, still, scene.source.vertices.copy())
        surface = scene.surface
        displacement = relief(scene, self.config, scene.config.strength)
        displacement = masked(displacement, scene.mask)
        if scene.config.field.unfold:
            displacement = unfolded(surface, displacement)
        moved = displacement.cpu().numpy() * scene.frame.scale
        offset = moved[:, None] * surface.normals.double().cpu().numpy()
        return Result(scene, moved, scene.source.vertices + offset)


def relief_of(config: Config) -> Callable[[meshes.Mesh], MeshExemplar | None]:
    """Function that separates a style mesh's relief from its shape; see `scene.load`."""
    return lambda style: exemplar_of(style, config.style.relief_length)


def relief(scene: Subject, config: SynthesisConfig, strength: float) -> Float[Tensor, " vertices"]:
    """The style's relief at the source's vertices, scaled by ``strength``, in radii of the
    normalised source, with zero mean over the surface."""
    rng = np.random.default_rng(scene.config.optim.seed)
    doing("measuring the style's pattern")
    exemplar = exemplar_of_style(scene)
    pattern = measure(exemplar, rng)
    surface = scene.surface
    sheet = Sheet(surface.vertices.cpu().numpy(), scene.source.faces, surface.normals.cpu().numpy())
    directed = pattern.directed > DIRECTED
    ahead = directions(scene, sheet, directed)
    levels = levels_of(pattern, sheet.edge / scene.unit)
    tell(told(scene, pattern, directed, levels))

    height = torch.zeros(len(sheet.vertices))
    total = sum(level.rounds for level in levels)
    for number, height in synthesise(  # noqa: B007  the last is the result
        sheet, ahead, exemplar, levels, scene.unit, not directed, rng, most=config.bank
    ):
        doing(f"synthesising the relief, round {number} of {total}")
    even = smoother(sheet.vertices, sheet.faces, EVEN * sheet.edge)
    height = torch.from_numpy(even(height.numpy()))
    displacement = height * scene.unit * strength
    displacement *= torch.from_numpy(fade(sheet, half_range(displacement.numpy())))
    if config.flatten:
        own = mesh_relief(
            sheet.vertices, sheet.faces, sheet.normals, pattern.wavelength * scene.unit
        )
        most = float(displacement.abs().max())
        displacement -= config.flatten * torch.from_numpy(own.clip(-most, most))
    displacement = zero_mean(displacement, scene.weights.cpu().double(), math.inf)
    return displacement.to(surface.vertices.device)


def directions(scene: Subject, sheet: Sheet, directed: bool) -> Float[np.ndarray, "vertices 3"]:
    """Direction of the pattern's up at each vertex; see `config.StyleConfig`."""
    style = scene.config.style
    name = style.direction
    if name.startswith(ATTRIBUTE):
        wish = attributes.vectors(scene.source, name.removeprefix(ATTRIBUTE), "style.direction")
    else:
        axis = "xyz".index(name) if name in "xyz" else 1
        wish = np.broadcast_to(np.eye(3)[axis], sheet.vertices.shape)
    follows = name == "flow" or (name == "auto" and not directed)
    ahead = direction_field(sheet, wish, FLOW if follows else UP)
    return turned(ahead, sheet.normals, math.radians(style.rotation))


def exemplar_of_style(scene: Subject) -> MeshExemplar | PictureExemplar:
    """The style as an exemplar; an image's heights are scaled to ``scene.relief``."""
    if scene.example is not None:
        return scene.example
    tile = height_maps.height_map(scene, height_maps.PATCH)
    pixel = tile.side / max(tile.height.shape) / scene.unit
    return PictureExemplar(tile.height.cpu() * (scene.relief / scene.unit), pixel)


def levels_of(pattern: Pattern, edge: float) -> list[Level]:
    """Levels with spacings from the pattern's wavelength down to the mesh's edge length (in units
    of the pattern), halved from level to level."""
    coarsest = min(pattern.wavelength / PER_WAVE, COARSEST)
    spacings = [coarsest / 2**number for number in range(len(ROUNDS))]
    carried = [each for each in spacings[1:] if each >= 0.8 * edge]
    return [Level(*each) for each in zip([coarsest, *carried], ROUNDS, strict=False)]


def told(scene: Subject, pattern: Pattern, directed: bool, levels: list[Level]) -> str:
    """One-line summary of the style's measurements."""
    name = scene.config.style.path or scene.config.style.name
    return (
        f"'{name}': wavelength {pattern.wavelength * scene.unit:.3f} and height "
        f"{(pattern.high - pattern.low) * scene.unit:.3f} radii of the source, "
        f"{'with' if directed else 'without'} a direction; {len(levels)} levels"
    )


def fade(sheet: Sheet, height: float) -> Float[np.ndarray, " vertices"]:
    """Factor on a relief of half range ``height``; below 1 where it would reach the opposite side
    of the surface or a neighbouring part."""
    reach = 2 * height / ROOM
    room = np.minimum(ball_radius(sheet, -1, reach), ball_radius(sheet, 1, reach))
    factor = (ROOM * room / max(height, 1e-12)).clip(0, 1)
    return smoother(sheet.vertices, sheet.faces, 4 * height + sheet.edge)(factor).clip(0, 1)
