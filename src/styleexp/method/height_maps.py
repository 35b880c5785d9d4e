"""The style as a height map, applied to the source by triplanar projection.

The map comes from an image (`pictures`), or from a patch of the style mesh's relief. It is
projected along the three axes, tiled by mirroring, and blended by the components of the vertex
normal. Nothing is rendered or learned, so it is instant: what a technical artist would do. It is
the default start of the field (`field.start`), and a baseline.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch.nn import functional

from styleexp.inputs import meshes, shapes
from styleexp.method import pictures
from styleexp.method.fields import zero_mean
from styleexp.method.relief import half_range, mesh_relief
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from torch import Tensor

    from styleexp.method.subject import Subject

AXES = ((2, 1), (0, 2), (0, 1))
"""Source axes of the map's right and up, for the projections along x, y and z."""

SAMPLED = 40_000
"""Maximum number of style vertices considered when choosing the patch."""

PATCH_DETAIL = 256
"""Side, in pixels, of a style mesh's height map."""

PATCH = 0.6
"""Radius of the patch that a style mesh's height map is taken from, in radii of the style."""

SHARPNESS = 8.0
"""Exponent of the normal's components in the blend of the three projections."""

RELIEF_LENGTH = 0.5
"""Length, in radii of the style, above which features count as shape, not relief."""


class NoPatch(UserError):
    """No region of the style mesh is dense enough for a height map."""


@dataclass(frozen=True)
class HeightMap:
    """One tile, row 0 at the top, with mean 0 and half range 1 (for images with a known amplitude,
    before fine detail was filtered out)."""

    height: Float[Tensor, "rows columns"]
    side: float
    """Length of the longer side on the result, in radii of the normalised source."""


def displacement(
    subject: Subject,
    height: float | None = None,
    patch: float = PATCH,
    sharpness: float = SHARPNESS,
) -> Float[Tensor, " vertices"]:
    """The style's height map as a displacement of the source's vertices, in radii of the normalised
    source. Its area-weighted mean over the surface (over the masked part, if there is a mask) is
    zero. The mask is not applied yet.

    ``height`` is half its range; defaults to that of the style's own relief.
    """
    tile, surface = height_map(subject, patch), subject.surface
    raised = triplanar(tile, surface.vertices, surface.normals, sharpness)
    height = subject.relief if height is None else height
    return zero_mean(height * raised, subject.weights, math.inf)


def height_map(subject: Subject, patch: float) -> HeightMap:
    """The style as a height map, sized by ``style.scale`` and ``style.image_tile``."""
    style, device = subject.style, subject.surface.vertices.device
    heights = subject.heights
    if heights is not None:
        height = heights.height
        side = pictures.picture_side(subject.settings.style, subject.unit)
    else:
        assert style.mesh is not None
        height = torch.from_numpy(mesh_patch(style.mesh, patch))
        side = patch * math.sqrt(2) * subject.unit
    # Detail finer than the source's edges would alias to noise.
    edge = (
        meshes.mean_edge_length(subject.source.vertices, subject.source.faces) / subject.frame.scale
    )
    fit = pictures.resized(height, min(side / edge, max(height.shape)))
    if heights is not None and heights.in_proportion:
        half = pictures.spread(heights.height)  # before filtering, so the amplitude is unchanged
    else:
        half = max(half_range(fit.numpy().ravel()), 1e-6)
    return HeightMap(((fit - fit.mean()) / half).to(device, non_blocking=True), side)


def mesh_patch(style: meshes.Mesh, radius: float) -> Float[np.ndarray, "side side"]:
    """Relief of a style mesh over the square inscribed in a disc of ``radius`` radii, seen along
    its normal, y up.

    The height is `shapes.relief` for an analytic style, else `relief.mesh_relief`. The disc is
    placed where the mesh is flattest and most upright, so that patterns keep their up direction.
    """
    from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
    from scipy.spatial import cKDTree

    vertices = meshes.normalisation(style.vertices).apply(style.vertices)
    normals = meshes.vertex_normals(vertices, style.faces)
    if style.carrier is None and style.name in shapes.RELIEFS:
        height = shapes.relief(style.name, style.vertices)
    else:
        height = mesh_relief(vertices, style.faces, normals, RELIEF_LENGTH)

    # Candidates spread over the mesh, scored by how well the normals around them agree.
    seeds = spread(len(vertices), 500)
    some = np.union1d(seeds, spread(len(vertices), SAMPLED))
    around = cKDTree(vertices[some]).query_ball_point(vertices[seeds], radius)
    mean = np.stack([normals[some[near]].mean(axis=0) for near in around])
    flat = np.linalg.norm(mean, axis=1)
    mean /= np.maximum(flat, 1e-9)[:, None]
    best = int(np.argmax(flat - 0.5 * mean[:, 1] ** 2))

    out = mean[best]
    up = np.array([0.0, 1.0, 0.0]) if abs(out[1]) < 0.99 else np.array([0.0, 0.0, -1.0])
    up = up - (up @ out) * out
    up /= np.linalg.norm(up)
    right = np.cross(up, out)
    # Slightly more than the square, for interpolation at its border; near side only.
    offset = vertices - vertices[seeds[best]]
    plane = np.stack([offset @ right, offset @ up], axis=1)
    half = radius / math.sqrt(2)
    depth = offset @ out
    seen = (np.abs(plane) < 1.1 * half).all(axis=1) & (normals @ out > 0.2) & (depth > -radius)
    if seen.sum() < 16 or np.linalg.matrix_rank(plane[seen] - plane[seen][0], tol=1e-6) < 2:
        raise NoPatch(
            f"the style '{style.name}' has no patch of {radius} radii to take a height map from: "
            "increase baseline.patch, or use a style with more vertices."
        )
    across = (np.arange(PATCH_DETAIL) + 0.5) / PATCH_DETAIL * 2 - 1
    x, y = np.meshgrid(half * across, -half * across)
    found = LinearNDInterpolator(plane[seen], height[seen])(x, y)
    nearest = NearestNDInterpolator(plane[seen], height[seen])(x, y)
    return np.where(np.isnan(found), nearest, found).astype(np.float32)


def spread(count: int, most: int) -> Int[np.ndarray, " some"]:
    """Up to ``most`` evenly spaced indices below ``count``."""
    return np.linspace(0, count - 1, min(count, most)).astype(int)


def triplanar(
    tile: HeightMap,
    points: Float[Tensor, "points 3"],
    normals: Float[Tensor, "points 3"],
    sharpness: float,
) -> Float[Tensor, " points"]:
    """Height at surface points: the tile projected along x, y and z, blended by the normal.

    A tile has a corner at the origin, and its neighbours are its mirror images.
    """
    rows, columns = tile.height.shape
    texel = tile.side / max(rows, columns)
    weights = normals.abs() ** sharpness
    weights = weights / weights.sum(dim=1, keepdim=True)
    total = points.new_zeros(len(points))
    for axis, (right, up) in enumerate(AXES):
        u, v = points[:, right] / (columns * texel), -points[:, up] / (rows * texel)
        grid = (2 * torch.stack([u, v], dim=1) - 1)[None, :, None]
        seen = functional.grid_sample(
            tile.height[None, None], grid, padding_mode="reflection", align_corners=False
        )
        total = total + weights[:, axis] * seen[0, 0, :, 0]
    return total
