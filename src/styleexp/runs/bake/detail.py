"""The detailed surface that maps are baked from: where rays meet it, how open and how curved it is.

Rays are traced by Embree (extra ``bake``). Everything is computed in the frame of `Detail`, of unit
extent, since Embree has single precision.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from styleexp.inputs.meshes import vertex_normals
from styleexp.runs.bake.tangents import unit
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from jaxtyping import Float, Int

RAYS = 256
"""Rays per vertex for the occlusion."""
SEED = 0
OFF = 1e-4
"""Distance from the surface at which rays for the occlusion start, in extents."""
BACK = 1e-5
"""Distance behind its origin at which a ray to the surface starts, so that none slips through a
surface that the origin lies on."""
VERTICES = 1024
"""Vertices per batch of occlusion."""
THREADS = 8
"""Most batches at a time, each of about 100 MB."""

A = TypeVar("A")
B = TypeVar("B")


class Detail:
    """A triangle mesh, scaled to unit extent about ``middle``."""

    def __init__(
        self, vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
    ) -> None:
        self.middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
        self.extent = float(np.ptp(vertices, axis=0).max())
        self.vertices = (vertices - self.middle) / self.extent
        self.faces = faces
        self.normals = vertex_normals(self.vertices, faces)

    def own(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Points of the mesh's frame in this one."""
        return (points - self.middle) / self.extent

    @cached_property
    def scene(self) -> Any:
        """Embree's scene. Raises `UserError` if Embree is missing."""
        try:
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene
        except ImportError:
            raise UserError(MISSING) from None
        scene = EmbreeScene(robust=True)
        TriangleMesh(scene, self.vertices.astype(np.float32), self.faces.astype(np.int32))
        nowhere = np.full((1, 3), 9, np.float32)
        scene.run(nowhere, nowhere)  # builds it, before several threads use it
        return scene

    def along(
        self,
        points: Float[np.ndarray, "n 3"],
        normals: Float[np.ndarray, "n 3"],
        reach: float,
    ) -> tuple[Float[np.ndarray, " n"], Int[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
        """Signed distance (float32) along unit normals to the nearest surface that faces the same
        way, outwards or inwards up to ``reach``; its face, -1 if there is none; and the
        barycentric coordinates there."""
        points, normals = points.astype(np.float32), normals.astype(np.float32)
        limit = np.full(len(points), reach + BACK, np.float32)
        best = np.full(len(points), np.inf, np.float32)
        face = np.full(len(points), -1)
        second, third = np.zeros((2, len(points)), np.float32)
        for side in (1, -1):
            found = self.scene.run(
                points - np.float32(side * BACK) * normals,
                np.float32(side) * normals,
                dists=limit,
                output=1,
            )
            distance = found["tfar"] - np.float32(BACK)
            front = np.einsum("ni,ni->n", found["Ng"], normals) > 0
            nearer = (found["primID"] >= 0) & front & (distance < np.abs(best))
            best[nearer] = side * distance[nearer]
            face[nearer] = found["primID"][nearer]
            second[nearer], third[nearer] = found["u"][nearer], found["v"][nearer]
        weights = np.stack([1 - second - third, second, third], axis=1)
        return np.where(face < 0, np.float32(0), best), face, weights

    def nearest(
        self,
        points: Float[np.ndarray, "n 3"],
        normals: Float[np.ndarray, "n 3"],
        reach: float,
    ) -> tuple[Float[np.ndarray, " n"], Int[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
        """As `along`, but of the nearest point of the surface, if it is within ``reach`` and faces
        the same way."""
        squared, face, weights = self._closest(points)
        corners = self.faces[face]
        there = (self.vertices[corners] * weights[:, :, None]).sum(axis=1)
        a, b, c = (self.vertices[corners[:, k]] for k in range(3))
        front = (np.cross(b - a, c - a) * normals).sum(axis=1) > 0
        height = ((there - points) * normals).sum(axis=1)
        face = np.where(front & (squared <= reach**2), face, -1)
        return height.astype(np.float32), face, weights.astype(np.float32)

    def distances(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Distance of points from the surface."""
        return np.sqrt(self._closest(points)[0])

    def _closest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Squared distance from the surface, and the closest face and barycentric coordinates."""
        from gpytoolbox import squared_distance

        points = points.astype(np.float64)
        tree = self._tree
        return squared_distance(points, self.vertices, self.faces, use_cpp=True, cpp_aabb=tree)

    @cached_property
    def _tree(self) -> Any:
        from gpytoolbox import squared_distance_precompute

        return squared_distance_precompute(self.vertices, self.faces)

    def occlusion(self) -> Float[np.ndarray, " vertices"]:
        """Fraction of `RAYS` rays from each vertex, cosine-weighted about its normal, that meet
        nothing: 1 is open. The directions are a Fibonacci pattern, turned at random at each
        vertex."""
        scene = self.scene
        turns = np.random.default_rng(SEED).random(len(self.vertices))
        k = np.arange(RAYS) + 0.5
        radius, height = np.sqrt(k / RAYS), np.sqrt(1 - k / RAYS)
        golden = k * (np.sqrt(5) - 1) / 2

        def share(start: int) -> np.ndarray:
            n = self.normals[start : start + VERTICES]
            angle = 2 * np.pi * (golden + turns[start : start + VERTICES, None])
            x, y = radius * np.cos(angle), radius * np.sin(angle)
            one = unit(np.cross(n, np.where(np.abs(n[:, :1]) < 0.7, [1.0, 0, 0], [0, 1.0, 0])))
            two = np.cross(n, one)
            ways = x[..., None] * one[:, None] + y[..., None] * two[:, None]
            ways += height[None, :, None] * n[:, None]
            starts = np.repeat(self.vertices[start : start + VERTICES] + OFF * n, RAYS, axis=0)
            ways = ways.reshape(-1, 3).astype(np.float32)
            met = scene.run(starts.astype(np.float32), ways, query="OCCLUDED")
            return (met.reshape(-1, RAYS) < 0).mean(axis=1)

        return np.concatenate(list(ahead(share, range(0, len(self.vertices), VERTICES))))

    def curvature(self) -> Float[np.ndarray, " vertices"]:
        """Mean curvature at every vertex, in 1 / the mesh's own unit: positive where it is convex,
        1 / r on a sphere. The turn of each edge is shared by its ends (as in Cohen-Steiner and
        Morvan 2003), and the mean is over a vertex and its neighbours."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        cross = np.cross(b - a, c - a)
        area, flat = np.linalg.norm(cross, axis=1) / 2, unit(cross)
        start = self.faces.ravel()
        end = np.roll(self.faces, -1, axis=1).ravel()
        key = np.minimum(start, end) * len(self.vertices) + np.maximum(start, end)
        order = np.lexsort((start > end, key))
        one, two = order[:-1], order[1:]
        pair = (key[one] == key[two]) & (start[one] < end[one]) & (start[two] > end[two])
        one, two = one[pair], two[pair]
        p, q = start[one], end[one]
        edge = self.vertices[q] - self.vertices[p]
        m, n = flat[one // 3], flat[two // 3]
        length = np.linalg.norm(edge, axis=1)
        # Both faces see the edge on their left, the first from p to q.
        turn = np.arctan2((np.cross(m, n) * unit(edge)).sum(1), (m * n).sum(1))
        size = len(self.vertices)
        total = np.bincount(p, length * turn / 4, size) + np.bincount(q, length * turn / 4, size)
        around = np.bincount(start, np.repeat(area, 3) / 3, size)
        for sums in (total, around):
            own = sums.copy()
            sums += np.bincount(p, own[q], size) + np.bincount(q, own[p], size)
        return total / np.maximum(around, 1e-12) / self.extent


MISSING = (
    "this needs Embree and xatlas: pip install 'styleexp[bake]' (without, only a source that has "
    "texture coordinates and was not refined can be baked to)."
)


def ahead(task: Callable[[A], B], given: Iterable[A]) -> Iterator[B]:
    """Results of a task in order, computed by several threads, a few ahead of the one wanted."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    threads = min(usable or 1, THREADS)
    pending: list[Future[B]] = []
    with ThreadPoolExecutor(threads) as pool:
        for each in given:
            pending.append(pool.submit(task, each))
            if len(pending) > threads:
                yield pending.pop(0).result()
        for future in pending:
            yield future.result()
