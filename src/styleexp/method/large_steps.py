"""Smooth steps of vertices (Nicolet et al. 2021, *Large Steps in Inverse Rendering of Geometry*):
the preconditioner, and the optimiser used with it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch.autograd.function import once_differentiable

from styleexp.inputs import meshes

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from torch import Tensor


class Diffusion:
    """x = (I + lambda L)^-1 u, where L is the combinatorial Laplacian of the mesh's edges:
    a vertex's degree, less 1 for each neighbour.

    Factorised once; every solution and every gradient, for which the symmetric system is solved
    again, is two triangular solutions on the CPU. A constant u is its own x, and so is a vertex
    without faces.
    """

    def __init__(self, faces: Int[Tensor, "faces 3"], vertices: int, smoothness: float):
        """Raises `ValueError` for a negative ``smoothness``, which is lambda."""
        from scipy.sparse import coo_matrix, diags, identity
        from scipy.sparse.linalg import splu

        if smoothness < 0:
            raise ValueError(f"lambda is {smoothness}, but can't be negative")
        corners = faces.detach().cpu().numpy()
        edges = meshes.edges_of(corners)
        edges = edges[edges[:, 0] != edges[:, 1]]
        ones = np.ones(len(edges))
        half = coo_matrix((ones, (edges[:, 0], edges[:, 1])), shape=(vertices, vertices))
        joined = (half + half.T).tocsc()
        degrees = np.asarray(joined.sum(axis=0)).ravel()
        system = identity(vertices, format="csc") + smoothness * (diags(degrees) - joined)
        # Symmetric and positive definite: pivots may stay on the diagonal, which keeps the factors
        # as sparse as Cholesky's.
        self._factors = splu(
            system.tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )

    def __call__(self, values: Float[Tensor, " vertices"]) -> Float[Tensor, " vertices"]:
        """x for this u, in its dtype; differentiable once."""
        return _Solve.apply(values, self._solved)

    def _solved(self, values: Tensor) -> Tensor:
        solution = self._factors.solve(values.detach().cpu().double().numpy())
        return torch.from_numpy(solution).to(values)


class _Solve(torch.autograd.Function):
    """Solve a symmetric system; its adjoint is itself."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, solve: Callable[[Tensor], Tensor]) -> Tensor:
        ctx.solve = solve
        return solve(values)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        return ctx.solve(grad), None


class AdamUniform(torch.optim.Optimizer):
    """Adam whose second moment is the largest of its parameter, as in the paper: all of its
    entries are divided by the same number, so that a smooth gradient makes a smooth step."""

    def __init__(
        self,
        parameters: Any,
        lr: float,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
    ):
        super().__init__(parameters, {"lr": lr, "betas": betas, "eps": eps})

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:  # type: ignore[override]
        """One step; ``closure`` is not supported."""
        if closure is not None:
            raise ValueError("AdamUniform takes no closure")
        for group in self.param_groups:
            first, second = group["betas"]
            for parameter in group["params"]:
                if parameter.grad is None:
                    continue
                state = self.state[parameter]
                if not state:
                    state["step"] = torch.tensor(0.0)
                    state["exp_avg"] = torch.zeros_like(parameter)
                    state["exp_avg_sq"] = torch.zeros_like(parameter)
                state["step"] += 1
                taken = float(state["step"])
                mean, square = state["exp_avg"], state["exp_avg_sq"]
                mean.lerp_(parameter.grad, 1 - first)
                square.lerp_(parameter.grad.square(), 1 - second)
                size = (square.max() / (1 - second**taken)).sqrt() + group["eps"]
                parameter -= group["lr"] / (1 - first**taken) * mean / size
