"""Flip edges of a mesh, with its attributes, where that makes triangles less thin."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from styleexp.inputs.meshes.mesh import Carrier

if TYPE_CHECKING:
    from jaxtyping import Float, Int

FLAT = 0.985
"""Cosine between two faces' normals above which the edge between them may be flipped."""
ROUNDS = 3
"""Maximum number of rounds, each of which flips edges that share no face."""
CLEARLY = 1e-3
"""Sum of the opposite angles' cotangents, negated, above which an edge is worth a flip."""


def flipped(vertices: Float[np.ndarray, "vertices 3"], carrier: Carrier, longest: float) -> Carrier:
    """Flip edges between nearly coplanar faces towards a Delaunay triangulation (the angles
    opposite an edge sum to at most pi), which has the fewest slivers. A new edge is no longer
    than the old one or ``longest``.

    Edges on texture seams, borders, creases, and between materials, parts or groups stay; so do
    the rows.
    """
    same = groups(carrier)
    faces = np.where(carrier.flipped[:, None], carrier.corners[:, ::-1], carrier.corners)
    for _ in range(ROUNDS):
        flips = _flips(vertices, carrier.rows, faces, same, longest)
        if not len(flips):
            break
        first, second, a, b, c, d = flips.T
        faces[first] = np.stack([a, d, c], axis=1)
        faces[second] = np.stack([d, b, c], axis=1)
    corners = np.where(carrier.flipped[:, None], faces[:, ::-1], faces)
    return replace(carrier, corners=corners)


def _flips(
    vertices: Float[np.ndarray, "vertices 3"],
    rows: Int[np.ndarray, " rows"],
    faces: Int[np.ndarray, "faces 3"],
    same: Int[np.ndarray, " faces"],
    longest: float,
) -> Int[np.ndarray, "flips 6"]:
    """Edges to flip, no two of one face: their two faces, their two ends, and the two opposite
    corners; as rows."""
    start, end, opposite = (np.roll(faces, -k, axis=1).ravel() for k in range(3))
    # Two angles that sum to more than pi: one of them is obtuse.
    obtuse = _obtuse(vertices, rows[faces])
    if not len(obtuse):
        return np.empty((0, 6), np.int64)
    key = start * len(rows) + end
    order = np.argsort(key)
    ordered = key[order]
    twin = end[obtuse] * len(rows) + start[obtuse]
    place = np.searchsorted(ordered, twin)
    its = order[place.clip(max=len(order) - 1)]
    # Twice the same directed edge is not manifold.
    single = np.searchsorted(ordered, twin, "right") - place == 1
    own = key[obtuse]
    single &= np.searchsorted(ordered, own, "right") - np.searchsorted(ordered, own) == 1
    of, other = obtuse // 3, its // 3
    single &= same[of] == same[other]
    single &= (own < twin) | ~np.isin(its, obtuse)  # each edge once
    mine, its = obtuse[single], its[single]
    a, b, c, d = start[mine], end[mine], opposite[mine], opposite[its]
    worth = _gain(*(vertices[rows[each]] for each in (a, b, c, d)))
    before, after = (
        np.linalg.norm(vertices[rows[one]] - vertices[rows[other]], axis=1)
        for one, other in ((a, b), (c, d))
    )
    worth = np.where(after > np.maximum(before, longest), 0.0, worth)
    flips = np.stack([mine // 3, its // 3, a, b, c, d], axis=1)[np.argsort(-worth)]
    flips = flips[: np.count_nonzero(worth)]
    if not len(flips):
        return flips
    # The new edge must not be there already, such as around a vertex of three faces.
    ends = rows[np.stack([start, end])]
    known = np.sort(ends.min(axis=0) * len(vertices) + ends.max(axis=0))
    pair = rows[flips[:, 4:]]
    new = pair.min(axis=1) * len(vertices) + pair.max(axis=1)
    there = known[np.searchsorted(known, new).clip(max=len(known) - 1)] == new
    return _apart(flips[~there], new[~there], len(faces))


def _obtuse(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Int[np.ndarray, " edges"]:
    """The half-edges opposite obtuse angles: three times the face, plus the corner they start
    at."""
    corners = vertices[faces]
    square = ((corners - np.roll(corners, -1, axis=1)) ** 2).sum(axis=2)
    return np.flatnonzero((2 * square > square.sum(axis=1, keepdims=True)).ravel())


def _apart(
    flips: Int[np.ndarray, "flips 6"], new: Int[np.ndarray, " flips"], faces: int
) -> Int[np.ndarray, "fewer 6"]:
    """Of flips in order of their worth, those that are the first of both their faces, and the first
    that make the edge ``new``."""
    number = np.arange(len(flips))
    best = np.full(faces, len(flips))
    for at in (0, 1):
        # Assigned from last to first, so that the first stays.
        best[flips[::-1, at]] = np.minimum(best[flips[::-1, at]], number[::-1])
    first = (best[flips[:, 0]] == number) & (best[flips[:, 1]] == number)
    chosen = np.flatnonzero(first)
    return flips[chosen[np.sort(np.unique(new[chosen], return_index=True)[1])]]


def _gain(
    a: Float[np.ndarray, "edges 3"],
    b: Float[np.ndarray, "edges 3"],
    c: Float[np.ndarray, "edges 3"],
    d: Float[np.ndarray, "edges 3"],
) -> Float[np.ndarray, " edges"]:
    """How far from Delaunay the edges a-b of the faces (a, b, c) and (b, a, d) are; 0 for those
    that are or that can't be flipped."""
    cots, normals = [], []
    for tip in (c, d):
        left, right = a - tip, b - tip
        cross = np.cross(left, right)
        size = np.linalg.norm(cross, axis=1)
        cots.append((left * right).sum(axis=1) / size.clip(min=1e-300))
        normals.append(cross)
    normals[1] = -normals[1]
    news = [np.cross(d - a, c - a), np.cross(b - d, c - d)]
    units = [_unit(each) for each in (*normals, *news)]
    flat = np.ones(len(a), bool)
    for one in units[:2]:
        for other in units[1:]:
            flat &= (one * other).sum(axis=1) > FLAT
    gain = -(cots[0] + cots[1])
    return np.where(flat & (gain > CLEARLY), gain, 0.0)


def groups(carrier: Carrier) -> Int[np.ndarray, " faces"]:
    """Number of each face's combination of material, part, groups, colour and winding."""
    columns = [carrier.flipped, carrier.face_part, carrier.face_material, carrier.face_colors]
    columns += [of for _, of in carrier.labels.values()]
    told = np.column_stack([each for each in columns if each is not None]).astype(np.int64)
    return np.unique(told, axis=0, return_inverse=True)[1].ravel()


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True).clip(min=1e-300)
