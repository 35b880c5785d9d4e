"""Content metrics: preservation of the source's shape, and surface quality."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch

from styleexp.inputs import meshes
from styleexp.method.views import orbit
from styleexp.renderers.base import Shading
from styleexp.renderers.soft_raster import SoftRaster

if TYPE_CHECKING:
    from jaxtyping import Float, Int

VIEWS = tuple((elevation, azimuth) for elevation in (-20, 30) for azimuth in range(0, 360, 60))
"""Elevation and azimuth, in degrees, of the twelve views for silhouettes."""
RESOLUTION = 256
LARGE = 15
"""Maximum grid cells per face; larger faces are tested separately."""
SAMPLES = 10_000
"""Sample points per surface for Chamfer and Hausdorff distances."""


def content(
    source: meshes.Mesh,
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
) -> dict[str, float]:
    """The content metrics of a result in its source's frame; see docs/metrics.md.

    ``flipped_faces`` is included only if the result has the source's own faces.
    """
    diagonal = float(np.linalg.norm(np.ptp(source.vertices, axis=0)))
    chamfer, hausdorff = surface_distances(source.vertices, source.faces, vertices, faces)
    found = {
        "silhouette_iou": silhouette_iou(source.vertices, source.faces, vertices, faces),
        "chamfer": chamfer / diagonal,
        "hausdorff": hausdorff / diagonal,
        "volume_change": volume(vertices, faces) / volume(source.vertices, source.faces) - 1,
        "self_intersections": self_intersections(vertices, faces),
    }
    if np.array_equal(faces, source.faces):
        found["flipped_faces"] = flipped_faces(source.vertices, vertices, faces)
    return found


def silhouette_iou(
    source: Float[np.ndarray, "a 3"],
    source_faces: Int[np.ndarray, "f 3"],
    vertices: Float[np.ndarray, "b 3"],
    faces: Int[np.ndarray, "g 3"],
) -> float:
    """Silhouette IoU, averaged over twelve views."""
    frame = meshes.normalisation(source)
    one, other = (
        _silhouettes(frame.apply(v), f) for v, f in ((source, source_faces), (vertices, faces))
    )
    both, either = (one & other).sum((1, 2)), (one | other).sum((1, 2))
    return float((both / either.clamp(min=1)).mean())


@torch.no_grad()
def _silhouettes(vertices: np.ndarray, faces: np.ndarray) -> torch.Tensor:
    angles = torch.tensor(VIEWS, dtype=torch.float32).deg2rad()
    cameras = orbit(angles[:, 0], angles[:, 1], distance=2.5, fov=60.0)
    out = SoftRaster("none").render(
        torch.from_numpy(vertices).float(),
        torch.from_numpy(faces),
        cameras,
        Shading(),
        (RESOLUTION, RESOLUTION),
    )
    return out.coverage > 0.5


def surface_distances(
    source: Float[np.ndarray, "a 3"],
    source_faces: Int[np.ndarray, "f 3"],
    vertices: Float[np.ndarray, "b 3"],
    faces: Int[np.ndarray, "g 3"],
) -> tuple[float, float]:
    """Chamfer (mean of both directed mean distances) and Hausdorff distance of two surfaces, from
    uniform samples on each to the closest point on the other, in the meshes' units."""
    import gpytoolbox

    directions = []
    for v, f, other, other_faces in (
        (source, source_faces, vertices, faces),
        (vertices, faces, source, source_faces),
    ):
        points = _spread(v, f)
        squared, *_ = gpytoolbox.squared_distance(points, other, other_faces, use_cpp=True)
        directions.append(np.sqrt(np.maximum(squared, 0.0)))
    chamfer = (directions[0].mean() + directions[1].mean()) / 2
    return float(chamfer), float(max(directions[0].max(), directions[1].max()))


def _spread(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    rng = np.random.default_rng(0)
    areas = meshes.face_areas(vertices, faces)
    chosen = vertices[faces[rng.choice(len(faces), SAMPLES, p=areas / areas.sum())]]
    u, v = np.sort(rng.random((2, SAMPLES, 1)), axis=0)
    return chosen[:, 0] * u + chosen[:, 1] * (v - u) + chosen[:, 2] * (1 - v)


def volume(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> float:
    """Signed volume, positive for outward winding; for an open mesh, that of its cone to the
    vertices' mean."""
    a, b, c = (vertices[faces[:, k]] - vertices.mean(axis=0) for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6) or math.nan


def flipped_faces(
    source: Float[np.ndarray, "v 3"],
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
) -> float:
    """Fraction of faces whose normal opposes that on the source."""
    before, after = (_face_vectors(v, faces) for v in (source, vertices))
    return float(((before * after).sum(axis=1) < 0).mean())


def bend(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> float:
    """99th percentile, over the edges, of the difference of the unit normals at an edge's ends: 0
    for a smooth surface, up to 2 where it is crumpled."""
    normals = meshes.vertex_normals(vertices, faces)
    a, b = meshes.edges_of(faces).T
    return float(np.percentile(np.linalg.norm(normals[a] - normals[b], axis=1), 99))


def self_intersections(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> float:
    """Fraction of faces that intersect another face without a shared vertex."""
    first, second = _near_pairs(vertices[faces])
    apart = (faces[first][:, :, None] != faces[second][:, None, :]).all(axis=(1, 2))
    first, second = first[apart], second[apart]
    hit = np.zeros(len(faces), dtype=bool)
    for at in range(0, len(first), 200_000):
        one, other = first[at : at + 200_000], second[at : at + 200_000]
        a, b = vertices[faces[one]], vertices[faces[other]]
        cut = _edges_cut(a, b) | _edges_cut(b, a)
        hit[one[cut]] = hit[other[cut]] = True
    return float(hit.mean()) if len(faces) else 0.0


def _near_pairs(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (i < j) of triangles (n, 3, 3) with overlapping bounding boxes, found with a grid."""
    low, high = triangles.min(axis=1), triangles.max(axis=1)
    cell = max(float(np.percentile((high - low).max(axis=1), 75)), 1e-12)
    first, last = (np.floor(x / cell).astype(np.int64) for x in (low, high))
    # A face far larger than the rest would span too many cells: test it against all others.
    large = np.flatnonzero((last - first).max(axis=1) > LARGE)
    meets = [
        np.flatnonzero(
            ((low[k] <= high) & (low <= high[k])).all(axis=1) & (np.arange(len(low)) != k)
        )
        for k in large
    ]
    spans = np.where(np.isin(np.arange(len(low)), large)[:, None], 0, last - first + 1)
    count = spans.prod(axis=1)
    owner = np.repeat(np.arange(len(triangles)), count)
    step = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    across = spans[owner]
    offset = np.stack(
        [
            step // (across[:, 1] * across[:, 2]),
            step // across[:, 2] % across[:, 1],
            step % across[:, 2],
        ],
        axis=1,
    )
    place = first[owner] + offset
    place -= place.min(axis=0)
    size = place.max(axis=0) + 1
    key = (place[:, 0] * size[1] + place[:, 1]) * size[2] + place[:, 2]
    order = np.argsort(key, kind="stable")
    key, owner = key[order], owner[order]
    # Pair each entry with those that follow it in its cell.
    end = np.searchsorted(key, key, side="right")
    follow = end - np.arange(len(key)) - 1
    left = np.repeat(np.arange(len(key)), follow)
    right = left + 1 + np.arange(follow.sum()) - np.repeat(np.cumsum(follow) - follow, follow)
    one = np.concatenate([owner[left], np.repeat(large, [len(m) for m in meets])])
    other = np.concatenate([owner[right], *meets])
    overlap = ((low[one] <= high[other]) & (low[other] <= high[one])).all(axis=1)
    one, other = one[overlap], other[overlap]
    keys = np.sort(np.minimum(one, other) * len(low) + np.maximum(one, other))
    return np.divmod(keys[np.diff(keys, prepend=-1) > 0], len(low))


def _edges_cut(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Whether an edge of each triangle in ``a`` (n, 3, 3) passes through its counterpart in
    ``b``."""
    normal = np.cross(b[:, 1] - b[:, 0], b[:, 2] - b[:, 0])
    side = np.einsum("nij,nj->ni", a - b[:, :1], normal)
    cut = np.zeros(len(a), dtype=bool)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        across = (side[:, i] > 0) != (side[:, j] > 0)
        share = side[:, i] / np.where(across, side[:, i] - side[:, j], 1.0)
        point = a[:, i] + share[:, None] * (a[:, j] - a[:, i])
        inside = across
        for k in range(3):
            edge = b[:, (k + 1) % 3] - b[:, k]
            turn = np.einsum("ni,ni->n", np.cross(edge, point - b[:, k]), normal)
            inside = inside & (turn > 0)
        cut |= inside
    return cut


def _face_vectors(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)
