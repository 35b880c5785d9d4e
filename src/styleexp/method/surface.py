"""Differentiable quantities of triangle meshes."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from styleexp.inputs import meshes
from styleexp.system.transfer import to_host

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from torch import Tensor


@dataclass(frozen=True)
class Surface:
    """A triangle mesh as tensors on one device."""

    vertices: Float[Tensor, "vertices 3"]
    faces: Int[Tensor, "faces 3"]
    normals: Float[Tensor, "vertices 3"]
    """Unit vertex normals, area-weighted."""

    @functools.cached_property
    def on_cpu(self) -> Surface:
        """The same on the CPU, copied once."""
        tensors = (self.vertices, self.faces, self.normals)
        return Surface(*to_host(tensors)) if self.vertices.device.type != "cpu" else self


def vertex_areas(surface: Surface) -> Float[Tensor, " vertices"]:
    """A third of the area of the adjacent faces, per vertex."""
    a, b, c = (surface.vertices[surface.faces[:, i]] for i in range(3))
    areas = torch.linalg.cross(b - a, c - a).norm(dim=1) / 6
    total = surface.vertices.new_zeros(len(surface.vertices))
    return total.index_add(0, surface.faces.reshape(-1), areas.repeat_interleave(3))


STEEPEST = 0.02
"""Cosine between a face's normals before and after, below which it counts as flipped."""

DAMPING = 0.2
"""Fraction of the displacement that each iteration of `unfolded` removes at flipped faces."""


def unfolded(
    surface: Surface, displacement: Float[Tensor, " vertices"]
) -> Float[Tensor, " vertices"]:
    """Damp the displacement along the normals where faces would flip, until none do.

    At creases and thin parts, neighbouring normals cross within the displacement's range. Vertices
    of flipped faces are damped iteratively, and their neighbours in proportion to their share of
    damped neighbours.
    """
    faces, dtype = surface.faces, displacement.dtype
    vertices, normals = surface.vertices.to(dtype), surface.normals.to(dtype)
    tails, heads = faces.reshape(-1), faces[:, [1, 2, 0]].reshape(-1)
    both, other = torch.cat([tails, heads]), torch.cat([heads, tails])
    zeros = displacement.new_zeros(len(vertices))
    degree = zeros.index_add(0, both, torch.ones_like(both, dtype=dtype)).clamp(min=1)
    before = _face_normals(vertices, faces)
    for _ in range(100):  # almost nothing is left after that
        after = _face_normals(vertices + displacement[:, None] * normals, faces)
        turned = (before * after).sum(1) < STEEPEST * before.norm(dim=1) * after.norm(dim=1)
        if not bool(turned.any()):
            break
        at = zeros.index_fill(0, faces[turned].reshape(-1), 1.0)
        around = zeros.index_add(0, both, at[other]) / degree
        displacement = displacement * (1 - DAMPING * torch.maximum(at, around))
    return displacement


def _face_normals(
    vertices: Float[Tensor, "vertices 3"], faces: Int[Tensor, "faces 3"]
) -> Float[Tensor, "faces 3"]:
    """Face normals, of length twice the area."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return torch.linalg.cross(b - a, c - a)


def sample_surface(
    surface: Surface, count: int, generator: torch.Generator
) -> tuple[Float[Tensor, "count 3"], Float[Tensor, "count 3"]]:
    """Sample points uniformly on the surface, with interpolated unit normals."""
    corners = surface.vertices[surface.faces]
    areas = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    weights = areas.norm(dim=1).cpu().double()
    chosen = torch.multinomial(weights, count, replacement=True, generator=generator)
    u, v = torch.rand(2, count, generator=generator)
    flip = u + v > 1
    u, v = torch.where(flip, 1 - u, u), torch.where(flip, 1 - v, v)
    mix = torch.stack([1 - u - v, u, v], dim=1).to(surface.vertices)[:, :, None]
    picked = surface.faces[chosen.to(surface.faces.device)]
    normal = (surface.normals[picked] * mix).sum(1)
    return (surface.vertices[picked] * mix).sum(1), torch.nn.functional.normalize(normal, dim=1)


def normalised(mesh: meshes.Mesh, device: torch.device) -> tuple[meshes.Normalisation, Surface]:
    """The mesh in the unit sphere, on the device (Sec. 4.1)."""
    frame = meshes.normalisation(mesh.vertices)
    vertices = frame.apply(mesh.vertices)
    normals = meshes.vertex_normals(vertices, mesh.faces)
    on_cpu = Surface(
        torch.from_numpy(vertices).float(),
        torch.from_numpy(mesh.faces),
        torch.from_numpy(normals).float(),
    )
    tensors = on_cpu.vertices, on_cpu.faces, on_cpu.normals
    surface = Surface(*(each.to(device, non_blocking=True) for each in tensors))
    surface.__dict__["on_cpu"] = on_cpu  # known already
    return frame, surface
