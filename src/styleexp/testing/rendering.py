"""Meshes, cameras and assertions that the checks of renderers share."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING

import torch

from styleexp.renderers.base import Cameras, Renderer, RenderOutput, Shading
from styleexp.testing.checks import NotApplicable

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from torch import Tensor


EVEN = Shading(albedo=0.25, ambient=1.0, light=(0.0, 0.0, 0.0))
"""Shading with intensity 0.25 everywhere, so that only outlines show."""


_DEVICE: ContextVar[str | None] = ContextVar("device", default=None)


@contextmanager
def on(device: str) -> Iterator[None]:
    """Within, checks render on this device instead of the backend's first."""
    token = _DEVICE.set(device)
    try:
        yield
    finally:
        _DEVICE.reset(token)


def devices(renderer: Renderer) -> list[str]:
    """The devices that the backend claims and this machine has."""
    there = torch.cuda.is_available()
    return [name for name in renderer.capabilities.devices if there or name != "cuda"]


def icosphere(
    subdivisions: int,
) -> tuple[Float[Tensor, "vertices 3"], Int[Tensor, "faces 3"]]:
    """Unit sphere of 20 * 4**subdivisions faces, counter-clockwise seen from outside."""
    golden = (1 + math.sqrt(5)) / 2
    axes = [(0, a, b * golden) for a in (-1, 1) for b in (-1, 1)]
    vertices = torch.tensor([p[i:] + p[:i] for i in range(3) for p in axes], dtype=torch.float64)
    # Three corners one edge length apart make a face.
    near = torch.cdist(vertices, vertices).sub(2).abs() < 1e-6
    faces = torch.combinations(torch.arange(12), 3)
    a, b, c = faces.unbind(1)
    faces = faces[near[a, b] & near[b, c] & near[a, c]]
    outwards = torch.linalg.det(vertices[faces]) > 0
    faces = torch.where(outwards[:, None], faces, faces.flip(1))
    for _ in range(subdivisions):
        edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(1)[0]
        edges, index = torch.unique(edges, dim=0, return_inverse=True)
        ab, bc, ca = (index + len(vertices)).view(3, -1)
        vertices = torch.cat([vertices, vertices[edges].mean(1)])
        a, b, c = faces.unbind(1)
        parts = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
        faces = torch.cat([torch.stack(part, 1) for part in parts])
    return torch.nn.functional.normalize(vertices, dim=1).float(), faces


def bumpy_sphere(
    subdivisions: int,
) -> tuple[Float[Tensor, "vertices 3"], Int[Tensor, "faces 3"]]:
    """An icosphere of radius about 1 with broad asymmetric bumps."""
    vertices, faces = icosphere(subdivisions)
    x, y, z = vertices.unbind(1)
    radius = 0.9 + 0.12 * torch.sin(4 * x + 1) * torch.cos(3 * y) + 0.06 * torch.sin(5 * z + 2 * y)
    return vertices * radius[:, None], faces


def bent_grid(cells: int, seed: int) -> tuple[Tensor, Tensor]:
    """A square of 2 * cells**2 faces at z = 0, with jittered inner vertices."""
    steps = torch.linspace(-0.8, 0.8, cells + 1)
    y, x = torch.meshgrid(steps, steps, indexing="ij")
    vertices = torch.stack([x, y, torch.zeros_like(x)], 2)
    generator = torch.Generator().manual_seed(seed)
    jitter = torch.rand(cells + 1, cells + 1, 2, generator=generator) - 0.5
    vertices[1:-1, 1:-1, :2] += (jitter * 0.6 / cells)[1:-1, 1:-1]
    index = torch.arange((cells + 1) ** 2).view(cells + 1, cells + 1)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = torch.stack([torch.stack([a, b, c], -1), torch.stack([a, c, d], -1)]).view(-1, 3)
    return vertices.view(-1, 3), faces


def one_triangle(z: float = 0.0) -> Tensor:
    """A triangle of base and height 1, facing +z."""
    return torch.tensor([[-0.5, -0.5, z], [0.5, -0.5, z], [0.0, 0.5, z]])


def front_camera(from_behind: bool = False) -> Cameras:
    """Camera on +z (or -z), two units from the origin: world units at z = 0 are NDC units."""
    turn = torch.diag(torch.tensor([-1.0, 1, -1])) if from_behind else torch.eye(3)
    return Cameras(
        turn[None], torch.tensor([[0, 0, -2.0]]), torch.full((1, 2), 2.0), torch.zeros(1, 2)
    )


def cameras_around(count: int, focal: float = 2.2, spread: float = 1.0) -> Cameras:
    """Cameras around the origin at distance 2.5 and various heights, the first in front."""
    azimuth = torch.arange(count) * (2 * math.pi / count) * spread + 0.2
    height = 0.4 * torch.sin(torch.arange(count) * 1.7 + 0.5)
    backward = torch.stack(
        [azimuth.sin() * height.cos(), height.sin(), azimuth.cos() * height.cos()], 1
    )
    right = torch.stack([azimuth.cos(), torch.zeros(count), -azimuth.sin()], 1)
    rotation = torch.stack([right, torch.linalg.cross(backward, right), backward], 1)
    translation = torch.tensor([0, 0, -2.5]).expand(count, 3)
    return Cameras(rotation, translation, torch.full((count, 2), focal), torch.zeros(count, 2))


def rendered(
    renderer: Renderer,
    vertices: Tensor,
    faces: Tensor,
    cameras: Cameras,
    shading: Shading | None = None,
    size: tuple[int, int] = (32, 32),
) -> RenderOutput:
    """Render on the device under test, and return the result on the CPU."""
    device = _DEVICE.get() or renderer.capabilities.devices[0]
    out = renderer.render(
        vertices.to(device), faces.to(device), cameras, shading or Shading(), size
    )
    return RenderOutput(
        out.image.cpu(),
        out.coverage.cpu(),
        None if out.face_ids is None else out.face_ids.cpu().long(),
        None if out.depth is None else out.depth.cpu(),
    )


def face_ids(out: RenderOutput) -> Tensor:
    """The visible faces; the check is not applicable to a backend without them."""
    if out.face_ids is None:
        raise NotApplicable("returns no face ids")
    return out.face_ids


def need(claimed: bool, what: str) -> None:
    """The check is not applicable unless the backend claims this."""
    if not claimed:
        raise NotApplicable(f"is not differentiable w.r.t. {what}")


def need_ties(renderer: Renderer) -> None:
    """The check is not applicable to a backend that leaves ties open."""
    if not renderer.capabilities.decides_ties:
        raise NotApplicable("does not decide ties")


def interior_pixels(ids: Tensor) -> tuple[Tensor, Tensor]:
    """Rows and columns of covered pixels whose eight neighbours see the same face."""
    around = ids.unfold(0, 3, 1).unfold(1, 3, 1).reshape(*(side - 2 for side in ids.shape), 9)
    same = (around == around[..., 4:5]).all(-1) & (around[..., 4] >= 0)
    rows, columns = torch.nonzero(same, as_tuple=True)
    return rows + 1, columns + 1


def assert_covered_once(renderer: Renderer, vertices: Tensor, faces: Tensor) -> None:
    """Every pixel of the sheet is covered by exactly one face."""
    together = face_ids(rendered(renderer, vertices, faces, front_camera())) >= 0
    total = torch.zeros_like(together, dtype=torch.long)
    for face in faces:
        total += face_ids(rendered(renderer, vertices, face[None], front_camera())) >= 0
    assert torch.equal(total, together.long())
    assert together[0, 4:28, 4:28].all()
    assert not together[0, :3].any()


def assert_finite(renderer: Renderer, out: RenderOutput, vertices: Tensor) -> None:
    """Images are finite, and so is the gradient."""
    assert out.image.isfinite().all()
    assert out.coverage.isfinite().all()
    if renderer.capabilities.differentiable_shading:
        total = (out.image * torch.linspace(0, 1, out.image.shape[1])[:, None, None]).sum()
        (gradient,) = torch.autograd.grad(total + out.coverage.sum(), vertices)
        assert gradient.isfinite().all()


def assert_near(found: float, expected: float, relative: float) -> None:
    """The number is within a relative tolerance of what is expected."""
    assert abs(found - expected) <= relative * abs(expected), f"{found}, expected {expected}"


def pixel_weights(size: int) -> Tensor:
    """Smooth pixel weights, so that no symmetry cancels."""
    y, x = torch.meshgrid(*[torch.linspace(0, 1, size)] * 2, indexing="ij")
    return torch.cos(5 * x + 1) * torch.sin(4 * y + 0.3) + 0.7


def smooth_field(vertices: Tensor) -> Tensor:
    """A smooth displacement of every vertex."""
    x, y, z = vertices.unbind(1)
    return torch.stack([torch.sin(3 * y + 1), torch.cos(2 * z + 3 * x), torch.sin(4 * x + 2)], 1)


def assert_supersampled(renderer: Renderer, field: Callable[[Tensor], Tensor]) -> None:
    """The gradient along a displacement is that of a supersampled render, within a tenth."""
    need(renderer.capabilities.differentiable_visibility, "visibility")
    vertices, faces = bumpy_sphere(5)
    size, camera, shading = 200, cameras_around(1), Shading(normals="smooth")
    weight, direction = pixel_weights(size), field(vertices)

    def total(moved: Tensor, finer: int) -> Tensor:
        image = rendered(renderer, moved, faces, camera, shading, (size * finer,) * 2).image[..., 0]
        image = image.view(size, finer, size, finer).mean((1, 3))
        return (image * weight).double().sum()

    moved = vertices.clone().requires_grad_()
    value = total(moved, 1)
    need(value.requires_grad, "visibility")
    (gradient,) = torch.autograd.grad(value, moved)
    step = 2e-3
    with torch.no_grad():
        change = total(vertices + step * direction, 8) - total(vertices - step * direction, 8)
    assert_near(float((gradient * direction).sum()), float(change) / (2 * step), 0.1)
