"""Where the relief goes: ``style.mask``, a factor from 0 to 1 at each of the source's vertices.

A mask is read of the source as it is displaced: after it was refined, before it gets its relief.
Where it is 0 vertices stay where they are, to the last bit.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from styleexp import attributes
from styleexp.errors import UserError
from styleexp.meshes.mesh import at_vertices, face_areas, normalisation, vertex_normals

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from styleexp.config import StyleConfig
    from styleexp.meshes import Mesh

CHANNELS = ("r", "g", "b", "a", "luminance")
OF_THE_FILE = ("attribute", "color", "texture")
"""Masks that need what only a file's own vertices have."""
KNOWN = (
    "attribute:NAME, color:r|g|b|a|luminance, texture:FILE, slope:DEGREES or height:LOW..HIGH, "
    "with not: in front for the rest"
)
ROUNDING = 1e-6
"""What a mask may be off by 0 or 1 and still be taken for it."""
CELLS = 8
"""On a border's width: vertices that share a cell are one where a mask is smoothed."""


@dataclass(frozen=True)
class Term:
    """One of the masks that are multiplied."""

    text: str
    """As it was given."""
    kind: str
    value: str
    inverted: bool


def parsed(mask: Any) -> list[Term]:
    """The terms of ``style.mask``. Raises `UserError` for what is none."""
    if mask is None:
        return []
    given = list(mask) if isinstance(mask, Sequence) and not isinstance(mask, str) else [mask]
    if not given:
        raise UserError("style.mask=[] holds no mask: leave it out for the whole surface.")
    return [_term(each) for each in given]


def files(mask: Any) -> list[str]:
    """The pictures that ``style.mask`` names, in its order."""
    return [term.value for term in parsed(mask) if term.kind == "texture"]


def with_files(mask: Any, paths: Sequence[str]) -> Any:
    """The same mask with other paths of its pictures, in its order."""
    found = iter(paths)
    texts = [
        f"{'not:' * term.inverted}texture:{next(found)}" if term.kind == "texture" else term.text
        for term in parsed(mask)
    ]
    return texts[0] if isinstance(mask, str) else texts or None


def check(config: StyleConfig, source: Mesh) -> None:
    """Raise `UserError` where the source lacks what ``style.mask`` or ``style.direction`` needs."""
    for term in parsed(config.mask):
        _values(term, source)
    if config.direction.startswith(attributes.ATTRIBUTE):
        name = config.direction.removeprefix(attributes.ATTRIBUTE)
        attributes.vectors(source, name, "style.direction")


def weights(config: StyleConfig, source: Mesh) -> Float[np.ndarray, " vertices"]:
    """``style.mask`` at the source's vertices, 0 to 1: the product of its terms, its borders
    smoothed over ``style.falloff``. Raises `UserError` where it selects nothing."""
    factor: np.ndarray = np.ones(len(source.vertices))
    for term in parsed(config.mask):
        factor = factor * _values(term, source)
    if not factor.any():
        told = ", ".join(term.text for term in parsed(config.mask))
        raise UserError(
            f"style.mask={told} selects no vertex of the source '{source.name}': give a mask that "
            "is above 0 somewhere."
        )
    return softened(source, factor, config.falloff)


def masked(
    displacement: Float[Tensor, " vertices"], mask: Float[Tensor, " vertices"] | None
) -> Float[Tensor, " vertices"]:
    """The displacement within the mask; None is everywhere."""
    return displacement if mask is None else displacement * mask.to(displacement)


def softened(
    mesh: Mesh, factor: Float[np.ndarray, " vertices"], width: float
) -> Float[np.ndarray, " vertices"]:
    """A factor's mean around each vertex, by area, within half of ``width`` (in radii of the
    normalised mesh): a step becomes a smooth border of that width.

    What is uniform stays as it is to the last bit, 0 farther from any other value than that too,
    and what is 1 minus another factor stays so. Surfaces that face away don't count, so that a
    thin part's other side doesn't.
    """
    from scipy.spatial import cKDTree

    if width == 0 or np.ptp(factor) == 0:
        return factor
    points = normalisation(mesh.vertices).apply(mesh.vertices)
    normals = vertex_normals(points, mesh.faces)
    thirds = np.repeat(face_areas(points, mesh.faces) / 3, 3)
    areas = np.bincount(mesh.faces.ravel(), thirds, minlength=len(points)) + 1e-12
    # Vertices of one cell that face the same octant are one.
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
    mean = np.clip(np.bincount(of, areas * factor) / total, low, high)  # uniform cells stay so
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
    known = colon and value and kind in (*OF_THE_FILE, "slope", "height")
    if not isinstance(given, str) or not known:
        raise UserError(f"style.mask={text} is no mask: give {KNOWN}.")
    if kind == "color" and value not in CHANNELS:
        raise UserError(f"style.mask={text} is not allowed: give color:{'|'.join(CHANNELS)}.")
    if kind == "slope" and not 0 < _number(value) < 180:
        raise UserError(f"style.mask={text} is not allowed: give slope: and 0 to 180 degrees.")
    if kind == "height":
        _band(text, value)
    return Term(text, kind, value, text != rest)


def _number(text: str) -> float:
    """NaN where the text is no number."""
    return float(text) if re.fullmatch(r"\d+\.?\d*|\.\d+", text) else float("nan")


def _band(text: str, value: str) -> tuple[float, float]:
    low, _, high = value.partition("..")
    if not 0 <= _number(low) < _number(high) <= 1:
        raise UserError(
            f"style.mask={text} is not allowed: give height:LOW..HIGH in shares of the source's "
            "height, as in height:0.5..1 for its upper half."
        )
    return _number(low), _number(high)


def _values(term: Term, source: Mesh) -> Float[np.ndarray, " vertices"]:
    """A term at the source's vertices, 0 to 1."""
    found = {
        "attribute": _attribute,
        "color": _color,
        "texture": _texture,
        "slope": _slope,
        "height": _height,
    }[term.kind](term, source)
    # What is 0 or 1 but for rounding is so, or the relief would go where it shouldn't.
    found = np.where(found < ROUNDING, 0.0, np.where(found > 1 - ROUNDING, 1.0, found))
    return 1 - found if term.inverted else found


def _attribute(term: Term, source: Mesh) -> np.ndarray:
    values = attributes.numbers(source, term.value, "style.mask")
    low, high = values.min(), values.max()
    if low < -ROUNDING or high > 1 + ROUNDING:
        raise UserError(
            f"style.mask={term.text}: its values in '{source.name}' go from {low:g} to {high:g}, "
            "and a mask's from 0 to 1: scale them in the program that wrote them."
        )
    return values.clip(0, 1)


def _color(term: Term, source: Mesh) -> np.ndarray:
    from styleexp.images import luminance

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
    from styleexp.images import load_image, luminance

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
    """A picture at texture coordinates, bilinear, repeated beyond [0, 1] (but one border
    does not shine into the other); row 0 is at v = 1."""
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
