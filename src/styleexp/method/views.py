"""Camera placement, and crops and perspectives of the renders (Sec. 3.3.1, Eq. 2)."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch.nn import functional

from styleexp.method.surface import sample_surface
from styleexp.renderers.base import Cameras

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from torch import Tensor

    from styleexp.method.options import LocalViewsConfig, ViewsConfig
    from styleexp.method.surface import Surface
    from styleexp.renderers.base import Renderer, Shading

POLE_GUARD = math.radians(85.0)
"""Maximum elevation in radians; at 90 degrees the up vector is degenerate."""

SURFACE_FOV = 40.0
"""Field of view, in degrees, of the cameras aimed at surface points."""


def step_generator(seed: int, step: int, stream: int = 0) -> torch.Generator:
    """A generator that depends only on (seed, step, stream), so that a resumed run draws the same
    numbers as an uninterrupted one."""
    generator = torch.Generator()
    generator.manual_seed(((seed * 1_000_003 + step) * 1_009 + stream) % (1 << 63))
    return generator


def look_at(
    eye: Float[Tensor, "views 3"],
    target: Float[Tensor, "views 3"],
    fov: float,
    up: tuple[float, float, float] = (0.0, 1.0, 0.0),
) -> Cameras:
    """Cameras at ``eye`` looking at ``target``; ``fov`` in degrees. If the direction is within 10
    degrees of ``up``, -Z is used as up."""
    backward = functional.normalize(eye - target, dim=1)
    ups = torch.tensor(up, dtype=eye.dtype, device=eye.device).expand_as(eye)
    degenerate = (backward * ups).sum(1, keepdim=True).abs() > math.cos(math.radians(10.0))
    ups = torch.where(degenerate, ups.new_tensor([0.0, 0.0, -1.0]), ups)
    right = functional.normalize(torch.linalg.cross(ups, backward), dim=1)
    rotation = torch.stack([right, torch.linalg.cross(backward, right), backward], dim=1)
    translation = -(rotation @ eye[:, :, None]).squeeze(-1)
    focal = 1 / math.tan(math.radians(fov) / 2)
    return Cameras(
        rotation,
        translation,
        torch.full_like(eye[:, :2], focal),
        torch.zeros_like(eye[:, :2]),
    )


def orbit(
    elevation: Float[Tensor, " views"],
    azimuth: Float[Tensor, " views"],
    distance: float,
    fov: float,
) -> Cameras:
    """Cameras on a sphere around the origin; angles in radians, azimuth 0 on +Z, pi/2 on +X."""
    elevation = elevation.clamp(-POLE_GUARD, POLE_GUARD)
    eye = distance * torch.stack(
        [
            elevation.cos() * azimuth.sin(),
            elevation.sin(),
            elevation.cos() * azimuth.cos(),
        ],
        dim=1,
    )
    return look_at(eye, torch.zeros_like(eye), fov)


def sample_global(
    config: ViewsConfig, generator: torch.Generator, count: int | None = None
) -> Cameras:
    """Random global views, on the CPU; with ``spread`` ``normal`` the first is exactly the
    centre."""
    count = config.count if count is None else count
    center = torch.tensor([math.radians(config.elevation), math.radians(config.azimuth)])
    std = torch.tensor([math.radians(config.elevation_std), math.radians(config.azimuth_std)])
    angles = center + std * torch.randn(count, 2, generator=generator)
    if config.spread == "around":
        start = torch.rand(1, generator=generator)
        angles[:, 1] = 2 * math.pi * (torch.arange(count) / count + start)
    else:
        angles[0] = center
    return orbit(angles[:, 0], angles[:, 1], config.distance, config.fov)


def zoom(cameras: Cameras, factor: float) -> Cameras:
    """Zoom in: everything appears ``factor`` times as large."""
    return replace(cameras, focal=cameras.focal * factor)


def crop_windows(
    config: LocalViewsConfig, views: int, generator: torch.Generator
) -> tuple[Float[Tensor, "crops 3"], Int[Tensor, " crops"]]:
    """Random windows inside the frame, ``per_view`` per view, and the view each belongs to."""
    side = config.share if config.crop == "side" else math.sqrt(config.share)
    count = views * config.per_view
    centers = (2 * torch.rand(count, 2, generator=generator) - 1) * (1 - side)
    windows = torch.cat([centers, torch.full((count, 1), side)], dim=1)
    return windows, torch.arange(views).repeat_interleave(config.per_view)


def crop_images(
    images: Float[Tensor, "views height width channels"],
    windows: Float[Tensor, "crops 3"],
    view: Int[Tensor, " crops"],
    size: int,
) -> Float[Tensor, "crops size size channels"]:
    """Cut windows out of rendered views, bilinearly resized to ``size``. The windows and their
    views are on the CPU."""
    theta = torch.zeros(len(windows), 2, 3, dtype=images.dtype)
    theta[:, 0, 0] = theta[:, 1, 1] = windows[:, 2]
    theta[:, 0, 2], theta[:, 1, 2] = windows[:, 0], -windows[:, 1]
    theta = theta.to(images.device, non_blocking=True)
    shape = [len(windows), images.shape[3], size, size]
    grid = functional.affine_grid(theta, shape, align_corners=False)
    chosen = images.permute(0, 3, 1, 2)[view.to(images.device, non_blocking=True)]
    cut = functional.grid_sample(chosen, grid, align_corners=False)
    return cut.permute(0, 2, 3, 1)


def random_perspective(
    config: ViewsConfig,
    images: Float[Tensor, "n height width channels"],
    fill: float,
    generator: torch.Generator,
) -> Float[Tensor, "n height width channels"]:
    """omega_global: with the configured probability, move every corner inwards by up to
    ``perspective`` half-frames; pixels from outside the frame are ``fill``."""
    if config.perspective == 0:
        return images
    count = len(images)
    square = torch.tensor([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    inward = torch.rand(count, 4, 2, generator=generator) * config.perspective
    drawn = torch.rand(count, 1, 1, generator=generator) < config.perspective_probability
    corners = torch.where(drawn, square * (1 - inward), square.expand(count, 4, 2))
    to_input = homography(corners, square.expand(count, 4, 2)).to(images.dtype)
    to_input = to_input.to(images.device, non_blocking=True)
    height, width = images.shape[1:3]
    ys = (2 * torch.arange(height, device=images.device) + 1) / height - 1
    xs = (2 * torch.arange(width, device=images.device) + 1) / width - 1
    grid = torch.stack(
        [
            xs.expand(height, width),
            ys[:, None].expand(height, width),
            xs.new_ones(height, width),
        ],
        dim=-1,
    )
    mapped = torch.einsum("nij,hwj->nhwi", to_input, grid)
    mapped = mapped[..., :2] / mapped[..., 2:].clamp(min=1e-6)
    warped = functional.grid_sample(images.permute(0, 3, 1, 2) - fill, mapped, align_corners=False)
    return warped.permute(0, 2, 3, 1) + fill


def homography(
    source: Float[Tensor, "n 4 2"], target: Float[Tensor, "n 4 2"]
) -> Float[Tensor, "n 3 3"]:
    """Projective maps from four source points to four target points."""
    count = len(source)
    x, y = source[..., 0].double(), source[..., 1].double()
    u, v = target[..., 0].double(), target[..., 1].double()
    one, zero = torch.ones_like(x), torch.zeros_like(x)
    rows_u = torch.stack([x, y, one, zero, zero, zero, -u * x, -u * y], dim=-1)
    rows_v = torch.stack([zero, zero, zero, x, y, one, -v * x, -v * y], dim=-1)
    system = torch.cat([rows_u, rows_v], dim=1)
    solution = torch.linalg.solve(system, torch.cat([u, v], dim=1))
    return torch.cat([solution, one[:, :1]], dim=1).reshape(count, 3, 3)


def surface_cameras(
    surface: Surface,
    extent: float,
    count: int,
    generator: torch.Generator,
    renderer: Renderer,
    shading: Shading,
) -> Cameras:
    """Close-up cameras that look straight down at random surface points.

    The window is ``extent`` wide at the surface, so the pattern has the same size in every image:
    heads and limbs count as much as backs, and there is no foreshortening. World +Y stays up, which
    keeps the direction of stripes. Points occluded by another part of the mesh are dropped, so
    there are at most ``count`` cameras. They are on the CPU.
    """
    points, directions = sample_surface(surface.on_cpu, 2 * count, generator)
    distance = extent / (2 * math.tan(math.radians(SURFACE_FOV) / 2))
    cameras = look_at(points + distance * directions, points, SURFACE_FOV)
    with torch.no_grad():
        depth = renderer.render(surface.vertices, surface.faces, cameras, shading, (9, 9)).depth
    if depth is None:
        return cameras[:count]
    seen = ((depth[:, 4, 4].cpu() - distance).abs() < 0.1 * distance).nonzero().squeeze(1)
    return cameras[seen[:count]] if len(seen) else cameras[:count]
