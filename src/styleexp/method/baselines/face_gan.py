"""Networks on mesh faces: a generator of displacements, and its critic.

Inputs are the displacements of the vertices around each face, in the face's local frame, so the
networks are invariant to translation and rotation. A face's three neighbours have a cyclic order
without a start, so a layer averages its output over the three cyclic orders.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import nn
from torch.nn import functional

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jaxtyping import Float, Int
    from torch import Tensor

    from styleexp.method.baselines.pyramid import Level

POINTS = 6
"""Points per face: its corners, and the vertices across its edges."""

SLOPE = 0.2
"""Negative slope of the leaky ReLUs."""


@dataclass(frozen=True)
class Patch:
    """Some or all faces of a level."""

    faces: Int[Tensor, "faces 3"]
    points: Int[Tensor, "faces 6"]
    """Corners, then the vertices across the edges."""
    frames: Float[Tensor, "faces corners xyz 3"]
    neighbours: Int[Tensor, "faces 3"]
    """Adjacent faces, indexed within the patch; the face itself if the neighbour is outside."""

    @staticmethod
    def of(level: Level, chosen: Int[Tensor, " faces"] | None = None) -> Patch:
        """The patch of the chosen faces, by default all."""
        points = torch.cat([level.faces, level.opposite], dim=1)
        if chosen is None:
            return Patch(level.faces, points, level.frames, level.neighbours)
        number = torch.full((len(level.faces),), -1, device=chosen.device)
        own = torch.arange(len(chosen), device=chosen.device)
        number[chosen] = own
        across = number[level.neighbours[chosen]]
        across = torch.where(across < 0, own[:, None], across)
        return Patch(level.faces[chosen], points[chosen], level.frames[chosen], across)

    def seen(self, field: Float[Tensor, "vertices 3"]) -> Float[Tensor, "faces corners 18"]:
        """The field at each face's points, in each corner's frame, starting with that corner."""
        points = field.index_select(0, self.points.reshape(-1)).reshape(-1, POINTS, 3)
        local = torch.einsum("fkij,fpj->fkpi", self.frames, points)
        turned = [
            torch.cat([local[:, k, :3].roll(-k, 1), local[:, k, 3:].roll(-k, 1)], dim=1)
            for k in range(3)
        ]
        return torch.stack(turned, dim=1).flatten(2)

    def spread(
        self, local: Float[Tensor, "faces corners 3"], vertices: int
    ) -> Float[Tensor, "vertices 3"]:
        """Average per-corner vectors, given in corner frames, at the vertices; zero elsewhere."""
        vectors = torch.einsum("fkij,fki->fkj", self.frames, local).reshape(-1, 3)
        corners = self.faces.reshape(-1)
        total = vectors.new_zeros(vertices, 3).index_add(0, corners, vectors)
        count = vectors.new_zeros(vertices).index_add(0, corners, torch.ones_like(vectors[:, 0]))
        return total / count.clamp(min=1)[:, None]


class FaceOrders(nn.Module):
    """Linear map of each face and its three neighbours, for each of their three cyclic orders."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.own = nn.Linear(inputs, outputs)
        self.ring = nn.Linear(inputs, 3 * outputs, bias=False)

    def forward(
        self, x: Float[Tensor, "faces inputs"], neighbours: Int[Tensor, "faces 3"]
    ) -> Float[Tensor, "faces orders outputs"]:
        """Apply the map; order k starts with neighbour k."""
        return torch.stack(self.orders(x, neighbours), dim=1)

    def orders(self, x: Tensor, neighbours: Tensor) -> list[Float[Tensor, "faces outputs"]]:
        """Output for each order, as a list."""
        own = self.own(x)
        # One gather and views of it: neighbour n at position j is part 3 n + j.
        parts = self.ring(x).index_select(0, neighbours.reshape(-1))
        part = parts.reshape(len(x), 9, -1).unbind(1)
        return [
            own + part[3 * k] + part[3 * ((k + 1) % 3) + 1] + part[3 * ((k + 2) % 3) + 2]
            for k in range(3)
        ]


class FaceNet(nn.Module):
    """Face features: an input layer, then residual face convolutions."""

    def __init__(self, width: int, depth: int):
        super().__init__()
        self.see = nn.Linear(3 * POINTS, width)
        self.convs = nn.ModuleList(FaceOrders(width, width) for _ in range(depth))

    def forward(
        self, seen: Float[Tensor, "faces corners 18"], neighbours: Int[Tensor, "faces 3"]
    ) -> Float[Tensor, "faces width"]:
        """One row per face, invariant to the numbering of its corners."""
        x = _pooled(self.see(seen).unbind(1))
        for conv in self.convs:
            assert isinstance(conv, FaceOrders)
            x = x + _pooled(conv.orders(x, neighbours))
        return x


def _pooled(three: Sequence[Tensor]) -> Tensor:
    a, b, c = (functional.leaky_relu(each, SLOPE) for each in three)
    return (a + b + c) / 3


class Generator(nn.Module):
    """Adds detail to a displacement field; initialised to add nothing."""

    def __init__(self, width: int, depth: int):
        super().__init__()
        self.net = FaceNet(width, depth)
        self.out = FaceOrders(width, 3)
        self.skip = nn.Linear(3 * POINTS, 3, bias=False)
        for layer in (self.out.own, self.out.ring, self.skip):
            for parameter in layer.parameters():
                nn.init.zeros_(parameter)

    def forward(
        self, patch: Patch, field: Float[Tensor, "vertices 3"]
    ) -> Float[Tensor, "vertices 3"]:
        """Detail at the patch's vertices; both fields are normalised to unit scale."""
        seen = patch.seen(field)
        local = self.out(self.net(seen, patch.neighbours), patch.neighbours) + self.skip(seen)
        return patch.spread(local, len(field))


class Critic(nn.Module):
    """Scores each face by its surroundings; high for the exemplar's."""

    def __init__(self, width: int, depth: int):
        super().__init__()
        self.net = FaceNet(width, depth)
        self.out = nn.Linear(width, 1)

    def forward(
        self, seen: Float[Tensor, "faces corners 18"], neighbours: Int[Tensor, "faces 3"]
    ) -> Float[Tensor, " faces"]:
        """One score per face."""
        return self.out(self.net(seen, neighbours)).squeeze(1)


def gradient_penalty(
    critic: Critic,
    patch: Patch,
    real: Float[Tensor, "faces corners 18"],
    fake: Float[Tensor, "faces corners 18"],
    mix: float,
) -> Float[Tensor, ""]:
    """WGAN-GP: deviation of the critic's per-face gradient norm from 1, between real and fake."""
    between = (mix * real + (1 - mix) * fake).detach().requires_grad_(True)
    score = critic(between, patch.neighbours).sum()
    (slope,) = torch.autograd.grad(score, between, create_graph=True)
    return (slope.flatten(1).norm(dim=1) - 1).square().mean()
