"""Initialise the synthesis with a quilt: large pieces of the exemplar, side by side on the mesh."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.spatial import cKDTree

from styleexp.method.patches import blurred
from styleexp.method.synthesis.exemplar import sampled

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from scipy.sparse import csr_matrix
    from torch import Tensor

    from styleexp.method.synthesis.exemplar import Exemplar
    from styleexp.method.synthesis.walk import Sheet

SIDE = 25
"""Samples per piece side."""
APART = 0.45
"""Distance between pieces on the mesh, in piece sides; smaller where a first round left gaps."""
SAME_WAY = 0.2
"""Cosine between normals below which a vertex faces away from a piece: a piece ends where a limb
turns away from it."""
MARGIN = 6
"""Margin of samples around a piece, for patches at its rim."""
MOST_SAMPLES = 3_000_000
"""Maximum number of samples of all pieces together."""
LABELS = 2
"""Maximum number of pieces per vertex."""
SWEEPS = 4
"""Rounds in which every piece is chosen again."""
LEAST_SEEN = 60
"""Minimum number of samples that a piece must share with its neighbours to be chosen by them."""


@dataclass(frozen=True)
class Quilt:
    """Position of each vertex on the exemplar."""

    pieces: Float[Tensor, "pieces samples samples"]
    spacing: float
    """Sample spacing of the pieces, in units of the pattern."""
    piece: Int[Tensor, "vertices labels"]
    place: Float[Tensor, "vertices labels 2"]
    """Offset down and right from the piece's centre, in units of the pattern."""
    turn: Float[Tensor, "vertices labels 2"]
    """Cosine and sine of the clockwise angle from the piece's up to the vertex's."""

    def patches(
        self, vertices: Int[Tensor, " some"], side: int, spacing: float
    ) -> Float[Tensor, "some labels cells"]:
        """The exemplar around these vertices, in their own frames, for each of their labels."""
        pieces = self.pieces
        if spacing > self.spacing:
            pieces = blurred(pieces, 0.45 * spacing / self.spacing)
        line = (torch.arange(side) - side // 2) * spacing
        down, right = (each.flatten() for each in torch.meshgrid(line, line, indexing="ij"))
        cos, sin = self.turn[vertices, :, :1], self.turn[vertices, :, 1:]
        y = self.place[vertices, :, :1] + cos * down + sin * right
        x = self.place[vertices, :, 1:] - sin * down + cos * right
        return _bilinear(pieces, self.piece[vertices], y / self.spacing, x / self.spacing)

    def heights(self) -> Float[Tensor, " vertices"]:
        """The exemplar at each vertex, by its first label."""
        return self.patches(torch.arange(len(self.piece)), 1, self.spacing)[:, 0, 0]


def quilt(
    sheet: Sheet,
    ahead: Float[np.ndarray, "vertices 3"],
    exemplar: Exemplar,
    spacing: float,
    finest: float,
    unit: float,
    any_way: bool,
    seed: int,
    choice: int,
) -> Quilt:
    """Cover the mesh with pieces of the exemplar, each chosen to match those already placed (after
    Efros and Freeman 2001; Praun et al. 2000). Then every piece is chosen again, to match all its
    neighbours: the last ones close gaps between others that were chosen without them.

    The synthesis can preserve, but not find, structures larger than its patches, such as bricks or
    the offset of rows. ``spacing`` is the sample spacing for comparing pieces, ``finest`` that of
    the stored pieces. ``choice`` pieces are tried at each position.
    """
    known, places = sampled(exemplar, choice, SIDE, spacing, (seed,), any_way)
    rng = np.random.default_rng(seed)
    choices = _Choices(known.flatten(1).numpy())
    pieces = choices.pieces
    step = spacing * unit
    count = len(sheet.vertices)
    height = np.zeros((count, LABELS), np.float32)
    piece = np.full((count, LABELS), -1)
    place, turn = np.zeros((count, LABELS, 2)), np.zeros((count, LABELS, 2))
    laid: list[_Laid] = []
    for start, grid in _grids(sheet, ahead, step, piece):
        points, nears, carried = grid
        sample = sheet.interpolation(points, nears)
        facing = sheet.normals[nears] @ sheet.normals[start] > SAME_WAY
        best = choices.nearest(sample, facing, height[:, 0], piece[:, 0] >= 0)
        if best is None:
            best = int(rng.integers(len(pieces)))
        reach = 0.75 * SIDE * step
        around = np.asarray(sheet.tree.query_ball_point(sheet.vertices[start], reach))
        alike = sheet.normals[around] @ sheet.normals[start] > SAME_WAY
        around = around[alike & (piece[around, -1] < 0)]
        away, cell = cKDTree(points).query(sheet.vertices[around], distance_upper_bound=step)
        on = np.isfinite(away)
        around, cell = around[on], cell[on]
        same = (sheet.normals[around] * sheet.normals[nears[cell]]).sum(1) > SAME_WAY
        around, cell = around[same], cell[same]
        aside = np.cross(carried[cell], sheet.normals[nears[cell]])
        offset = (sheet.vertices[around] - points[cell]) / unit
        row, column = np.divmod(cell, SIDE)
        down = (row - SIDE // 2) * spacing - (offset * carried[cell]).sum(1)
        right = (column - SIDE // 2) * spacing + (offset * aside).sum(1)
        both = np.stack([(ahead[around] * each).sum(1) for each in (carried[cell], aside)], axis=1)
        label = (piece[around, 0] >= 0).astype(int)
        piece[around, label] = best
        place[around, label] = np.stack([down, right], axis=1)
        turn[around, label] = both / np.linalg.norm(both, axis=1, keepdims=True).clip(min=1e-9)
        height[around, label] = pieces[best, cell]
        laid.append(_Laid(sample, facing, around, cell, label))
    _rechosen(laid, choices, height, piece)
    _completed(sheet, piece, place, turn)
    used, piece = np.unique(piece, return_inverse=True)
    samples = SIDE + 2 * MARGIN
    finest = max(finest, spacing * samples * np.sqrt(len(used) / MOST_SAMPLES))
    samples = 2 * int(samples * spacing / finest / 2) + 1
    kept = exemplar.patches(places[used], samples, finest)
    return Quilt(
        kept,
        finest,
        torch.from_numpy(piece.reshape(count, LABELS)),
        torch.from_numpy(place).float(),
        torch.from_numpy(turn).float(),
    )


@dataclass(frozen=True)
class _Choices:
    """The pieces to choose from."""

    pieces: Float[np.ndarray, "pieces cells"]

    @cached_property
    def _squares(self) -> Float[np.ndarray, "pieces cells"]:
        return self.pieces**2

    def nearest(
        self,
        sample: csr_matrix,
        facing: Bool[np.ndarray, " cells"],
        height: Float[np.ndarray, " vertices"],
        known: Bool[np.ndarray, " vertices"],
        least: int = 1,
    ) -> int | None:
        """The piece nearest to the heights where they are known, in at least so many cells, else
        None."""
        seen = (sample @ known.astype(np.float32) > 0.99) & facing
        if seen.sum() < least:
            return None
        here = seen.astype(np.float32)
        return int((self._squares @ here - 2 * self.pieces @ (here * (sample @ height))).argmin())


@dataclass(frozen=True)
class _Laid:
    """A piece on the mesh."""

    sample: csr_matrix
    """Samples vertex values at its cells."""
    facing: Bool[np.ndarray, " cells"]
    around: Int[np.ndarray, " covered"]
    """The vertices that it covers, their cells, and which of their labels it is."""
    cell: Int[np.ndarray, " covered"]
    label: Int[np.ndarray, " covered"]


def _rechosen(
    laid: list[_Laid],
    choices: _Choices,
    height: Float[np.ndarray, "vertices labels"],
    piece: Int[np.ndarray, "vertices labels"],
) -> None:
    """Choose every piece again to match the others where they overlap, in place."""
    shown, known = height[:, 0].copy(), piece[:, 0] >= 0
    for _ in range(SWEEPS):
        changed = False
        for each in laid:
            around, cell, label = each.around, each.cell, each.label
            own = around[label == 0]
            # Without this piece its vertices show their second label's.
            shown[own], known[own] = height[own, 1], piece[own, 1] >= 0
            best = choices.nearest(each.sample, each.facing, shown, known, LEAST_SEEN)
            if best is not None and len(around):
                changed |= bool(piece[around[0], label[0]] != best)
                piece[around, label] = best
                height[around, label] = choices.pieces[best, cell]
            shown[own], known[own] = height[own, 0], True
        if not changed:
            break


def _grids(
    sheet: Sheet,
    ahead: Float[np.ndarray, "vertices 3"],
    step: float,
    piece: Int[np.ndarray, "vertices labels"],
) -> Iterator[tuple[int, tuple[np.ndarray, np.ndarray, np.ndarray]]]:
    """Positions of pieces and their grid points: everywhere, then where ``piece`` has gaps, such as
    behind the bends of a limb."""
    apart = APART * SIDE * step
    for _ in range(3):
        bare = np.flatnonzero(piece[:, 0] < 0)
        seeds = bare[_spread(sheet.vertices[bare], apart)] if len(bare) else bare
        points, nears, carried = sheet.grids(seeds, ahead[seeds], SIDE, step)
        for place in _outwards(sheet.vertices[seeds]):
            yield (
                int(seeds[place]),
                (
                    points[place].reshape(-1, 3),
                    nears[place].ravel(),
                    carried[place].reshape(-1, 3),
                ),
            )
        apart /= 2


def _completed(sheet: Sheet, piece: np.ndarray, place: np.ndarray, turn: np.ndarray) -> None:
    """Give unlabelled vertices the label of the nearest labelled one, and every vertex a second
    label."""
    known = np.flatnonzero(piece[:, 0] >= 0)
    bare = np.flatnonzero(piece[:, 0] < 0)
    if len(bare):
        nearest = known[cKDTree(sheet.vertices[known]).query(sheet.vertices[bare])[1]]
        for each in (piece, place, turn):
            each[bare] = each[nearest]
    single = piece[:, 1] < 0
    for each in (piece, place, turn):
        each[single, 1] = each[single, 0]


def _spread(points: Float[np.ndarray, "points 3"], distance: float) -> Int[np.ndarray, " places"]:
    """Select points at least ``distance`` apart, by farthest-point sampling."""
    chosen = [0]
    away = np.linalg.norm(points - points[0], axis=1)
    while away.max() > distance:
        chosen.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen)


def _outwards(places: Float[np.ndarray, "places 3"]) -> list[int]:
    """Order in which each position is the nearest to those before it."""
    order: list[int] = []
    away = np.zeros(len(places))
    for _ in places:
        order.append(int(away.argmin()))
        nearer = np.linalg.norm(places - places[order[-1]], axis=1)
        away = nearer if len(order) == 1 else np.minimum(away, nearer)
        away[order] = np.inf
    return order


def _bilinear(
    pieces: Float[Tensor, "pieces samples samples"],
    piece: Int[Tensor, "some labels"],
    y: Float[Tensor, "some labels cells"],
    x: Float[Tensor, "some labels cells"],
) -> Float[Tensor, "some labels cells"]:
    """Sample pieces at offsets down and right of their centres, clamped at their rims."""
    samples = pieces.shape[1]
    y, x = ((each + samples // 2).clamp(0, samples - 1.001) for each in (y, x))
    row, column = y.long(), x.long()
    at = (piece[..., None] * samples + row) * samples + column
    flat = pieces.reshape(-1)
    y, x = y - row, x - column
    upper = flat[at] + x * (flat[at + 1] - flat[at])
    lower = flat[at + samples] + x * (flat[at + samples + 1] - flat[at + samples])
    return upper + y * (lower - upper)
