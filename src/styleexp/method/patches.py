"""Separate a relief from its base shape: flat square windows of its height.

Styles differ in their relief, but renders mostly show the shape below it. So windows are sampled:
at random surface points, a window of the tangent plane is viewed from straight above, world +Y up,
and the height above the base surface is read at every pixel. A bubble then looks the same on a limb
as on a sphere.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch.nn import functional

from styleexp.inputs import meshes
from styleexp.method import views
from styleexp.method.relief import smoother
from styleexp.method.surface import Surface, sample_surface
from styleexp.renderers.base import Shading
from styleexp.renderers.soft_raster import SoftRaster

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from torch import Tensor

    from styleexp.renderers.base import Cameras

WINDOW = 1.0
"""Width of a window, in units of the pattern (see `subject.pattern_unit`)."""
SIZE = 96
"""Side of a window in pixels."""
COARSEST = 0.5
"""Wavelength, in units of the pattern, above which undulations count as shape, not relief."""
FIELD_OF_VIEW = 20.0
"""Field of view in degrees; narrow, for a nearly parallel projection."""
LEAST_FACING = 0.6
"""Cosine between the window's and a face's normal below which the face is too oblique and
ignored."""
DEEPEST = 0.35
"""Distance from the window's plane, in window widths, beyond which faces belong to another part."""
LEAST_COVERED = 0.25
"""Minimum usable fraction of a window."""
BATCH = 32


@dataclass(frozen=True)
class Relief:
    """Heights above a base surface, all in the same unit."""

    base: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    height: Float[np.ndarray, " vertices"]
    """Height along the base's normals, with zero mean."""


@dataclass(frozen=True)
class Windows:
    """Flat square windows of a relief."""

    height: Float[Tensor, "n size size"]
    """Height in window widths; gaps are filled from their surroundings."""
    mask: Bool[Tensor, "n size size"]
    """Pixels with a measured height."""


def relief_of_mesh(mesh: meshes.Mesh, unit: float = 1.0) -> Relief:
    """A mesh's relief above its own smoothed version, in the unit sphere; ``unit`` is the size of
    its pattern there, 1 for a style mesh."""
    vertices = meshes.normalisation(mesh.vertices).apply(mesh.vertices)
    base = smoother(vertices, mesh.faces, COARSEST * unit)(vertices)
    height = ((vertices - base) * meshes.vertex_normals(base, mesh.faces)).sum(axis=1)
    return Relief(base, mesh.faces, height - height.mean())


def relief_of_result(
    source: meshes.Mesh,
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    unit: float,
) -> Relief:
    """The relief that a result adds to its source, in radii of the normalised source.

    ``vertices`` are in the source's frame. With the source's own faces, height is the vertices'
    displacement along the source's normals; otherwise their signed distance from its surface.
    Undulations longer than the pattern are removed, as for a style mesh.
    """
    frame = meshes.normalisation(source.vertices)
    result, own = frame.apply(vertices), frame.apply(source.vertices)
    if np.array_equal(faces, source.faces):
        base, normals = own, meshes.vertex_normals(own, source.faces)
    else:
        base, normals = closest(own, source.faces, result)
    height = ((result - base) * normals).sum(axis=1)
    height = height - smoother(base, faces, COARSEST * unit)(height)
    return Relief(base, faces, height - height.mean())


def closest(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    points: Float[np.ndarray, "points 3"],
) -> tuple[Float[np.ndarray, "points 3"], Float[np.ndarray, "points 3"]]:
    """Closest point on a mesh to each of ``points``, and the smooth unit normal there."""
    import gpytoolbox

    _, face, weights = gpytoolbox.squared_distance(points, vertices, faces, use_cpp=True)
    weights = weights[:, :, None]
    corners = faces[face]
    normals = (meshes.vertex_normals(vertices, faces)[corners] * weights).sum(axis=1)
    length = np.linalg.norm(normals, axis=1, keepdims=True).clip(min=1e-12)
    return (vertices[corners] * weights).sum(axis=1), normals / length


def windows(relief: Relief, width: float, count: int, seed: int = 0) -> Windows:
    """Up to ``count`` windows of size ``width``, at points sampled uniformly on the surface.

    There are fewer, possibly none, if the surface is too small or too occluded.
    """
    surface = Surface(
        torch.from_numpy(relief.base).float(),
        torch.from_numpy(relief.faces),
        torch.from_numpy(meshes.vertex_normals(relief.base, relief.faces)).float(),
    )
    generator = views.step_generator(seed, 0, stream=11)
    points, directions = sample_surface(surface, 2 * count, generator)
    distance = width / (2 * math.tan(math.radians(FIELD_OF_VIEW) / 2))
    cameras = views.look_at(points + distance * directions, points, FIELD_OF_VIEW)
    height = torch.from_numpy(relief.height).float()
    seen = [
        _look(surface, height, cameras[slice(at, at + BATCH)], distance, width)
        for at in range(0, len(cameras), BATCH)
    ]
    heights, mask = torch.cat([h for h, _ in seen]), torch.cat([m for _, m in seen])
    middle = mask[:, SIZE // 2, SIZE // 2] & (mask.float().mean((1, 2)) > LEAST_COVERED)
    chosen = middle.nonzero().squeeze(1)[:count]
    return Windows(_filled(heights[chosen] / width, mask[chosen]), mask[chosen])


@torch.no_grad()
def _look(
    surface: Surface, height: Tensor, cameras: Cameras, distance: float, width: float
) -> tuple[Float[Tensor, "n size size"], Bool[Tensor, "n size size"]]:
    """Height at every pixel, and a mask of valid pixels."""
    out = SoftRaster().render(surface.vertices, surface.faces, cameras, Shading(), (SIZE, SIZE))
    assert out.face_ids is not None
    assert out.depth is not None
    corners = surface.faces[out.face_ids.clamp(min=0)]
    a, b, c = (surface.vertices[corners[..., k]] for k in range(3))
    point = _unproject(cameras, out.depth.clamp(max=1e3))
    normal = torch.linalg.cross(b - a, c - a)
    double = normal.square().sum(-1).clamp(min=1e-20)
    weight_a = (torch.linalg.cross(c - b, point - b) * normal).sum(-1) / double
    weight_b = (torch.linalg.cross(a - c, point - c) * normal).sum(-1) / double
    ha, hb, hc = (height[corners[..., k]] for k in range(3))
    seen = weight_a * ha + weight_b * hb + (1 - weight_a - weight_b) * hc

    backward = cameras.rotation[:, 2][:, None, None]
    facing = (functional.normalize(normal, dim=-1) * backward).sum(-1)
    mask = (out.face_ids >= 0) & (facing > LEAST_FACING)
    mask &= (out.depth - distance).abs() < DEEPEST * width
    return torch.where(mask, seen, 0.0), mask


def _unproject(cameras: Cameras, depth: Float[Tensor, "n h w"]) -> Float[Tensor, "n h w 3"]:
    """World points at pixel centres."""
    rows, columns = depth.shape[1:]
    x = (2 * torch.arange(columns) + 1) / columns - 1
    y = 1 - (2 * torch.arange(rows) + 1) / rows
    local = torch.stack(
        [
            x[None, None] / cameras.focal[:, :1, None] * depth,
            y[None, :, None] / cameras.focal[:, 1:, None] * depth,
            -depth,
        ],
        dim=-1,
    )
    shifted = local - cameras.translation[:, None, None]
    return torch.einsum("nij,nhwi->nhwj", cameras.rotation, shifted)


def _filled(height: Float[Tensor, "n h w"], mask: Bool[Tensor, "n h w"]) -> Float[Tensor, "n h w"]:
    """Fill gaps with their blurred surroundings, so that their rims don't form edges."""
    known, filled = mask.clone(), torch.where(mask, height, 0.0)
    for sigma in (1.5, 4.0, 10.0):
        share = blurred(mask.float(), sigma)
        around = blurred(torch.where(mask, height, 0.0), sigma) / share.clamp(min=1e-6)
        take = ~known & (share > 1e-3)
        filled[take] = around[take]
        known |= take
    return filled


def blurred(images: Float[Tensor, "n h w"], sigma: float) -> Float[Tensor, "n h w"]:
    """Gaussian blur with replicated borders; ``sigma`` in pixels."""
    if not len(images):
        return images
    if sigma > 4 and min(images.shape[1:]) >= 16:  # equivalent at half resolution, far cheaper
        small = blurred(functional.avg_pool2d(images[:, None], 2)[:, 0], sigma / 2)
        size = list(images.shape[1:])
        return functional.interpolate(small[:, None], size, mode="bilinear")[:, 0]
    reach = max(1, int(3 * sigma))
    kernel = torch.exp(-0.5 * (torch.arange(-reach, reach + 1) / sigma) ** 2)
    kernel = kernel / kernel.sum()
    wide = functional.pad(images[:, None], (reach, reach, reach, reach), mode="replicate")
    across = functional.conv2d(wide, kernel[None, None, None])
    return functional.conv2d(across, kernel[None, None, :, None])[:, 0]
