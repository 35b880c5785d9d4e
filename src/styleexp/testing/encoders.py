"""Checks of `encoders.base.Encoder`: ``check_encoder(encoder, layers)``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from styleexp.encoders.base import Encoder
from styleexp.system.errors import UserError
from styleexp.testing import checks
from styleexp.testing.losses import images


@dataclass(frozen=True)
class Asked:
    """An encoder and the layers that are asked of it."""

    encoder: Encoder
    layers: Sequence[str | int]

    def features(self, image: torch.Tensor) -> dict[str, torch.Tensor]:
        """Features of images of shape (images, height, width, channels)."""
        return self.encoder(image.permute(0, 3, 1, 2), self.layers)


def features_of_every_layer_that_is_asked_for(asked: Asked) -> None:
    """It is an `Encoder`; features have the shape (images, features, rows, columns), in the order
    asked for, and are finite; grey images are the same as RGB of equal channels."""
    assert isinstance(asked.encoder, Encoder), f"{type(asked.encoder).__name__} is not an Encoder"
    names = asked.encoder.resolve(asked.layers)
    colour = asked.features(images(0).image)
    assert tuple(colour) == tuple(names), f"{tuple(colour)}, asked for {tuple(names)}"
    for name, found in colour.items():
        assert found.ndim == 4, f"{name} has the shape {tuple(found.shape)}"
        assert found.shape[0] == 2, f"{name} has the shape {tuple(found.shape)}"
        assert bool(found.isfinite().all()), f"{name} is not finite"
    grey = images(0, channels=1).image
    alike = asked.features(grey.expand(-1, -1, -1, 3))
    for name, found in asked.features(grey).items():
        torch.testing.assert_close(found, alike[name], rtol=2e-2, atol=2e-2)


def unknown_layers_are_refused(asked: Asked) -> None:
    """A layer that it doesn't have is a `UserError`, and so is the same one twice."""
    for wrong in (["no_such_layer"], [*asked.layers, asked.layers[0]]):
        try:
            asked.encoder.resolve(wrong)
        except UserError:
            continue
        raise AssertionError(f"resolve({wrong}) is accepted")


def it_is_frozen_and_gradients_reach_the_images(asked: Asked) -> None:
    """No parameter requires a gradient; that of the features' sum reaches the images, finite."""
    assert not any(each.requires_grad for each in asked.encoder.parameters()), "it would be trained"
    leaf = images(0).image.clone().requires_grad_()
    total = sum(each.float().square().mean() for each in asked.features(leaf).values())
    assert isinstance(total, torch.Tensor)
    (gradient,) = torch.autograd.grad(total, leaf)
    assert bool(gradient.isfinite().all())
    assert float(gradient.abs().max()) > 0


def images_do_not_mix(asked: Asked) -> None:
    """The features of an image don't depend on the others of the batch, or on earlier calls."""
    both = asked.features(images(0).image)
    asked.features(images(1).image)
    alone = asked.features(images(0).image[:1])
    for name, found in alone.items():
        torch.testing.assert_close(found[0], both[name][0], rtol=2e-2, atol=2e-2)


def its_precision_is_what_it_says(asked: Asked) -> None:
    """``precision`` is ``fp32`` or ``bf16``, and that of its features."""
    dtypes = {"fp32": torch.float32, "bf16": torch.bfloat16}
    assert asked.encoder.precision in dtypes, f"precision '{asked.encoder.precision}'"
    for name, found in asked.features(images(0).image).items():
        assert found.dtype == dtypes[asked.encoder.precision], f"{name} is {found.dtype}"


CHECKS: tuple[Callable[[Asked], None], ...] = (
    features_of_every_layer_that_is_asked_for,
    unknown_layers_are_refused,
    it_is_frozen_and_gradients_reach_the_images,
    images_do_not_mix,
    its_precision_is_what_it_says,
)


def check_encoder(encoder: Encoder, layers: Sequence[str | int]) -> dict[str, str]:
    """Run every check with these layers; see `checks.run`."""
    return checks.run(CHECKS, Asked(encoder, layers))
