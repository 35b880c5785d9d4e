"""Validation of the metrics on results whose style is known by construction.

Each analytic style's relief is applied directly to every source at its own scale, by triplanar
projection, without rendering or learning. Distractors are added: the same style at half and double
scale, at a quarter of its height, noise of the same energy and frequency, the plain source, and a
shrunken one. A style metric must rank the true style nearest, find no style where there is none,
and prefer the right scale. Since optimisation never yields the pure style, it should also recognise
it at half height, with noise, and in patches; and turned, as a relief that follows limbs is.

Images have a separate board. An image's true relief is unknown, so the method's assumption is used:
bright is high.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from styleexp.config.compose import compose
from styleexp.config.schema import Config
from styleexp.experiments.metrics import bank_for
from styleexp.experiments.metrics.likeness import Bank, likeness
from styleexp.experiments.metrics.style import (
    LAYERS,
    Looks,
    appearance_distance,
    gram_distance,
    height_grams,
    judged,
    judged_picture,
    judged_plain,
    relief_distance,
    style_distance,
)
from styleexp.inputs import meshes, shapes
from styleexp.inputs.images import luminance
from styleexp.inputs.style import Style
from styleexp.method import pictures
from styleexp.method.height_maps import HeightMap, triplanar
from styleexp.method.losses import gram_matrix, layer_mask
from styleexp.method.options import FieldConfig, StyleConfig
from styleexp.method.patches import WINDOW, Relief, relief_of_mesh, relief_of_result, windows
from styleexp.method.pattern_size import pattern_unit
from styleexp.method.subject import choose_field
from styleexp.method.views import orbit
from styleexp.plugins import load_encoder
from styleexp.renderers.base import Shading
from styleexp.renderers.soft_raster import SoftRaster

if TYPE_CHECKING:
    from jaxtyping import Float

    from styleexp.encoders import Encoder
    from styleexp.experiments.metrics.style import Grams

SHARPNESS = 6
"""Exponent of the normal's components in the blend of the three projections."""
BELT = 0.9
"""Latitude range around the style's equator, in radians; mirrored beyond."""
SHRINKAGE = 0.03
"""Shrinkage of the shrunken source, in radii."""
PATCHES = 0.8
"""Frequency of a patchy result's patches, in cycles per radius of the source; half is covered."""
IMPERFECT = ("low", "noisy", "patchy")
TURN = math.radians(60)
"""Angle of the turned style. No analytic style but ``buckyball`` is alike after it."""
PICTURE_RELIEF = 0.03
"""RMS height of an image applied to a source, in pattern units."""
PICTURE_FREQUENCY = 3.0
"""Frequency of the noise distractor, in cycles per pattern."""
ENOUGH = 0.95
"""Fraction of cases in which a metric must be right to be kept."""


@dataclass(frozen=True)
class Sample:
    """Inputs of a candidate metric."""

    looks: Looks
    """Features by the judging encoder."""
    random: Grams
    """Grams of the height images, by an encoder with random weights."""
    views: Grams
    """Grams of whole renders, foreground only."""
    laid: tuple[Relief, float] | None = None
    """A result's heights above its source, and the pattern's size there."""
    bank: Bank | None = None
    """A style's patches."""


@dataclass
class Board:
    """All cases, measured."""

    styles: dict[str, Sample] = field(default_factory=dict)
    plain: Sample | None = None
    own: dict[str, Sample] = field(default_factory=dict)
    """Samples of the plain sources, by name."""
    cases: dict[tuple[str, str, str], Sample] = field(default_factory=dict)
    """Samples by source, style and variant."""


Metric = Callable[[Sample, Sample, Sample, Sample], float]
"""Distance from samples of a result, a style, a surface without relief, and the plain source."""

CANDIDATES: dict[str, Metric] = {
    "style_distance": lambda r, s, p, own: style_distance(r.looks, s.looks, p.looks),
    "relief_distance": lambda r, s, p, own: relief_distance(r.looks, s.looks) or 0.0,
    "appearance_distance": lambda r, s, p, own: appearance_distance(r.looks, s.looks),
    "unlikeness": lambda r, s, p, own: _unlikeness(r, s),
    "gram_distance": lambda r, s, p, own: gram_distance(r.looks, s.looks, p.looks),
    "random_gram_distance": lambda r, s, p, own: _ratio(r.random, s.random, p.random),
    "view_distance": lambda r, s, p, own: _ratio(r.views, s.views, own.views),
}
"""Candidate metrics; smaller is nearer. ``unlikeness`` is 1 - `likeness`. The last three are only
for comparison."""


PICTURE_CANDIDATES = {
    name: CANDIDATES[name] for name in ("style_distance", "relief_distance", "appearance_distance")
}
"""Candidate metrics that work for images."""


def wrapped(
    name: str,
    points: Float[np.ndarray, "points 3"],
    normals: Float[np.ndarray, "points 3"],
    unit: float,
    rng: np.random.Generator,
    angle: float = 0.0,
) -> Float[np.ndarray, " points"]:
    """An analytic style's relief on another surface; ``unit`` is the style's radius there.

    The style's sphere is unrolled around its equator onto each of three planes, and the three
    heights are blended by the normal; +Y stays up where possible, or is turned by ``angle``
    radians.
    """
    weights = np.abs(normals) ** SHARPNESS
    weights /= weights.sum(axis=1, keepdims=True)
    total = np.zeros(len(points))
    for axis, (right, up, turn) in enumerate(((2, 1, -1.0), (0, 2, -1.0), (0, 1, 1.0))):
        side = np.where(normals[:, axis] < 0, -turn, turn)
        across, along = side * points[:, right] / unit, points[:, up] / unit
        across, along = (
            math.cos(angle) * across - math.sin(angle) * along,
            math.sin(angle) * across + math.cos(angle) * along,
        )
        longitude = across + rng.uniform(0, 2 * math.pi)
        rolled = np.mod(along + rng.uniform(0, 4 * BELT), 4 * BELT)
        latitude = np.where(rolled < 2 * BELT, rolled - BELT, 3 * BELT - rolled)
        directions = np.stack(
            [
                np.sin(longitude) * np.cos(latitude),
                np.sin(latitude),
                np.cos(longitude) * np.cos(latitude),
            ],
            axis=1,
        )
        seen = weights[:, axis] > 1e-3
        total[seen] += weights[seen, axis] * shapes.relief(name, directions[seen])
    return unit * total


def noise(
    points: Float[np.ndarray, "points 3"], frequency: float, rng: np.random.Generator
) -> Float[np.ndarray, " points"]:
    """A random field with this many cycles per unit length and RMS 1."""
    waves = rng.normal(size=(256, 3)) * frequency * 2 * math.pi
    total = np.cos(points @ waves.T + rng.uniform(0, 2 * math.pi, 256)).sum(axis=1)
    total -= total.mean()
    return total / total.std()


def cases(
    source: meshes.Mesh, style: str, unit: float, frequency: float, seed: int
) -> Iterator[tuple[str, Float[np.ndarray, " vertices"]]]:
    """Yield (variant, displacement of every vertex in radii) for a source in the unit sphere.

    ``frequency`` is the style's, in cycles per radius of the style.
    """
    rng = np.random.default_rng(seed)
    normals = meshes.vertex_normals(source.vertices, source.faces)

    def laid(unit: float, angle: float = 0.0) -> Float[np.ndarray, " vertices"]:
        return wrapped(style, source.vertices, normals, unit, rng, angle)

    yield from _variants(laid, source.vertices, unit, frequency, rng)
    yield "turned", laid(unit, TURN)


def picture_cases(
    source: meshes.Mesh, picture: Float[np.ndarray, "height width 3"], unit: float, seed: int
) -> Iterator[tuple[str, Float[np.ndarray, " vertices"]]]:
    """Yield (variant, displacement) for an image: its brightness as height, by triplanar
    projection."""
    rng = np.random.default_rng(seed)
    normals = meshes.vertex_normals(source.vertices, source.faces)
    height = luminance(torch.from_numpy(picture))
    edge = meshes.mean_edge_length(source.vertices, source.faces)
    points = torch.from_numpy(source.vertices + rng.uniform(0, 5, 3)).float()
    up = torch.from_numpy(normals).float()

    def laid(unit: float) -> Float[np.ndarray, " vertices"]:
        side = math.sqrt(4 * math.pi) * unit
        tile = pictures.resized(height, min(side / edge, max(height.shape)))
        tile = (tile - tile.mean()) / tile.std().clamp(min=1e-6)
        found = triplanar(HeightMap(tile, side), points, up, SHARPNESS)
        return PICTURE_RELIEF * unit * found.double().numpy()

    yield from _variants(laid, source.vertices, unit, PICTURE_FREQUENCY, rng)


def _variants(
    laid: Callable[[float], Float[np.ndarray, " vertices"]],
    points: Float[np.ndarray, "vertices 3"],
    unit: float,
    frequency: float,
    rng: np.random.Generator,
) -> Iterator[tuple[str, Float[np.ndarray, " vertices"]]]:
    """Yield a relief, ``laid`` at its own scale, and its distractors."""
    true = laid(unit)
    yield "true", true
    yield "faint", 0.25 * true
    yield "half", laid(unit / 2)
    yield "double", laid(unit * 2)
    yield "noise", true.std() * noise(points, frequency / unit, rng)
    yield "shrunken", np.full(len(true), -SHRINKAGE)
    yield "low", 0.5 * true
    yield "noisy", 0.7 * true + 0.5 * true.std() * noise(points, frequency / unit, rng)
    yield "patchy", true / (1 + np.exp(-6 * noise(points, PATCHES, rng)))


def measure_board(
    sources: list[meshes.Mesh], judge: str, count: int, report: Callable[[str], None]
) -> Board:
    """Apply every style to every source, with distractors, and measure with the encoders."""
    encoder = load_encoder(judge)
    random = load_encoder("vgg19_random")

    def sample(
        relief: Relief, unit: float, vertices: np.ndarray, faces: np.ndarray, **more: Any
    ) -> Sample:
        return Sample(
            judged(relief, unit, encoder, count),
            height_grams(random, windows(relief, WINDOW * unit, count)),
            _view_grams(encoder, vertices, faces),
            **more,
        )

    board = Board()
    meshes_of = {name: shapes.make(name) for name in shapes.RELIEFS}
    frequencies = {
        name: choose_field(FieldConfig(), Style.of(mesh))[0] for name, mesh in meshes_of.items()
    }
    for name, style in meshes_of.items():
        vertices = meshes.normalisation(style.vertices).apply(style.vertices)
        bank = bank_for(compose([f"style={name}"]), style, Style.of(style), {})
        board.styles[name] = sample(relief_of_mesh(style), 1.0, vertices, style.faces, bank=bank)
    height = judged_plain(random).height
    assert height is not None
    board.plain = Sample(judged_plain(encoder), height, [])
    for number, given in enumerate(sources):
        frame = meshes.normalisation(given.vertices)
        source = meshes.Mesh(given.name, frame.apply(given.vertices), given.faces)
        normals = meshes.vertex_normals(source.vertices, source.faces)
        still = Relief(source.vertices, source.faces, np.zeros(len(normals)))
        board.own[given.name] = sample(still, 1.0, source.vertices, source.faces)
        for style_number, (name, style) in enumerate(meshes_of.items()):
            unit = pattern_unit(StyleConfig(), source, Style.of(style))
            seed = 100 * number + style_number
            for what, moved in cases(source, name, unit, frequencies[name], seed):
                vertices = source.vertices + moved[:, None] * normals
                relief = relief_of_result(source, vertices, source.faces, unit)
                laid = (Relief(source.vertices, source.faces, moved), unit)
                board.cases[given.name, name, what] = sample(
                    relief, unit, vertices, source.faces, laid=laid
                )
            report(f"{given.name}, {name}")
    return board


def measure_pictures(
    sources: list[meshes.Mesh],
    pictures: dict[str, Float[np.ndarray, "height width 3"]],
    judge: str,
    count: int,
    report: Callable[[str], None],
) -> Board:
    """Apply every image to every source, with distractors; see `measure_board`."""
    encoder = load_encoder(judge)
    board, span = Board(), StyleConfig().image_tile * math.sqrt(4 * math.pi)
    for name, picture in pictures.items():
        looks = judged_picture(picture, Config(), span, encoder)
        board.styles[name] = Sample(looks, [], [])
    board.plain = Sample(judged_plain(encoder), [], [])
    for number, given in enumerate(sources):
        frame = meshes.normalisation(given.vertices)
        source = meshes.Mesh(given.name, frame.apply(given.vertices), given.faces)
        normals = meshes.vertex_normals(source.vertices, source.faces)
        board.own[given.name] = board.plain
        for picture_number, (name, picture) in enumerate(pictures.items()):
            seed = 100 * number + picture_number
            unit = pattern_unit(StyleConfig(), source, Style.of(picture, name))
            for what, moved in picture_cases(source, picture, unit, seed):
                vertices = source.vertices + moved[:, None] * normals
                relief = relief_of_result(source, vertices, source.faces, unit)
                looks = judged(relief, unit, encoder, count)
                board.cases[given.name, name, what] = Sample(looks, [], [])
            report(f"{given.name}, {name}")
    return board


def judge_metrics(
    board: Board, candidates: dict[str, Metric] = CANDIDATES
) -> dict[str, dict[str, Any]]:
    """How often each candidate is right, as fractions of the cases.

    ``rank1``: the true style is nearest. ``scale``: the style at its own scale is nearer than at
    half and double. ``noise``, ``strength``: it is nearer than noise, and than at a quarter of its
    height. ``no_style``: the shrunken source is farther than the true result and, for ratio
    metrics, within a tenth of 1. ``imperfect``: like ``rank1``, for results at half height, with
    noise, in patches; ``turned``: for turned ones, if there are any. ``confusions`` lists the
    errors for the true style.
    """
    return {name: _verdict(metric, board) for name, metric in candidates.items()}


def _verdict(metric: Metric, board: Board) -> dict[str, Any]:
    right = dict.fromkeys(("rank1", "scale", "noise", "strength", "no_style"), 0)
    recognised, turned = 0, list[bool]()
    confusions = []
    true = [key for key in board.cases if key[2] == "true"]
    plain = board.plain
    assert plain is not None
    ratio = metric not in (CANDIDATES["relief_distance"], CANDIDATES["appearance_distance"])
    for source, style, _ in true:

        def far(what: str, goal: str = "", source: str = source, style: str = style) -> float:
            found = board.cases[source, style, what]
            return metric(found, board.styles[goal or style], plain, board.own[source])

        def nearest_to(what: str, far: Callable[..., float] = far) -> str:
            return min(board.styles, key=lambda goal: far(what, goal))

        value = far("true")
        nearest = nearest_to("true")
        recognised += sum(nearest_to(what) == style for what in IMPERFECT)
        if (source, style, "turned") in board.cases:
            turned.append(nearest_to("turned") == style)
        right["rank1"] += nearest == style
        right["scale"] += value < min(far("half"), far("double"))
        right["noise"] += value < far("noise")
        right["strength"] += value < far("faint")
        nothing = far("shrunken")
        right["no_style"] += nothing > value and (not ratio or abs(nothing - 1) < 0.1)
        if nearest != style:
            confusions.append(f"{source}: {style} mistaken for {nearest}")
    shares = {key: count / len(true) for key, count in right.items()}
    shares["imperfect"] = recognised / (len(true) * len(IMPERFECT))
    if turned:
        shares["turned"] = sum(turned) / len(turned)
    kept = min(shares["rank1"], shares["scale"], shares["no_style"]) >= ENOUGH
    return {**shares, "kept": kept, "confusions": confusions}


@torch.no_grad()
def _view_grams(encoder: Encoder, vertices: np.ndarray, faces: np.ndarray) -> Grams:
    """Grams of six whole views, foreground only and eroded, as in a run's loss."""
    azimuth = torch.arange(6) * (math.pi / 3) + 0.3
    cameras = orbit(torch.full_like(azimuth, 0.2), azimuth, 2.0, 60.0)
    shading = Shading(normals="smooth", background=0.35, outlines=False)
    out = SoftRaster().render(
        torch.from_numpy(vertices).float(), torch.from_numpy(faces), cameras, shading, (224, 224)
    )
    features = encoder(out.image.permute(0, 3, 1, 2).expand(-1, 3, -1, -1), list(LAYERS))
    return [
        gram_matrix(f.float(), layer_mask(out.coverage, (f.shape[2], f.shape[3]), erosion=2))
        for f in (features[layer] for layer in LAYERS)
    ]


def _unlikeness(result: Sample, style: Sample) -> float:
    """1 minus the result's mean likeness; 1 on a plain source."""
    if result.laid is None:
        return 1.0
    assert style.bank is not None
    return 1.0 - float(likeness(style.bank, *result.laid).carried.mean())


def _ratio(result: Grams, style: Grams, own: Grams) -> float:
    parts = [
        (a - b).square().sum() / (o - b).square().sum().clamp(min=1e-20)
        for a, b, o in zip(result, style, own, strict=True)
    ]
    return float(torch.stack(parts).mean())
