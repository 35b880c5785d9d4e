"""``method=synthesis``: synthesise the style's relief on the source; see the package."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from styleexp.inputs import attributes
from styleexp.inputs.attributes import ATTRIBUTE
from styleexp.method import height_maps
from styleexp.method.base import Method, Result, Scene, displaced
from styleexp.method.fields import zero_mean
from styleexp.method.masks import masked
from styleexp.method.relief import half_range, heat_smoother
from styleexp.method.surface import unfolded
from styleexp.method.synthesis.direction import FLOW, UP, direction_field, turned
from styleexp.method.synthesis.exemplar import MeshExemplar, Pattern, PictureExemplar, pattern_of
from styleexp.method.synthesis.optimise import ROUNDS, synthesise
from styleexp.method.synthesis.room import ball_radius
from styleexp.method.synthesis.walk import Sheet
from styleexp.system.progress import doing, tell

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from styleexp.method.base import State
    from styleexp.method.baselines.options import SynthesisConfig
    from styleexp.method.subject import Subject
    from styleexp.method.synthesis.exemplar import Exemplar

DIRECTED = 0.25
"""A pattern has a direction if its `Pattern.directed` exceeds this, or its `Pattern.coherence` the
next."""
COHERENT = 0.3
PER_WAVE = 5.4
"""Samples per wavelength at the coarsest level. The quilt already determines everything larger than
a patch at this spacing; coarser patches would smooth it away."""
COARSEST = 0.06
"""Maximum sample spacing, in units of the pattern; larger quilt pieces fit on few parts of a
mesh."""
MOST_LEVELS = 5
EVEN = 1.5
"""Smoothing length in edges; removes finer relief, which would turn steep walls into sawteeth."""
OWN = 1.5
"""Features of the source smaller than this, in wavelengths, give way to the style's relief."""
THIN = 0.3
"""Radius inside the source, relative to the size of such features, at which none give way; at twice
that, all."""
POINTS = 5_000
"""Maximum number of vertices at which that radius is measured."""
ROOM = 0.6
"""Maximum fraction of the free space inside and outside the surface that the relief may use."""


@dataclass(frozen=True)
class Synthesis(Method[Scene]):
    """The synthesis method: see the package. It has no steps."""

    config: SynthesisConfig
    separates_relief: bool = True

    def finish(self, scene: Scene, state: State | None) -> Result:
        """Displace the source by the relief, with zero mean over the surface."""
        subject = scene.subject
        if subject.smooth:
            still = np.zeros(len(subject.source.vertices))
            return Result(subject, still, subject.source.vertices.copy())
        begun = begin(subject)
        ahead = directions(subject, begun)
        height = deque(heights(subject, begun, ahead, self.config), maxlen=1).pop()
        return replace(self.laid(subject, begun, height), directions=ahead)

    def laid(self, subject: Subject, begun: Begun, height: Float[Tensor, " vertices"]) -> Result:
        """Displace the source by these heights; see `heights`."""
        found = displacement(subject, begun, height, subject.settings.strength)
        found = masked(found, subject.mask)
        if subject.settings.field.unfold:
            found = unfolded(subject.surface, found)
        return displaced(subject, found)


@dataclass(frozen=True)
class Begun:
    """What the synthesis starts from: the style's pattern, and the source to put it on."""

    exemplar: Exemplar
    pattern: Pattern
    sheet: Sheet

    @property
    def directed(self) -> bool:
        """Whether the pattern has a direction."""
        return self.pattern.directed > DIRECTED or self.pattern.coherence > COHERENT


def relief(
    subject: Subject, config: SynthesisConfig, strength: float
) -> Float[Tensor, " vertices"]:
    """The style's relief at the source's vertices, scaled by ``strength``, in radii of the
    normalised source, with zero mean over the surface."""
    begun = begin(subject)
    rounds = heights(subject, begun, directions(subject, begun), config)
    height = deque(rounds, maxlen=1).pop()
    return displacement(subject, begun, height, strength)


def begin(subject: Subject) -> Begun:
    """Measure the style's pattern, and prepare the source for walking."""
    doing("measuring the style's pattern")
    exemplar = exemplar_of_style(subject)
    pattern = pattern_of(exemplar)
    surface = subject.surface
    sheet = Sheet(
        surface.vertices.cpu().numpy(), subject.source.faces, surface.normals.cpu().numpy()
    )
    return Begun(exemplar, pattern, sheet)


def heights(
    subject: Subject,
    begun: Begun,
    ahead: Float[np.ndarray, "vertices 3"],
    config: SynthesisConfig,
) -> Iterator[Float[Tensor, " vertices"]]:
    """Synthesise the pattern on the source, its up along ``ahead`` (see `directions`): the
    vertices' heights, in units of the pattern, after the quilt and every round. The last are the
    result."""
    levels = levels_of(begun.pattern, begun.sheet.edge / subject.unit)
    tell(summary(subject, begun.pattern, begun.directed, levels))
    total = ROUNDS * len(levels)
    found = synthesise(
        begun.sheet, ahead, begun.exemplar, levels, subject.unit, any_way(subject, begun.directed),
        subject.settings.optim.seed, most=config.bank,
    )  # fmt: skip
    for number, height in found:
        if number:
            doing(f"synthesising the relief, round {number} of {total}")
        yield height


def displacement(
    subject: Subject,
    begun: Begun,
    height: Float[Tensor, " vertices"],
    strength: float,
) -> Float[Tensor, " vertices"]:
    """Heights as displacements, scaled by ``strength``, in radii of the normalised source: faded
    where there is no room, with zero mean over the surface."""
    sheet = begun.sheet
    even = heat_smoother(sheet.vertices, sheet.faces, EVEN * sheet.edge)
    moved = torch.from_numpy(even(height.numpy())) * subject.unit * strength
    high = half_range(moved.numpy())
    moved *= torch.from_numpy(fade(sheet, high))
    length = OWN * begun.pattern.wavelength * subject.unit
    moved -= torch.from_numpy(own_relief(sheet, length, high))
    moved = zero_mean(moved, subject.weights.cpu().double(), math.inf)
    return moved.to(subject.surface.vertices.device)


def directions(subject: Subject, begun: Begun) -> Float[np.ndarray, "vertices 3"]:
    """Direction of the pattern's up at each vertex; see `options.StyleConfig`."""
    style, sheet = subject.settings.style, begun.sheet
    name = style.direction
    if name.startswith(ATTRIBUTE):
        wish = attributes.vectors(subject.source, name.removeprefix(ATTRIBUTE), "style.direction")
    else:
        axis = "xyz".index(name) if name in "xyz" else 1
        wish = np.broadcast_to(np.eye(3)[axis], sheet.vertices.shape)
    follows = name == "flow" or (name == "auto" and not begun.directed)
    ahead = direction_field(sheet, wish, FLOW if follows else UP)
    return turned(ahead, sheet.normals, math.radians(style.rotation))


def any_way(subject: Subject, directed: bool) -> bool:
    """Whether the style's patches are taken in any rotation: a pattern without a direction, unless
    the user gave it one."""
    return not directed and subject.settings.style.direction == "auto"


def exemplar_of_style(subject: Subject) -> MeshExemplar | PictureExemplar:
    """The style as an exemplar; an image's heights are scaled to ``subject.relief``."""
    if subject.example is not None:
        return subject.example
    tile = height_maps.height_map(subject, height_maps.PATCH)
    pixel = tile.side / max(tile.height.shape) / subject.unit
    return PictureExemplar(tile.height.cpu() * (subject.relief / subject.unit), pixel)


def levels_of(pattern: Pattern, edge: float) -> list[float]:
    """Sample spacings from the pattern's wavelength down to the mesh's edge length (in units of
    the pattern), halved from level to level."""
    coarsest = min(pattern.wavelength / PER_WAVE, COARSEST)
    spacings = [coarsest / 2**number for number in range(MOST_LEVELS)]
    return [spacings[0], *(each for each in spacings[1:] if each >= 0.8 * edge)]


def summary(subject: Subject, pattern: Pattern, directed: bool, levels: list[float]) -> str:
    """One-line summary of the style's measurements."""
    name = subject.style.name
    return (
        f"'{name}': wavelength {pattern.wavelength * subject.unit:.3f} and height "
        f"{(pattern.high - pattern.low) * subject.unit:.3f} radii of the source, "
        f"{'with' if directed else 'without'} a direction; {len(levels)} levels"
    )


def own_relief(sheet: Sheet, length: float, height: float) -> Float[np.ndarray, " vertices"]:
    """The source's own relief: features smaller than ``length``, and no higher than about
    ``height``. The style's takes its place; on top of plates and folds of the same size no pattern
    can be made out. 0 where the source is thin, as at fingertips, which would wither."""
    smooth = heat_smoother(sheet.vertices, sheet.faces, length)
    above = ((sheet.vertices - smooth(sheet.vertices)) * sheet.normals).sum(axis=1)
    above -= heat_smoother(sheet.vertices, sheet.faces, 3 * length)(above)  # of the form's bends
    # Few points are enough, and the medial axis is where looking for the nearest is slowest.
    some = np.arange(0, len(above), math.ceil(len(above) / POINTS))
    few = Sheet(sheet.vertices[some], sheet.faces[:0], sheet.normals[some])
    wide = (ball_radius(few, -1, length) / length / THIN - 1).clip(0, 1)
    wide = wide[few.nearest(sheet.vertices)]
    return height * np.tanh(above / max(height, 1e-12)) * smooth(wide).clip(0, 1)


def fade(sheet: Sheet, height: float) -> Float[np.ndarray, " vertices"]:
    """Factor on a relief of half range ``height``; below 1 where it would reach the opposite side
    of the surface or a neighbouring part."""
    reach = 2 * height / ROOM
    room = np.minimum(ball_radius(sheet, -1, reach), ball_radius(sheet, 1, reach))
    factor = (ROOM * room / max(height, 1e-12)).clip(0, 1)
    return heat_smoother(sheet.vertices, sheet.faces, 4 * height + sheet.edge)(factor).clip(0, 1)
