"""Small differentiable quantities of triangle meshes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from torch import Tensor


def vertex_areas(
    vertices: Float[Tensor, "vertices 3"], faces: Int[Tensor, "faces 3"]
) -> Float[Tensor, " vertices"]:
    """A third of the area of the faces around each vertex."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    areas = torch.linalg.cross(b - a, c - a).norm(dim=1) / 6
    total = vertices.new_zeros(len(vertices))
    return total.index_add(0, faces.reshape(-1), areas.repeat_interleave(3))


def sample_surface(
    vertices: Float[Tensor, "vertices 3"],
    faces: Int[Tensor, "faces 3"],
    normals: Float[Tensor, "vertices 3"],
    count: int,
    generator: torch.Generator,
) -> tuple[Float[Tensor, "count 3"], Float[Tensor, "count 3"]]:
    """Points spread evenly over the surface, with their interpolated unit normals."""
    corners = vertices[faces]
    areas = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    weights = areas.norm(dim=1).cpu().double()
    chosen = torch.multinomial(weights, count, replacement=True, generator=generator)
    u, v = torch.rand(2, count, generator=generator)
    flip = u + v > 1
    u, v = torch.where(flip, 1 - u, u), torch.where(flip, 1 - v, v)
    mix = torch.stack([1 - u - v, u, v], dim=1).to(vertices)[:, :, None]
    picked = faces[chosen.to(faces.device)]
    normal = (normals[picked] * mix).sum(1)
    return (vertices[picked] * mix).sum(1), torch.nn.functional.normalize(normal, dim=1)
