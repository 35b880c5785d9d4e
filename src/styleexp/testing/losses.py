"""Checks of `method.losses.Loss`.

``check_loss(MyLoss(options, encoder))`` runs all of them; each states in its docstring what must
hold. They take seconds with a small encoder, such as ``load_encoder("vgg19_random")``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch

from styleexp.method.losses import Loss
from styleexp.method.viewer import Images
from styleexp.testing import checks

if TYPE_CHECKING:
    from torch import Tensor

    from styleexp.method.losses import Statistics

SIZE = 96
"""Side of the checks' images in pixels."""


def images(seed: int, count: int = 2, channels: int = 3) -> Images:
    """Images of smooth noise on a disc; their corners are background."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(count, channels, SIZE // 4, SIZE // 4, generator=generator)
    fine = torch.nn.functional.interpolate(coarse, scale_factor=4, mode="bilinear")
    y, x = torch.meshgrid(*[torch.linspace(-1, 1, SIZE)] * 2, indexing="ij")
    disc = (x.square() + y.square() < 0.9).float().expand(count, SIZE, SIZE)
    return Images(fine.permute(0, 2, 3, 1) * disc[..., None], disc.clone())


def _distance(loss: Loss, found: Statistics, target: Statistics, source: Statistics) -> Tensor:
    return loss.distance(found, target, loss.scales(target, source))


def statistics_keep_their_shapes(loss: Loss) -> None:
    """However many images are described, grey or in colour, a loss gives the same number of finite
    tensors of the same shapes."""
    shapes = []
    for seen in (images(0), images(1, count=3), images(2, channels=1)):
        described = loss.describe(seen)
        assert all(bool(each.isfinite().all()) for each in described), "not finite"
        shapes.append([tuple(each.shape) for each in described])
    assert shapes[0], "no statistics"
    assert shapes[0] == shapes[1] == shapes[2], f"shapes differ: {shapes}"


def the_same_images_give_the_same_numbers(loss: Loss) -> None:
    """A loss keeps nothing between calls: describing the same images twice gives the same bits."""
    first = loss.describe(images(0))
    loss.describe(images(1))
    for one, other in zip(first, loss.describe(images(0)), strict=True):
        assert torch.equal(one, other)


def the_order_of_images_does_not_matter(loss: Loss) -> None:
    """Statistics are averages over images. Those of a loss that pools them otherwise may differ,
    but not their distance."""
    seen = images(0)
    turned = Images(seen.image.flip(0), seen.coverage.flip(0))
    ordered, reordered = loss.describe(seen), loss.describe(turned)
    if type(loss).pooled is Loss.pooled:
        for one, other in zip(ordered, reordered, strict=True):
            torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-6)
    target = loss.describe(images(1))
    one, other = (_distance(loss, each, target, target) for each in (ordered, reordered))
    torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-6)


def several_descriptions_make_one(loss: Loss) -> None:
    """Pooled descriptions have the shapes of one, and are finite. One alone stays as it is; two
    that are alike, or whose order changes, are hardly any distance from one."""
    one, other = loss.describe(images(0)), loss.describe(images(1))
    alone, both = loss.pooled([one]), loss.pooled([one, other])
    for each in (alone, both):
        assert [x.shape for x in each] == [x.shape for x in one], "shapes differ"
        assert all(bool(x.isfinite().all()) for x in each), "not finite"
    apart = float(_distance(loss, other, one, other))
    for name, pooled, target in (
        ("one", alone, one),
        ("two equal ones", loss.pooled([one, one]), one),
        ("two in another order", loss.pooled([other, one]), both),
    ):
        moved = float(_distance(loss, pooled, target, other))
        assert abs(moved) <= 0.5 * apart, f"{name} pooled: {moved}, where others are {apart} apart"


def a_step_has_a_loss_of_its_own(loss: Loss) -> None:
    """Equal generators give the same bits, and the loss itself doesn't change by it."""
    before = loss.describe(images(0))
    one, other = (loss.for_step(torch.Generator().manual_seed(3)) for _ in range(2))
    loss.for_step(torch.Generator().manual_seed(4))
    target = loss.describe(images(1))
    described = [each.describe(images(0)) for each in (one, other)]
    for first, second in zip(*described, strict=True):
        assert torch.equal(first, second), "equal generators, other statistics"
    values = [
        _distance(each, own, target, target)
        for each, own in zip((one, other), described, strict=True)
    ]
    assert torch.equal(*values), "equal generators, another distance"
    for first, second in zip(before, loss.describe(images(0)), strict=True):
        assert torch.equal(first, second), "for_step changes the loss itself"


def equal_statistics_are_no_distance_apart(loss: Loss) -> None:
    """The distance is a finite scalar: zero for equal statistics, more for others."""
    target, other = loss.describe(images(0)), loss.describe(images(1))
    none = _distance(loss, target, target, other)
    apart = _distance(loss, other, target, other)
    assert none.shape == apart.shape == ()
    assert bool(apart.isfinite())
    assert abs(float(none)) <= 1e-4 * float(apart), f"{float(none)} for equal statistics"
    assert float(apart) > 0, "other images are no distance apart"


def a_step_down_the_gradient_lowers_the_distance(loss: Loss) -> None:
    """The gradient reaches the images, is finite, and points uphill."""
    target, seen = loss.describe(images(0)), images(1)
    source = [each.detach() for each in loss.describe(seen)]
    leaf = seen.image.clone().requires_grad_()
    value = _distance(loss, loss.describe(Images(leaf, seen.coverage)), target, source)
    (gradient,) = torch.autograd.grad(value, leaf)
    assert bool(gradient.isfinite().all()), "the gradient is not finite"
    length = gradient.double().square().sum().sqrt()
    assert float(length) > 0, "the gradient is zero"
    for size in (1.0, 0.3, 0.1, 0.03):  # some step is short enough
        moved = seen.image - size * gradient / length
        if _distance(loss, loss.describe(Images(moved, seen.coverage)), target, source) < value:
            return
    raise AssertionError("no step down the gradient lowers the distance")


def images_that_show_nothing_do_no_harm(loss: Loss) -> None:
    """Images without the mesh, whose coverage is zero, have finite statistics and a finite distance
    and gradient, also as the target. If all statistics are zeros there, as a masked loss's are,
    nothing counts: a style that isn't seen is no distance from anything."""
    seen = images(0)
    leaf = torch.zeros_like(seen.image).requires_grad_()
    empty = loss.describe(Images(leaf, torch.zeros_like(seen.coverage)))
    own = loss.describe(seen)
    if not any(bool(each.any()) for each in empty):
        none = [each.detach() for each in empty]
        assert float(_distance(loss, own, none, own)) == 0, "a style that isn't seen counts"
    for found, target in ((empty, own), (own, [each.detach() for each in empty])):
        value = _distance(loss, found, target, own)
        assert bool(value.isfinite()), f"the distance is {float(value)}"
        if value.requires_grad:
            (gradient,) = torch.autograd.grad(value, leaf, allow_unused=True, retain_graph=True)
            assert gradient is None or bool(gradient.isfinite().all())


CHECKS: tuple[Callable[[Loss], None], ...] = (
    statistics_keep_their_shapes,
    the_same_images_give_the_same_numbers,
    the_order_of_images_does_not_matter,
    several_descriptions_make_one,
    a_step_has_a_loss_of_its_own,
    equal_statistics_are_no_distance_apart,
    a_step_down_the_gradient_lowers_the_distance,
    images_that_show_nothing_do_no_harm,
)


def check_loss(loss: Loss) -> dict[str, str]:
    """Run every check; see `checks.run`."""
    return checks.run(CHECKS, loss)
