"""``method=synthesis``: the style's relief laid on the source by example. See the package."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np
import torch

from styleexp import attributes, height_maps
from styleexp.attributes import ATTRIBUTE
from styleexp.errors import UserError
from styleexp.fields import zero_mean
from styleexp.geometry import unfolded
from styleexp.masks import masked
from styleexp.relief import half_range, mesh_relief, smoother
from styleexp.scene import load
from styleexp.stages import doing, tell
from styleexp.stylize import Result, Step
from styleexp.synthesis.direction import FLOW, UP, direction_field, turned
from styleexp.synthesis.exemplar import MeshExemplar, Pattern, PictureExemplar, measure
from styleexp.synthesis.optimise import Level, synthesise
from styleexp.synthesis.room import ball_radius
from styleexp.synthesis.shape import exemplar_of
from styleexp.synthesis.walk import Sheet

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from styleexp import meshes
    from styleexp.baselines.specs import SynthesisConfig
    from styleexp.config import Config
    from styleexp.scene import Subject

DIRECTED = 0.25
"""A `Pattern.directed` above this has a direction."""
PER_WAVE = 5.4
"""Samples on a wavelength at the coarsest level. What is larger than a patch of so many samples the
quilt has decided already; coarser patches would smooth it away."""
COARSEST = 0.06
"""Longest spacing of a patch's samples, in units of the pattern: larger pieces of the quilt fit on
few parts of a mesh."""
ROUNDS = (10, 6, 3)
"""Of the levels, from coarse to fine."""
EVEN = 1.5
"""Edges: what is finer is taken off the relief, or steep walls between them would be saws."""
ROOM = 0.6
"""The relief may take up this share of the room inside and outside the surface."""


class Synthesis:
    """The method: see the module."""

    def __init__(self, config: SynthesisConfig):
        self.config = config
        if not 500 <= config.bank <= 200_000:
            raise UserError(f"baseline.bank={config.bank} is not allowed: give 500 to 200000.")
        if not 0 <= config.flatten <= 1:
            raise UserError(f"baseline.flatten={config.flatten} is not allowed: give 0 to 1.")

    def prepare(self, config: Config) -> Subject:
        """Source and style; neither renderer nor encoder."""
        return load(config, relief_of(config))

    def start(self, scene: Subject) -> None:
        """There are no steps that a checkpoint could stand between."""

    def optimise(self, scene: Subject, state: None) -> Iterator[Step]:
        """No step."""
        return iter(())

    def finish(self, scene: Subject, state: None) -> Result:
        """Displace the source by the relief; zero on average over the surface."""
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
    """What tells a style mesh's relief from its shape: see `scene.load`."""
    return lambda style: exemplar_of(style, config.style.relief_length)


def relief(scene: Subject, config: SynthesisConfig, strength: float) -> Float[Tensor, " vertices"]:
    """The style's relief on the source's vertices, ``strength`` times as high, in radii of the
    normalised source; zero on average over the surface."""
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
        doing(f"laying the relief, round {number} of {total}")
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
    """Which way the pattern's up points at each vertex: see `config.StyleConfig`."""
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
    """The style as an example; a picture's heights are ``scene.relief`` high."""
    if scene.example is not None:
        return scene.example
    tile = height_maps.height_map(scene, height_maps.PATCH)
    pixel = tile.side / max(tile.height.shape) / scene.unit
    return PictureExemplar(tile.height.cpu() * (scene.relief / scene.unit), pixel)


def levels_of(pattern: Pattern, edge: float) -> list[Level]:
    """Spacings from the pattern's wavelength down to the mesh's edges (in units of the pattern),
    halved from level to level."""
    coarsest = min(pattern.wavelength / PER_WAVE, COARSEST)
    spacings = [coarsest / 2**number for number in range(len(ROUNDS))]
    carried = [each for each in spacings[1:] if each >= 0.8 * edge]
    return [Level(*each) for each in zip([coarsest, *carried], ROUNDS, strict=False)]


def told(scene: Subject, pattern: Pattern, directed: bool, levels: list[Level]) -> str:
    """What was measured of the style, in one line."""
    name = scene.config.style.path or scene.config.style.name
    return (
        f"'{name}': wavelength {pattern.wavelength * scene.unit:.3f} and height "
        f"{(pattern.high - pattern.low) * scene.unit:.3f} radii of the source, "
        f"{'with' if directed else 'without'} a direction; {len(levels)} levels"
    )


def fade(sheet: Sheet, height: float) -> Float[np.ndarray, " vertices"]:
    """A factor on a relief of half range ``height``, below 1 where it would meet the surface's
    other side, or the next finger's."""
    reach = 2 * height / ROOM
    room = np.minimum(ball_radius(sheet, -1, reach), ball_radius(sheet, 1, reach))
    factor = (ROOM * room / max(height, 1e-12)).clip(0, 1)
    return smoother(sheet.vertices, sheet.faces, 4 * height + sheet.edge)(factor).clip(0, 1)
