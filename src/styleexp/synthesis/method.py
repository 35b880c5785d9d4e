"""``method=synthesis``: the style's relief laid on the source by example. See the package."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
import torch

from styleexp import attributes, height_maps
from styleexp.attributes import ATTRIBUTE
from styleexp.errors import UserError
from styleexp.fields import zero_mean
from styleexp.geometry import unfolded
from styleexp.masks import masked
from styleexp.relief import half_range, smoother
from styleexp.scene import load
from styleexp.stages import doing
from styleexp.stylize import Result, Step
from styleexp.synthesis.direction import FLOW, UP, direction_field, turned
from styleexp.synthesis.exemplar import MeshExemplar, Pattern, PictureExemplar, measure
from styleexp.synthesis.optimise import Level, synthesise
from styleexp.synthesis.room import ball_radius
from styleexp.synthesis.shape import exemplar_of
from styleexp.synthesis.walk import Sheet

if TYPE_CHECKING:
    from jaxtyping import Float

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
ROOM = 0.6
"""The relief may take up this share of the room inside and outside the surface."""


class Synthesis:
    """The method: see the module."""

    def __init__(self, config: SynthesisConfig):
        self.config = config
        if not 500 <= config.bank <= 200_000:
            raise UserError(f"baseline.bank={config.bank} is not allowed: give 500 to 200000.")

    def prepare(self, config: Config) -> Subject:
        """Source and style; neither renderer nor encoder."""
        return load(config, lambda style: exemplar_of(style, config.style.relief_length))

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
        rng = np.random.default_rng(scene.config.optim.seed)
        doing("measuring the style's pattern")
        exemplar = exemplar_of_style(scene)
        pattern = measure(exemplar, rng)
        surface = scene.surface
        sheet = Sheet(
            surface.vertices.cpu().numpy(), scene.source.faces, surface.normals.cpu().numpy()
        )
        directed = pattern.directed > DIRECTED
        ahead = directions(scene, sheet, directed)
        levels = levels_of(pattern, sheet.edge / scene.unit)
        print(told(scene, pattern, directed, levels), flush=True)

        height = torch.zeros(len(sheet.vertices))
        total = sum(level.rounds for level in levels)
        for number, height in synthesise(  # noqa: B007  the last is the result
            sheet, ahead, exemplar, levels, scene.unit, not directed, rng, most=self.config.bank
        ):
            doing(f"laying the relief, round {number} of {total}")
        displacement = height.double() * scene.unit * scene.config.strength
        displacement *= torch.from_numpy(fade(sheet, half_range(displacement.numpy())))
        displacement = zero_mean(displacement, scene.weights.cpu().double(), math.inf)
        displacement = masked(displacement, scene.mask)
        if scene.config.field.unfold:
            displacement = unfolded(surface, displacement.to(surface.vertices.device)).cpu()
        moved = displacement.numpy() * scene.frame.scale
        offset = moved[:, None] * surface.normals.double().cpu().numpy()
        return Result(scene, moved, scene.source.vertices + offset)


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
