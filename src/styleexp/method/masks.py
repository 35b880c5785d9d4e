"""Masks (``style.mask``): a factor from 0 to 1 on the relief at each source vertex.

A mask is evaluated on the refined source, before displacement. Vertices where it is 0 stay bit for
bit in place.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from styleexp.inputs import attributes
from styleexp.inputs.meshes.mesh import at_vertices, face_areas, normalisation, vertex_normals
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from styleexp.inputs.meshes import Mesh
    from styleexp.method.options import StyleConfig

CHANNELS = ("r", "g", "b", "a", "luminance")
OF_THE_FILE = ("attribute", "color", "texture")
"""Mask kinds that need data stored with a file's vertices."""
KNOWN = (
    "attribute:NAME, color:r|g|b|a|luminance, texture:FILE, slope:DEGREES, height:LOW..HIGH or "
    "near:X/Y/Z/RADIUS, with the prefix not: to invert it"
)
NUMBER = r"-?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?"
BALL = rf"({NUMBER})/({NUMBER})/({NUMBER})/({NUMBER})"
ROUNDING = 1e-6
"""Tolerance within which mask values snap to 0 or 1."""
CELLS = 8
"""Grid cells per border width; smoothing merges vertices that share a cell."""


@dataclass(frozen=True)
class Term:
    """One of the masks that are multiplied."""

    text: str
    """The term as the user wrote it."""
    kind: str
    value: str
    inverted: bool


def parsed(mask: Any) -> list[Term]:
    """Parse the terms of ``style.mask``. Raises `UserError` for an invalid one."""
    if mask is None:
        return []
    given = list(mask) if isinstance(mask, Sequence) and not isinstance(mask, str) else [mask]
    if not given:
        raise UserError("style.mask=[] is empty: leave it out to use the whole surface.")
    return [_term(each) for each in given]


def files(mask: Any) -> list[str]:
    """Image files named in ``style.mask``, in order."""
    return [term.value for term in parsed(mask) if term.kind == "texture"]


def with_files(mask: Any, paths: Sequence[str]) -> Any:
    """Copy of a mask with its image paths replaced, in order."""
    found = iter(paths)
    texts = [
        f"{'not:' * term.inverted}texture:{next(found)}" if term.kind == "texture" else term.text
        for term in parsed(mask)
    ]
    return texts[0] if isinstance(mask, str) else texts or None


def check(config: StyleConfig, source: Mesh) -> None:
    """Raise `UserError` if the source lacks data that ``style.mask`` or ``style.direction``
    needs."""
    for term in parsed(config.mask):
        _values(term, source)
    if config.direction.startswith(attributes.ATTRIBUTE):
        name = config.direction.removeprefix(attributes.ATTRIBUTE)
        attributes.vectors(source, name, "style.direction")


def weights(config: StyleConfig, source: Mesh) -> Float[np.ndarray, " vertices"]:
    """``style.mask`` at the source's vertices, 0 to 1: the product of its terms, with borders
    smoothed over ``style.falloff``. Raises `UserError` if it selects nothing."""
    factor: np.ndarray = np.ones(len(source.vertices))
    for term in parsed(config.mask):
        factor = factor * _values(term, source)
    if not factor.any():
        terms = ", ".join(term.text for term in parsed(config.mask))
        raise UserError(
            f"style.mask={terms} selects no vertex of the source '{source.name}': give a mask that "
            "is above 0 somewhere."
        )
    return softened(source, factor, config.falloff)


def masked(
    displacement: Float[Tensor, " vertices"], mask: Float[Tensor, " vertices"] | None
) -> Float[Tensor, " vertices"]:
    """Multiply the displacement by the mask; None means 1 everywhere."""
    return displacement if mask is None else displacement * mask.to(displacement)


def softened(
    mesh: Mesh, factor: Float[np.ndarray, " vertices"], width: float
) -> Float[np.ndarray, " vertices"]:
    """Area-weighted mean of a factor within ``width / 2`` of each vertex, in radii of the
    normalised mesh. A step becomes a smooth border of that width.

    Uniform factors stay bit-identical, zeros farther than that from any other value stay 0, and
    complementary factors stay complementary. Surfaces that face away are ignored, so that the two
    sides of a thin part don't mix.
    """
    from scipy.spatial import cKDTree

    if width == 0 or np.ptp(factor) == 0:
        return factor
    points = normalisation(mesh.vertices).apply(mesh.vertices)
    normals = vertex_normals(points, mesh.faces)
    thirds = np.repeat(face_areas(points, mesh.faces) / 3, 3)
    areas = np.bincount(mesh.faces.ravel(), thirds, minlength=len(points)) + 1e-12
    # Merge vertices of one cell whose normals are in the same octant.
    cells = np.floor(points * (CELLS / width)).astype(np.int64)
    cells = np.column_stack([cells, normals > 0])
    _, of = np.unique(cells, axis=0, return_inverse=True)
    of = of.ravel()
    total = np.bincount(of, areas)
    centre, facing = (
        np.stack([np.bincount(of, areas * each[:, k]) for k in range(3)], 1) / total[:, None]
        for each in (points, normals)
    )
    low, high = np.full(len(total), np.inf), np.full(len(total), -np.inf)
    np.minimum.at(low, of, factor)
    np.maximum.at(high, of, factor)
    mean = np.clip(np.bincount(of, areas * factor) / total, low, high)  # uniform cells stay uniform
    tree, half = cKDTree(centre), width / 2
    result = np.empty(len(points))
    for some in np.array_split(np.arange(len(points)), max(1, len(points) // 20_000)):
        pairs = cKDTree(points[some]).sparse_distance_matrix(tree, half, output_type="ndarray")
        i, j = some[pairs["i"]], pairs["j"]
        weight = (1 - (pairs["v"] / half) ** 2).clip(0) ** 2 * total[j]
        weight *= (normals[i] * facing[j]).sum(1).clip(0)
        sums = np.bincount(pairs["i"], weight, minlength=len(some))
        means = np.bincount(pairs["i"], weight * mean[j], minlength=len(some))
        result[some] = np.where(sums > 0, means / np.where(sums > 0, sums, 1), factor[some])
    return result.clip(0, 1)


def _term(given: Any) -> Term:
    text = str(given)
    rest = text.removeprefix("not:")
    kind, colon, value = rest.partition(":")
    known = colon and value and kind in (*OF_THE_FILE, "slope", "height", "near")
    if not isinstance(given, str) or not known:
        raise UserError(f"style.mask={text} is not a mask: give {KNOWN}.")
    if kind == "color" and value not in CHANNELS:
        raise UserError(f"style.mask={text} is not allowed: give color:{'|'.join(CHANNELS)}.")
    if kind == "slope" and not 0 < _number(value) < 180:
        raise UserError(f"style.mask={text} is not allowed: give slope: and 0 to 180 degrees.")
    if kind == "height":
        _band(text, value)
    if kind == "near":
        _balls(text, value)
    return Term(text, kind, value, text != rest)


def _number(text: str) -> float:
    """Parse a number; NaN if the text isn't one."""
    return float(text) if re.fullmatch(r"\d+\.?\d*|\.\d+", text) else float("nan")


def _band(text: str, value: str) -> tuple[float, float]:
    low, _, high = value.partition("..")
    if not 0 <= _number(low) < _number(high) <= 1:
        raise UserError(
            f"style.mask={text} is not allowed: give height:LOW..HIGH in fractions of the source's "
            "height, such as height:0.5..1 for its upper half."
        )
    return _number(low), _number(high)


def _balls(text: str, value: str) -> Float[np.ndarray, "balls 4"]:
    """Centres and radii of balls, ``X/Y/Z/RADIUS`` joined by ``+``."""
    balls = np.array(re.findall(BALL, value), dtype=np.float64)
    if not re.fullmatch(rf"{BALL}(?:\+{BALL})*", value) or not (balls[:, 3] > 0).all():
        raise UserError(
            f"style.mask={text} is not allowed: give near:X/Y/Z/RADIUS in the source's own "
            "coordinates, the radius above 0; several are joined by +."
        )
    return balls


def _values(term: Term, source: Mesh) -> Float[np.ndarray, " vertices"]:
    """Evaluate a term at the source's vertices, 0 to 1."""
    found = {
        "attribute": _attribute,
        "color": _color,
        "texture": _texture,
        "slope": _slope,
        "height": _height,
        "near": _near,
    }[term.kind](term, source)
    # Snap values that differ from 0 or 1 by rounding, so that no relief leaks out.
    found = np.where(found < ROUNDING, 0.0, np.where(found > 1 - ROUNDING, 1.0, found))
    return 1 - found if term.inverted else found


def _attribute(term: Term, source: Mesh) -> np.ndarray:
    values = attributes.numbers(source, term.value, "style.mask")
    low, high = values.min(), values.max()
    if low < -ROUNDING or high > 1 + ROUNDING:
        raise UserError(
            f"style.mask={term.text}: its values in '{source.name}' range from {low:g} to "
            f"{high:g}, but a mask must be in 0 to 1: rescale them in the program that wrote them."
        )
    return values.clip(0, 1)


def _color(term: Term, source: Mesh) -> np.ndarray:
    from styleexp.inputs.images import luminance

    colors = None if source.carrier is None else source.carrier.colors
    if colors is None:
        raise UserError(
            f"style.mask={term.text}: the source '{source.name}' has no vertex colours; paint "
            "some, or use another mask."
        )
    values = at_vertices(source, colors / 255)
    if term.value == "luminance":
        return luminance(values).clip(0, 1)
    return values[:, CHANNELS.index(term.value)]


def _texture(term: Term, source: Mesh) -> np.ndarray:
    from styleexp.inputs.images import load_image, luminance

    uv = None if source.carrier is None else source.carrier.uv
    if uv is None:
        raise UserError(
            f"style.mask={term.text}: the source '{source.name}' has no texture coordinates; "
            "unwrap it, or use another mask."
        )
    picture = luminance(load_image(term.value, background=0.0))
    return at_vertices(source, sampled(picture, uv)[:, None])[:, 0].clip(0, 1)


def sampled(
    picture: Float[np.ndarray, "height width"], uv: Float[np.ndarray, "points 2"]
) -> Float[np.ndarray, " points"]:
    """Sample an image at texture coordinates: bilinear, repeated outside [0, 1] (without blending
    opposite borders); row 0 is at v = 1."""
    rows, columns = picture.shape
    uv = np.where((uv >= 0) & (uv <= 1), uv, uv - np.floor(uv))
    y, x = (1 - uv[:, 1]) * rows - 0.5, uv[:, 0] * columns - 0.5
    top, left = np.floor(y).astype(np.int64), np.floor(x).astype(np.int64)
    down, right = y - top, x - left

    def at(row: np.ndarray, column: np.ndarray) -> np.ndarray:
        return picture[row.clip(0, rows - 1), column.clip(0, columns - 1)].astype(np.float64)

    upper = (1 - right) * at(top, left) + right * at(top, left + 1)
    lower = (1 - right) * at(top + 1, left) + right * at(top + 1, left + 1)
    return (1 - down) * upper + down * lower


def _slope(term: Term, source: Mesh) -> np.ndarray:
    up = vertex_normals(source.vertices, source.faces)[:, 1]
    return (up >= np.cos(np.radians(_number(term.value)))).astype(np.float64)


def _height(term: Term, source: Mesh) -> np.ndarray:
    low, high = _band(term.text, term.value)
    y = source.vertices[:, 1]
    share = (y - y.min()) / (np.ptp(y) or 1.0)
    return ((share >= low) & (share <= high)).astype(np.float64)


def _near(term: Term, source: Mesh) -> np.ndarray:
    from scipy.spatial import cKDTree

    inside = np.zeros(len(source.vertices))
    tree = cKDTree(source.vertices)
    for *centre, radius in _balls(term.text, term.value):
        inside[tree.query_ball_point(centre, radius)] = 1.0
    return inside
