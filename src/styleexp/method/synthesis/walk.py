"""Walk over a triangle mesh, and interpolate vertex values at the points reached."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.sparse import csr_matrix, vstack
from scipy.spatial import cKDTree

from styleexp.inputs import meshes

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from torch import Tensor

AT_ONCE = 16_000
"""Points interpolated per batch, so that intermediates fit a cache."""
THREADED = 10_000
"""Minimum number of points for multi-threaded lookup."""
GRIDS = 20_000
"""Grids walked per batch, so that intermediates are smaller than the result."""
MOST_FACES = 24
"""Maximum number of faces considered around a vertex; vertices with more are poles of fans."""


class Sheet:
    """A mesh to walk on."""

    def __init__(
        self,
        vertices: Float[np.ndarray, "vertices 3"],
        faces: Int[np.ndarray, "faces 3"],
        normals: Float[np.ndarray, "vertices 3"] | None = None,
    ):
        self.vertices = np.ascontiguousarray(vertices, dtype=np.float64)
        self.faces = faces
        self.normals = meshes.vertex_normals(vertices, faces) if normals is None else normals

    @cached_property
    def edge(self) -> float:
        """Mean length of the edges."""
        return meshes.mean_edge_length(self.vertices, self.faces)

    @cached_property
    def tree(self) -> cKDTree:
        """The vertices, for looking up the nearest."""
        return cKDTree(self.vertices)

    def nearest(self, points: Float[np.ndarray, "points 3"]) -> Int[np.ndarray, " points"]:
        """Index of the vertex nearest to each point."""
        # For few points, threads cost more than they save.
        return self.tree.query(points, workers=-1 if len(points) > THREADED else 1)[1]

    def step(
        self,
        points: Float[np.ndarray, "points 3"],
        ahead: Float[np.ndarray, "points 3"],
        near: Int[np.ndarray, " points"],
        along: tuple[float, float],
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Step by lengths (forward, right) from points on the mesh with unit tangents ``ahead``,
        project onto the tangent plane of the nearest vertex, and transport the direction. Returns
        points, directions and nearest vertices."""
        aside = np.cross(ahead, self.normals[near])
        moved = points + along[0] * ahead + along[1] * aside
        near = self.nearest(moved)
        normal = self.normals[near]
        moved -= ((moved - self.vertices[near]) * normal).sum(1, keepdims=True) * normal
        ahead = ahead - (ahead * normal).sum(1, keepdims=True) * normal
        ahead /= np.linalg.norm(ahead, axis=1, keepdims=True).clip(min=1e-9)
        return moved, ahead, near

    def grids(
        self,
        start: Int[np.ndarray, " grids"],
        ahead: Float[np.ndarray, "grids 3"],
        side: int,
        spacing: float,
    ) -> tuple[
        Float[np.ndarray, "grids side side 3"],
        Int[np.ndarray, "grids side side"],
        Float[np.ndarray, "grids side side 3"],
    ]:
        """Points of a ``side`` x ``side`` grid (odd) around each start vertex, walked over the
        mesh: first along ``ahead``, then to both sides; row 0 is ahead, column 0 left. Also returns
        the nearest vertices and the transported ``ahead``."""
        count, half = len(start), side // 2
        points, carried = (np.empty((count, side, side, 3)) for _ in range(2))
        nears = np.empty((count, side, side), dtype=np.int64)
        points[:, half, half], carried[:, half, half] = self.vertices[start], ahead
        nears[:, half, half] = start
        for sign in (1, -1):
            at, up, near = self.vertices[start], ahead, start
            for row in range(half - sign, -1 if sign > 0 else side, -sign):
                at, up, near = self.step(at, up, near, (sign * spacing, 0.0))
                points[:, row, half], carried[:, row, half], nears[:, row, half] = at, up, near
        # All rows at once: a step costs little more for many points.
        rows = count, side
        for sign in (1, -1):
            at, up = points[:, :, half].reshape(-1, 3), carried[:, :, half].reshape(-1, 3)
            near = nears[:, :, half].ravel()
            for column in range(half + sign, side if sign > 0 else -1, sign):
                at, up, near = self.step(at, up, near, (0.0, sign * spacing))
                points[:, :, column] = at.reshape(*rows, 3)
                carried[:, :, column] = up.reshape(*rows, 3)
                nears[:, :, column] = near.reshape(rows)
        return points, nears, carried

    def sampling(
        self,
        start: Int[np.ndarray, " grids"],
        ahead: Float[np.ndarray, "grids 3"],
        side: int,
        spacing: float,
    ) -> csr_matrix:
        """Sparse matrix, (grids x cells, vertices), that samples vertex values at the points of
        `grids`."""
        parts = []
        for some in np.array_split(np.arange(len(start)), len(start) // GRIDS + 1):
            points, nears, _ = self.grids(start[some], ahead[some], side, spacing)
            parts.append(self.interpolation(points.reshape(-1, 3), nears.ravel()))
        return vstack(parts, format="csr")

    def on_the_mesh(
        self, points: Float[np.ndarray, "... 3"], nears: Int[np.ndarray, ...]
    ) -> Bool[np.ndarray, ...]:
        """Whether points, given with their nearest vertices, are within the mesh's boundary."""
        away = points - self.vertices[nears]
        reach = (1.5 * self._reach) ** 2
        return np.einsum("...i,...i->...", away, away) < reach[nears]

    def spread(self, distance: float, rng: np.random.Generator) -> Int[np.ndarray, " chosen"]:
        """Evenly spread vertices, about ``distance`` apart: one per grid cell."""
        order = rng.permutation(len(self.vertices))
        cells = np.floor(self.vertices[order] / distance).astype(np.int64)
        cells -= cells.min(axis=0)
        sizes = cells.max(axis=0) + 1
        number = (cells[:, 0] * sizes[1] + cells[:, 1]) * sizes[2] + cells[:, 2]
        return np.sort(order[np.unique(number, return_index=True)[1]])

    @cached_property
    def areas(self) -> Float[np.ndarray, " vertices"]:
        """A third of the area of the adjacent faces, per vertex."""
        third = meshes.face_areas(self.vertices, self.faces) / 3
        return np.bincount(self.faces.ravel(), np.repeat(third, 3), minlength=len(self.vertices))

    @cached_property
    def _reach(self) -> Float[np.ndarray, " vertices"]:
        """Longest edge length at each vertex."""
        longest = np.zeros(len(self.vertices))
        for a, b in ((0, 1), (1, 2), (2, 0)):
            ends = self.faces[:, a], self.faces[:, b]
            length = np.linalg.norm(self.vertices[ends[0]] - self.vertices[ends[1]], axis=1)
            for end in ends:
                np.maximum.at(longest, end, length)
        return longest

    @cached_property
    def _fans(self) -> tuple[Tensor, Tensor, Int[np.ndarray, " vertices"]]:
        """For each vertex, the other two corners of its faces, (vertices, most, 2), the dual basis
        that gives a point's coordinates along the two edges, (vertices, most, 2, 3), and the number
        of faces."""
        count = len(self.vertices)
        corner = self.faces.ravel()
        order = np.argsort(corner, kind="stable")
        face, which = np.divmod(order, 3)
        valence = np.bincount(corner, minlength=count)
        place = np.arange(len(order)) - np.repeat(np.cumsum(valence) - valence, valence)
        most = int(min(valence.max(), MOST_FACES))
        kept = place < most
        others = np.tile(np.arange(count)[:, None, None], (1, most, 2))
        basis = np.zeros((count, most, 2, 3), dtype=np.float32)
        at = corner[order][kept], place[kept]
        others[at] = pair = np.stack(
            [self.faces[face, (which + k) % 3][kept] for k in (1, 2)], axis=1
        )
        basis[at] = _dual(*(self.vertices[pair[:, k]] - self.vertices[at[0]] for k in (0, 1)))
        return torch.from_numpy(others), torch.from_numpy(basis), valence.clip(1, most)

    def interpolation(
        self, points: Float[np.ndarray, "points 3"], nears: Int[np.ndarray, " points"]
    ) -> csr_matrix:
        """Sparse matrix, (points, vertices), that interpolates vertex values at points: linearly on
        the face, among those around the nearest vertex, that contains the point or is nearest to
        it."""
        others, solve, valence = self._fans
        column = torch.empty(len(points), 3, dtype=torch.int64)
        weight = torch.empty(len(points), 3)
        # Few vertices have many faces; process them separately.
        least = 0
        for most in (6, 8, others.shape[1]):
            rows = np.flatnonzero((valence[nears] > least) & (valence[nears] <= most))
            least = most
            for some in np.array_split(rows, len(rows) // AT_ONCE + 1):
                near = torch.from_numpy(nears[some])
                offset = torch.from_numpy(points[some] - self.vertices[nears[some]]).float()
                fan = others[near, :most]
                two = torch.einsum("pfad,pd->pfa", solve[near, :most], offset)
                inside = torch.minimum(two.amin(2), 1 - two.sum(2))
                # Padding entries have no edges, so their coordinates are zero.
                inside = torch.where(fan[:, :, 0] == near[:, None], -torch.inf, inside)
                best, at = inside.argmax(1), torch.arange(len(near))
                share = two[at, best].clamp(0, 1)
                share = share / share.sum(1, keepdim=True).clamp(min=1)
                column[some] = torch.cat([near[:, None], fan[at, best]], 1)
                weight[some] = torch.cat([1 - share.sum(1, keepdim=True), share], 1)
        begins = np.arange(len(points) + 1) * 3
        shape = (len(points), len(self.vertices))
        return csr_matrix((weight.numpy().ravel(), column.numpy().ravel(), begins), shape)


def _dual(
    one: Float[np.ndarray, "pairs 3"], two: Float[np.ndarray, "pairs 3"]
) -> Float[np.ndarray, "pairs 2 3"]:
    """The vectors whose products with a point give its coordinates along two edges; finite also for
    parallel edges."""
    a, b, c = ((x * y).sum(axis=1, keepdims=True) for x, y in ((one, one), (one, two), (two, two)))
    slack = 1e-9 * (a + c) + 1e-30
    a, c = a + slack, c + slack
    return np.stack([c * one - b * two, a * two - b * one], axis=1) / (a * c - b * b)[..., None]
