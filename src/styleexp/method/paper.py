"""The paper's method: optimise a displacement field until the renders' Grams match the style's.

source mesh C ──► Fourier features ──► MLP ──► d ──► M = C + d n          Sec. 3.2, Eq. 1
M ──► differentiable renderer ──► global and local views                  Sec. 3.3.1, Eq. 2
views ──► VGG ──► Gram matrices ──► distance to the style's               Sec. 3.3.2-3, Eqs. 3-8

``method=paper`` and its amendments, ``robust``, ``vertex`` and ``text2mesh`` are this loop with
other options and parts.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from styleexp.method.base import Method, Result, State, Step, displaced
from styleexp.method.fields import Field, check_field, zero_mean
from styleexp.method.gram_cache import uncached
from styleexp.method.large_steps import AdamUniform
from styleexp.method.masks import masked
from styleexp.method.scene import Cache, PaperScene, Parts, prepare
from styleexp.method.stepping import (
    check_finite,
    check_loss,
    gradient_norm,
    learning_rate,
    normalise_gradient,
    read,
)
from styleexp.method.surface import unfolded
from styleexp.method.targets import in_step
from styleexp.method.views import step_generator

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from styleexp.method.subject import Subject


@dataclass(frozen=True)
class PaperLoop(Method[PaperScene]):
    """The learned method, from its parts."""

    parts: Parts
    field: Callable[..., Field]
    """Builds the field from ``points``, ``generator``, ``sigma`` and ``bound``; see
    `plugins.spec.Spec`."""
    separates_relief: bool = False
    """Needed to start from the synthesised relief (``field.start=synthesis``)."""
    cache: Cache = uncached

    def prepare(self, subject: Subject) -> PaperScene:
        """Measure the style and the source as the loss sees them."""
        return prepare(subject, self.parts, self.cache)

    def start(self, scene: PaperScene) -> State:
        """State before the first step: M is the source C, or with ``field.start`` C displaced by
        ``scene.base``, which the field adds to."""
        subject, settings = scene.subject, scene.subject.settings
        field = self.field(
            points=subject.surface.vertices,
            generator=step_generator(settings.optim.seed, 0, stream=7),
            sigma=subject.sigma,
            bound=subject.bound * (1.0 if scene.base is None else settings.field.learned),
        )
        field.to(subject.surface.vertices.device, non_blocking=True)
        field.connect(subject.surface.faces)
        check_field(field, subject.surface.vertices, subject.bound)
        kinds = {"each": torch.optim.Adam, "uniform": AdamUniform}
        kind = kinds[settings.optim.second_moment]
        return State(field, kind(field.parameters(), lr=settings.optim.rate))

    def optimise(self, scene: PaperScene, state: State) -> Iterator[Step]:
        """Run the remaining steps, yielding after each; ``state`` may be saved between them."""
        subject, options = scene.subject, scene.subject.settings.loss
        optim, surface = subject.settings.optim, subject.surface
        first: float | None = None
        while state.step < optim.steps:
            begun = time.perf_counter()
            for group in state.optimizer.param_groups:
                group["lr"] = learning_rate(optim, state.step)

            displacement = displace(scene, state, scene.precision)
            generated = surface.vertices + displacement[:, None] * surface.normals
            if optim.renormalize:
                generated = generated / generated.detach().norm(dim=1).max()
            loss = in_step(scene.loss, optim.seed, state.step)
            whole, local = scene.viewer(generated, state.step)
            whole_target, local_target = scene.target(state.step)
            loss_global = loss.distance(loss.describe(whole), whole_target, scene.scales[0])
            loss_local = loss.distance(loss.describe(local), local_target, scene.scales[1])
            total = options.lambda_global * loss_global + options.lambda_local * loss_local
            penalty = (displacement / subject.relief).pow(4).mean()
            total = total + options.relief_weight * penalty

            state.optimizer.zero_grad()
            total.backward()
            gradient = gradient_norm(state.field)
            measured = {
                "the displacement": displacement,
                "the global views": whole.image,
                "the local views": local.image,
                "the loss of the global views": loss_global,
                "the loss of the local views": loss_local,
                "the loss": total,
            }
            numbers = {
                "gradient": gradient,
                "rms": displacement.detach().square().mean().sqrt(),
                "blank": whole.blank() + local.blank(),
            }
            found = read(measured, numbers)
            # The field is still unchanged by the step.
            check_finite(state.step + 1, found.ranges)
            (loss_value, _) = found.ranges["the loss"]
            first = loss_value if first is None else first
            check_loss(state.step + 1, loss_value, first)
            length = found.numbers["gradient"]
            check_finite(state.step + 1, {"the gradient": (length, length)})
            if optim.unit_gradient:
                normalise_gradient(state.field, gradient)
            state.optimizer.step()
            state.step += 1
            yield Step(
                state.step,
                loss_value,
                found.ranges["the loss of the global views"][0],
                found.ranges["the loss of the local views"][0],
                found.numbers["rms"],
                round(found.numbers["blank"]),
                time.perf_counter() - begun,
            )

    def finish(self, scene: PaperScene, state: State | None) -> Result:
        """The generated mesh; the field is evaluated in float32."""
        assert state is not None
        settings, surface = scene.subject.settings, scene.subject.surface
        with torch.no_grad():
            displacement = displace(scene, state, torch.float32).double() * settings.strength
            if settings.field.unfold:
                displacement = unfolded(surface, displacement)
        return displaced(scene.subject, displacement)


def displace(scene: PaperScene, state: State, precision: torch.dtype) -> Float[Tensor, " vertices"]:
    """Displacement d of every vertex, in radii of the normalised source: the field's output plus
    ``scene.base``, if any (``field.start``; the paper has none), times the mask."""
    subject, config = scene.subject, scene.subject.settings.field
    opened = 1.0
    if config.progressive > 0:
        opened = min(1.0, state.step / (config.progressive * subject.settings.optim.steps))
    displacement = state.field(subject.surface.vertices, opened, precision)
    if scene.base is not None:
        displacement = (scene.base + displacement).clamp(-subject.bound, subject.bound)
    if config.zero_mean:
        displacement = zero_mean(displacement, subject.weights, subject.bound)
    return masked(displacement, subject.mask)
