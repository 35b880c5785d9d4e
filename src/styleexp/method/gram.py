"""The paper's method: optimise a displacement field until the renders' Grams match the style's.

source mesh C ──► Fourier features ──► MLP ──► d ──► M = C + d n          Sec. 3.2, Eq. 1
M ──► differentiable renderer ──► global and local views                  Sec. 3.3.1, Eq. 2
views ──► VGG ──► Gram matrices ──► distance to the style's               Sec. 3.3.2-3, Eqs. 3-8
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from styleexp import plugins
from styleexp.inputs import meshes
from styleexp.method.fields import zero_mean
from styleexp.method.masks import masked
from styleexp.method.scene import Scene, Subject
from styleexp.method.scene import prepare as prepare  # this module is a `baselines.Method`
from styleexp.method.surface import unfolded
from styleexp.method.views import step_generator
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from torch import Tensor

    from styleexp.config.schema import OptimConfig
    from styleexp.method.viewer import Images


EXPLODED = 1e6
"""The run counts as diverged above this multiple of the first loss."""


class Diverged(UserError):
    """A step produced values the run cannot continue from."""

    def __init__(self, step: int, part: str, told: str):
        self.step, self.part = step, part
        super().__init__(
            f"{told} at step {step}: lower optim.rate, or check the source and the style for "
            "degenerate geometry."
        )


MOST_RATE = 10.0
"""Most that ``optim.nominal_steps`` raises the rate: beyond, displacements saturate within a few
steps."""

WARM_UP = 0.1
"""Fraction of the run over which the cosine schedule warms up. Adam's first steps are as long as
any other, but their direction is mostly noise."""


@dataclass
class State:
    """Everything a step changes; the content of a checkpoint."""

    field: Any
    """A module such as `fields.DisplacementField`."""
    optimizer: torch.optim.Adam
    step: int = 0


@dataclass(frozen=True)
class Step:
    """Measurements of one optimisation step."""

    step: int
    loss: float
    loss_global: float
    loss_local: float
    rms_displacement: float
    """RMS displacement, in radii of the normalised source."""
    blank_views: int
    """Number of views that don't show the mesh; a masked loss (``loss.masked``) skips them."""
    seconds: float = field(compare=False)


@dataclass(frozen=True)
class Result:
    """The generated mesh M."""

    scene: Subject
    """The run's subject; its source has the result's faces."""
    displacement: Float[np.ndarray, " vertices"]
    """Signed displacement along the source's normals, in the source's own units."""
    vertices: Float[np.ndarray, "vertices 3"]
    """Positions in the source's own frame."""

    @property
    def faces(self) -> Int[np.ndarray, "faces 3"]:
        """Indices of M's vertices, the source's faces."""
        return self.scene.source.faces

    def trimesh(self) -> Any:
        """M as a ``trimesh.Trimesh`` with the same vertex and face order; the displacement is the
        vertex attribute ``displacement``."""
        import trimesh

        return trimesh.Trimesh(
            self.vertices,
            self.faces,
            process=False,
            vertex_attributes={"displacement": self.displacement},
        )

    def save(self, path: str | Path) -> None:
        """Write M as PLY (with the displacement as a vertex attribute), OBJ or GLB."""
        meshes.save_mesh(self.scene.source, self.vertices, path, self.displacement)


def start(scene: Scene) -> State:
    """State before the first step: M is the source C, or with ``field.start=map`` C displaced by
    the style's height map, which the field adds to."""
    optim = scene.config.optim
    generator = step_generator(optim.seed, 0, stream=7)
    config, bound = scene.config.field, scene.bound
    if scene.base is not None:
        bound *= config.learned
    displacement_field = plugins.build(
        "field", config, generator=generator, sigma=scene.sigma, bound=bound
    )
    displacement_field.to(scene.surface.vertices.device)
    displacement_field.encode(scene.surface.vertices)  # initialises lazy parameters
    adam = torch.optim.Adam(displacement_field.parameters(), lr=optim.rate)
    return State(displacement_field, adam)


def optimise(scene: Scene, state: State) -> Iterator[Step]:
    """Run the remaining steps, yielding after each; ``state`` may be saved between them."""
    optim, loss, surface = scene.config.optim, scene.loss, scene.surface
    first: float | None = None
    while state.step < optim.steps:
        begun = time.perf_counter()
        for group in state.optimizer.param_groups:
            group["lr"] = learning_rate(optim, state.step)

        displacement = displace(scene, state)
        generated = surface.vertices + displacement[:, None] * surface.normals
        if optim.renormalize:
            generated = generated / generated.detach().norm(dim=1).max()
        whole, local = scene.viewer(generated, state.step)
        whole_target, local_target = scene.target(state.step)
        loss_global = loss.distance(loss.grams(whole), whole_target, scene.scales[0])
        loss_local = loss.distance(loss.grams(local), local_target, scene.scales[1])
        total = loss.config.lambda_global * loss_global + loss.config.lambda_local * loss_local
        relief = (displacement / scene.relief).pow(4).mean()
        total = total + loss.config.relief_weight * relief

        first = total.item() if first is None else first
        _check_numbers(
            state.step,
            {
                "the displacement": displacement,
                "the global views": whole.image,
                "the local views": local.image,
                "the loss of the global views": loss_global,
                "the loss of the local views": loss_local,
                "the loss": total,
            },
            total.item(),
            first,
        )
        state.optimizer.zero_grad()
        total.backward()
        gradient = gradient_length(state.field)
        _check_numbers(state.step, {"the gradient": gradient}, 0.0, 0.0)
        if optim.unit_gradient:
            normalise_gradient(state.field, gradient)
        state.optimizer.step()
        state.step += 1
        yield Step(
            state.step,
            total.item(),
            loss_global.item(),
            loss_local.item(),
            displacement.detach().square().mean().sqrt().item(),
            blank(whole) + blank(local),
            time.perf_counter() - begun,
        )


def gradient_length(field: torch.nn.Module) -> Float[Tensor, ""]:
    """Norm of the gradient over all parameters."""
    return torch.nn.utils.get_total_norm([p.grad for p in field.parameters() if p.grad is not None])


def normalise_gradient(field: torch.nn.Module, length: Float[Tensor, ""]) -> None:
    """Divide the gradient of all parameters by ``length``, its norm; zero stays zero."""
    for parameter in field.parameters():
        if parameter.grad is not None:
            parameter.grad /= length.clamp(min=1e-30)


def _check_numbers(step: int, parts: dict[str, Tensor], total: float, first: float) -> None:
    """Raise `Diverged` for the first part that isn't finite, or if the loss ``total`` exceeds
    `EXPLODED` times the ``first`` one. All parts are checked, because a fused ReLU turns NaN into
    0, so NaN in a picture may not reach the loss. The field is still unchanged by the step."""
    # Minimum and maximum are NaN if any value is: four times as fast as checking each value. All
    # parts are checked together, since each transfer synchronises the GPU.
    ranges = [torch.stack(values.detach().aminmax()) for values in parts.values()]
    finite = torch.stack([each.isfinite().all() for each in ranges]).tolist()
    for part, is_finite in zip(parts, finite, strict=True):
        if not is_finite:
            raise Diverged(step, part, f"{part} became NaN or infinite")
    if abs(total) > EXPLODED * (1 + abs(first)):
        raise Diverged(step, "the loss", f"the loss exploded, from {first:.3g} to {total:.3g},")


def blank(seen: Images) -> int:
    """Number of views that don't show the mesh at all."""
    return int((seen.coverage.flatten(1).amax(1) <= 0).sum())


def learning_rate(optim: OptimConfig, step: int) -> float:
    """Learning rate of a step; see ``OptimConfig.schedule``."""
    if optim.schedule == "step":
        shorter = min((optim.nominal_steps or optim.steps) / optim.steps, MOST_RATE)
        decays = math.floor(step * shorter / optim.decay_every)
        return optim.rate * shorter * optim.decay**decays
    rising = min(1.0, (step + 1) / (WARM_UP * optim.steps))
    falling = 0.5 * (1 + math.cos(math.pi * step / optim.steps))
    return optim.rate * rising * (0.05 + 0.95 * falling)


def displace(
    scene: Scene, state: State, precision: torch.dtype | None = None
) -> Float[Tensor, " vertices"]:
    """Displacement d of every vertex, in radii of the normalised source: the field's output plus
    ``scene.base``, if any (``field.start``; the paper has none), times ``scene.mask``.
    """
    config = scene.config.field
    if precision is None:
        precision = torch.bfloat16 if scene.loss.encoder.precision == "bf16" else torch.float32
    opened = 1.0
    if config.progressive > 0:
        opened = min(1.0, state.step / (config.progressive * scene.config.optim.steps))
    displacement = state.field(state.field.encode(scene.surface.vertices, opened), precision)
    if scene.base is not None:
        displacement = (scene.base + displacement).clamp(-scene.bound, scene.bound)
    if config.zero_mean:
        displacement = zero_mean(displacement, scene.weights, scene.bound)
    return masked(displacement, scene.mask)


def finish(scene: Scene, state: State) -> Result:
    """Return the generated mesh in the source's own frame; the field is evaluated in float32."""
    with torch.no_grad():
        displacement = displace(scene, state, torch.float32).double() * scene.config.strength
        if scene.config.field.unfold:
            displacement = unfolded(scene.surface, displacement)
    offset = displacement[:, None] * scene.surface.normals.double()
    radius = scene.frame.scale
    return Result(
        scene,
        displacement.cpu().numpy() * radius,
        scene.source.vertices + offset.cpu().numpy() * radius,
    )
