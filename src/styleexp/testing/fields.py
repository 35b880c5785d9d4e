"""Checks of `method.fields.Field`.

``check_field(build)`` runs all of them on what ``build(points=, generator=, sigma=, bound=)``
returns, which is a plugin's factory without its options: ``partial(factory, options)``.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from safetensors.torch import load, save

from styleexp.method.fields import Field
from styleexp.testing import checks

Build = Callable[..., Field]
BOUND = 0.1


def points(count: int = 300) -> torch.Tensor:
    """Points on the unit sphere."""
    found = torch.randn(count, 3, generator=torch.Generator().manual_seed(5))
    return torch.nn.functional.normalize(found, dim=1)


def faces(of: torch.Tensor) -> torch.Tensor:
    """Triangles between points on a sphere: those of their convex hull."""
    from scipy.spatial import ConvexHull

    return torch.from_numpy(ConvexHull(of.numpy()).simplices).long()


def made(build: Build, seed: int = 0) -> Field:
    """A field for `points`, connected by `faces`."""
    generator = torch.Generator().manual_seed(seed)
    field = build(points=points(), generator=generator, sigma=5.0, bound=BOUND)
    if isinstance(field, Field):
        field.connect(faces(points()))
    return field


def _learned(build: Build) -> Field:
    """A field after ten steps towards a pattern."""
    field, at = made(build), points()
    goal = 0.5 * BOUND * torch.sin(6 * at[:, 0])
    adam = torch.optim.Adam(field.parameters(), lr=1e-2)
    for _ in range(10):
        adam.zero_grad()
        (field(at) - goal).square().sum().backward()
        adam.step()
    return field


def one_number_for_every_point(build: Build) -> None:
    """A field returns float32 of shape (vertices,), finite, and at the start within the bound."""
    field = made(build)
    assert isinstance(field, Field), f"{type(field).__name__} is not a Field"
    for opened, precision in ((1.0, torch.float32), (0.3, torch.float32), (1.0, torch.bfloat16)):
        displacement = field(points(), opened, precision)
        assert displacement.shape == (300,), f"shape {tuple(displacement.shape)}"
        assert displacement.dtype == torch.float32, f"{displacement.dtype}"
        assert bool(displacement.isfinite().all()), "not finite"
        largest = float(displacement.detach().abs().max())
        assert largest <= BOUND * (1 + 1e-6), f"{largest} exceeds the bound {BOUND}"


def equal_generators_make_equal_fields(build: Build) -> None:
    """All randomness is that of the generator: equal ones give the same bits, and the global state
    isn't touched."""
    before = torch.get_rng_state()
    one, other = made(build, 3), made(build, 3)
    assert torch.equal(torch.get_rng_state(), before), "it draws from the global generator"
    for name, value in one.state_dict().items():
        assert torch.equal(value, other.state_dict()[name]), f"{name} differs"
    assert torch.equal(one(points()), other(points()))


def it_learns(build: Build) -> None:
    """Ten steps of Adam bring it nearer to a pattern; every parameter gets a finite gradient."""
    field, at = made(build), points()
    goal = 0.5 * BOUND * torch.sin(6 * at[:, 0])
    first = (field(at) - goal).square().sum()
    first.backward()
    assert list(field.parameters()), "it has no parameters"
    for name, parameter in field.named_parameters():
        assert parameter.grad is not None, f"{name} gets no gradient"
        assert bool(parameter.grad.isfinite().all()), f"{name}'s gradient is not finite"
    last = (_learned(build)(at) - goal).square().sum()
    before, after = float(first.detach()), float(last.detach())
    assert after < 0.9 * before, (
        f"ten steps take the squared error from {before:.3g} only to {after:.3g}"
    )


def it_keeps_its_bound(build: Build) -> None:
    """However far it is trained, no displacement exceeds the bound."""
    field, at = made(build), points()
    adam = torch.optim.Adam(field.parameters(), lr=1.0)
    for _ in range(20):
        adam.zero_grad()
        (-field(at)[:100].sum() + field(at)[100:].sum()).backward()
        adam.step()
    largest = float(field(at).detach().abs().max())
    assert largest <= BOUND * (1 + 1e-6), f"{largest} exceeds the bound {BOUND}"


def a_checkpoint_brings_it_back(build: Build) -> None:
    """Its ``state_dict`` is all there is: loaded into a field just made, it gives the same bits."""
    field, other = _learned(build), made(build, 9)
    other.load_state_dict(load(save(field.state_dict())))
    assert torch.equal(field(points()), other(points()))


CHECKS: tuple[Callable[[Build], None], ...] = (
    one_number_for_every_point,
    equal_generators_make_equal_fields,
    it_learns,
    it_keeps_its_bound,
    a_checkpoint_brings_it_back,
)


def check_field(build: Build) -> dict[str, str]:
    """Run every check; see `checks.run`."""
    return checks.run(CHECKS, build)
