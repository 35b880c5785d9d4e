"""Networks on the faces of a triangle mesh: a generator of displacements, and its critic.

They see a displacement field of the vertices around each face, in the face's own frame, and so work
alike wherever a face lies and however it is turned. A face has three neighbours in a cyclic order
without a first one: a layer averages what it makes of each of the three orders.
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

    from styleexp.baselines.pyramid import Level

POINTS = 6
"""What a face sees: its corners, and the vertices across its edges."""

SLOPE = 0.2
"""Of the leaky rectifiers."""


@dataclass(frozen=True)
class Patch:
    """Some faces of a level, or all."""

    faces: Int[Tensor, "faces 3"]
    points: Int[Tensor, "faces 6"]
    """Corners, then the vertices across the edges."""
    frames: Float[Tensor, "faces corners xyz 3"]
    neighbours: Int[Tensor, "faces 3"]
    """Numbered within the patch; the face itself where the neighbour is not in it."""

    @staticmethod
    def of(level: Level, chosen: Int[Tensor, " faces"] | None = None) -> Patch:
        """The patch of the chosen faces, of all by default."""
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
        """The field at each face's points in each corner's frame, that corner's point first."""
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
        """Vectors of corners, each in its frame, averaged at their vertices; elsewhere zero."""
        vectors = torch.einsum("fkij,fki->fkj", self.frames, local).reshape(-1, 3)
        corners = self.faces.reshape(-1)
        total = vectors.new_zeros(vertices, 3).index_add(0, corners, vectors)
        count = vectors.new_zeros(vertices).index_add(0, corners, torch.ones_like(vectors[:, 0]))
        return total / count.clamp(min=1)[:, None]


class FaceOrders(nn.Module):
    """A linear map of each face and its three neighbours, in each of their three orders."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.own = nn.Linear(inputs, outputs)
        self.ring = nn.Linear(inputs, 3 * outputs, bias=False)

    def forward(
        self, x: Float[Tensor, "faces inputs"], neighbours: Int[Tensor, "faces 3"]
    ) -> Float[Tensor, "faces orders outputs"]:
        """Order k has neighbour k first."""
        return torch.stack(self.orders(x, neighbours), dim=1)

    def orders(self, x: Tensor, neighbours: Tensor) -> list[Float[Tensor, "faces outputs"]]:
        """The same as a list."""
        own = self.own(x)
        # One gather, and views of it: neighbour n at place j is part 3 n + j.
        parts = self.ring(x).index_select(0, neighbours.reshape(-1))
        part = parts.reshape(len(x), 9, -1).unbind(1)
        return [
            own + part[3 * k] + part[3 * ((k + 1) % 3) + 1] + part[3 * ((k + 2) % 3) + 2]
            for k in range(3)
        ]


class FaceNet(nn.Module):
    """Features of faces: what they see, then face convolutions with residual connections."""

    def __init__(self, width: int, depth: int):
        super().__init__()
        self.see = nn.Linear(3 * POINTS, width)
        self.convs = nn.ModuleList(FaceOrders(width, width) for _ in range(depth))

    def forward(
        self, seen: Float[Tensor, "faces corners 18"], neighbours: Int[Tensor, "faces 3"]
    ) -> Float[Tensor, "faces width"]:
        """One row per face, the same however its corners are numbered."""
        x = _pooled(self.see(seen).unbind(1))
        for conv in self.convs:
            assert isinstance(conv, FaceOrders)
            x = x + _pooled(conv.orders(x, neighbours))
        return x


def _pooled(three: Sequence[Tensor]) -> Tensor:
    a, b, c = (functional.leaky_relu(each, SLOPE) for each in three)
    return (a + b + c) / 3


class Generator(nn.Module):
    """Adds detail to a displacement field; adds nothing before it is trained."""

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
        """The detail, at the patch's vertices; both fields in units of about their own size."""
        seen = patch.seen(field)
        local = self.out(self.net(seen, patch.neighbours), patch.neighbours) + self.skip(seen)
        return patch.spread(local, len(field))


class Critic(nn.Module):
    """Scores each face by what is around it: high for the exemplar's."""

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
    """WGAN-GP: how far the critic's slope, face by face, is from 1 between real and fake."""
    between = (mix * real + (1 - mix) * fake).detach().requires_grad_(True)
    score = critic(between, patch.neighbours).sum()
    (slope,) = torch.autograd.grad(score, between, create_graph=True)
    return (slope.flatten(1).norm(dim=1) - 1).square().mean()
