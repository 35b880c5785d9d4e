"""The position-encoded displacement field (Sec. 3.2, Eq. 1)."""

from __future__ import annotations

import itertools
import math
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

import torch
from torch import nn
from torch.autograd.function import once_differentiable

from styleexp.method.large_steps import Diffusion
from styleexp.system.errors import UserError
from styleexp.system.process import has_onednn

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from torch import Tensor

    from styleexp.method.options import FieldConfig

REMEMBERED = 1 << 25
"""Maximum number of elements of a cached encoding, 128 MB."""


class Field(nn.Module, ABC):
    """The contract of a field: a displacement for every vertex. `testing.check_field` checks it.

    No displacement may exceed the ``bound`` that its factory is given (see `plugins.spec.Spec`).
    Its parameters are learned and its buffers are not; both are checkpointed. All random numbers
    come from the factory's ``generator``. It is moved with ``to(device)``.
    """

    def connect(self, faces: Int[Tensor, "faces 3"]) -> None:
        """Take note of the source's faces, for a field that uses a vertex's neighbours. Called once
        before the first evaluation, and not checkpointed. The default ignores them."""
        return

    @abstractmethod
    def forward(
        self,
        points: Float[Tensor, "vertices 3"],
        opened: float = 1.0,
        precision: torch.dtype = torch.float32,
    ) -> Float[Tensor, " vertices"]:
        """Displacement of every vertex along its normal, float32 and differentiable in the
        parameters, in radii of the normalised source.

        Args:
            points: the vertices of the normalised source: all of them, and the same in every step.
            opened: fraction of the frequencies that pass (``field.progressive``), from 0 to 1; a
                field without frequencies ignores it.
            precision: dtype in which the costly part may compute, bfloat16 where that is faster.
                The result is evaluated in float32.
        """


def check_field(field: Field, points: Float[Tensor, "vertices 3"], bound: float) -> None:
    """Raise `UserError` if the field breaks its contract before the first step."""
    with torch.no_grad():
        displacement = field(points)
    name = type(field).__name__
    if displacement.shape != (len(points),) or displacement.dtype != torch.float32:
        raise UserError(
            f"the field {name} returns {displacement.dtype} of shape {tuple(displacement.shape)} "
            f"for {len(points)} vertices: one float32 each is needed (docs/own-field.md)."
        )
    largest = float(displacement.abs().max())
    if not largest <= bound * (1 + 1e-6):
        raise UserError(
            f"the field {name} returns displacements of up to {largest:.3g}, beyond its bound of "
            f"{bound:.3g} (docs/own-field.md)."
        )


class FourierFeatures(nn.Module):
    """Random Fourier features, gamma(v) = [cos 2 pi B v, sin 2 pi B v] (Eq. 1).

    B is (features, 3) with entries from N(0, sigma^2), frozen. Its rows are sorted by norm, so that
    progressive opening goes from low to high frequencies.
    """

    frequencies: Tensor

    def __init__(
        self, features: int, sigma: float, include_input: bool, generator: torch.Generator
    ):
        super().__init__()
        frequencies = torch.randn(features, 3, generator=generator) * sigma
        order = frequencies.norm(dim=1).argsort()
        self.register_buffer("frequencies", frequencies[order])
        self.include_input = include_input
        self.size = 2 * features + (3 if include_input else 0)
        self._known: tuple[Any, Tensor, Tensor, Tensor] | None = None

    def forward(
        self, points: Float[Tensor, "vertices 3"], opened: float = 1.0
    ) -> Float[Tensor, "vertices size"]:
        """Encode points; ``opened`` in [0, 1] is the fraction of bands that pass."""
        # A run encodes the same points in every step.
        frequencies = self.frequencies
        key = (id(points), points._version, id(frequencies), frequencies._version, opened)
        if self._known is None or self._known[0] != key:
            phase = 2 * math.pi * points @ frequencies.T
            rows = frequencies.shape[0]
            window = (opened * rows - torch.arange(rows, device=points.device)).clamp(0, 1)
            bands = [phase.cos() * window, phase.sin() * window]
            encoded = torch.cat([points, *bands] if self.include_input else bands, dim=1)
            if points.requires_grad or encoded.numel() > REMEMBERED:
                return encoded
            # Kept references make sure that no other object gets their ids.
            self._known = (key, points, frequencies, encoded)
        return self._known[3]


class FourierMLP(Field):
    """MLP that maps a position to its displacement along the normal, in [-bound, bound].

    The last layer starts at zero, so that the generated mesh equals the source at step 0, unless
    ``last_layer`` is ``random``. ``sigma`` is in cycles per radius of the normalised source,
    ``bound`` in radii.

    With ``zero_mean`` the mean over the vertices is subtracted before the ``limit``, too. No loss
    constrains it, since the mean displacement is also subtracted; if it drifted, every vertex would
    saturate at the limit and learning would stop.
    """

    def __init__(self, config: FieldConfig, generator: torch.Generator, sigma: float, bound: float):
        super().__init__()
        self.bound = bound
        self.centred = config.zero_mean
        self.encode = FourierFeatures(config.features, sigma, config.include_input, generator)
        sizes = [self.encode.size] + [config.width] * (config.depth - 1) + [1]
        linears = [nn.utils.skip_init(nn.Linear, a, b) for a, b in itertools.pairwise(sizes)]
        for layer in linears:  # torch's default initialisation, with our generator
            span = 1 / math.sqrt(layer.in_features)
            nn.init.uniform_(layer.weight, -span, span, generator=generator)
            nn.init.uniform_(layer.bias, -span, span, generator=generator)
        if config.last_layer == "zero":
            nn.init.zeros_(linears[-1].weight)
            nn.init.zeros_(linears[-1].bias)
        self.limit = config.limit
        self.hidden = nn.ModuleList(linears[:-1])
        self.last = linears[-1]

    def forward(
        self,
        points: Float[Tensor, "vertices 3"],
        opened: float = 1.0,
        precision: torch.dtype = torch.float32,
    ) -> Float[Tensor, " vertices"]:
        """See `Field`. Hidden layers run in ``precision``; the last one always runs in float32,
        because neighbouring displacements differ by less than bfloat16 can resolve.
        """
        x = self.encode(points, opened).to(precision)
        fused = precision == torch.bfloat16 and has_onednn(x)
        for layer in self.hidden:
            assert isinstance(layer, nn.Linear)
            weight, bias = layer.weight.to(precision), layer.bias.to(precision)
            if fused:
                x = _LinearRelu.apply(x, weight, bias)
            else:
                x = torch.relu(nn.functional.linear(x, weight, bias))
        latent = self.last(x.float()).squeeze(-1)
        latent = latent - latent.mean() if self.centred else latent
        return self.bound * (torch.tanh(latent) if self.limit == "tanh" else latent.clamp(-1, 1))


class _LinearRelu(torch.autograd.Function):
    """Fused linear layer and ReLU: one memory pass forward, one saved array less backward."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        out = torch.ops.mkldnn._linear_pointwise(x, weight, bias, "relu", [], "")
        ctx.save_for_backward(x, weight, out)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor, Tensor]:
        x, weight, out = ctx.saved_tensors
        grad = torch.ops.aten.threshold_backward(grad, out, 0)
        into = grad @ weight if ctx.needs_input_grad[0] else None
        return into, grad.t() @ x, grad.sum(0)


class VertexField(Field):
    """A free displacement per vertex, in [-bound, bound], from zero: the field without the
    network.

    With ``smoothness`` the parameter is not x but u = (I + smoothness L) x
    (`large_steps.Diffusion`), and the displacement is bound tanh(x).
    """

    def __init__(self, vertices: int, bound: float, smoothness: float = 0.0):
        super().__init__()
        self.bound = bound
        self.smoothness = smoothness
        self.latent = nn.Parameter(torch.zeros(vertices))
        self._diffusion: Diffusion | None = None

    def connect(self, faces: Int[Tensor, "faces 3"]) -> None:
        """Factorise the system of these faces, if there is any ``smoothness``."""
        if self.smoothness > 0:
            self._diffusion = Diffusion(faces, len(self.latent), self.smoothness)

    def forward(
        self,
        points: Float[Tensor, "vertices 3"],
        opened: float = 1.0,
        precision: torch.dtype = torch.float32,
    ) -> Float[Tensor, " vertices"]:
        """See `Field`; ``opened`` and ``precision`` have no effect. Raises `ValueError` for another
        number of points, or with ``smoothness`` before `connect`."""
        if len(points) != len(self.latent):
            raise ValueError(f"the field has {len(self.latent)} vertices, got {len(points)} points")
        latent: Tensor = self.latent
        if self.smoothness > 0:
            if self._diffusion is None:
                raise ValueError("field.smoothness needs the faces: call connect(faces) first")
            latent = self._diffusion(latent)
        return self.bound * torch.tanh(latent)


def zero_mean(
    displacement: Float[Tensor, " vertices"], areas: Float[Tensor, " vertices"], bound: float
) -> Float[Tensor, " vertices"]:
    """Subtract the area-weighted mean, so that the mesh neither grows nor shrinks overall, and stay
    within the bound."""
    mean = (displacement * areas).sum() / areas.sum()
    return (displacement - mean).clamp(-bound, bound)
