"""The named encoders. Importable without torch, so that ``--help`` can list them at once."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from styleexp.errors import UserError, unknown_name

if TYPE_CHECKING:
    import torch

    from styleexp.encoders.vgg import Encoder

PRECISIONS = ("auto", "fp32", "bf16")
POOLINGS = ("max", "avg")
NORMALISATIONS = ("weights", "paper")


class EncoderFactory(Protocol):
    """Builds an encoder; all heavy imports happen inside the call."""

    def __call__(
        self,
        name: str,
        *,
        precision: str,
        pooling: str,
        normalisation: str,
        device: str | torch.device,
        seed: int,
    ) -> Encoder:
        """Build the encoder ``name`` with the options of :func:`load_encoder`."""
        ...


@dataclass(frozen=True)
class EncoderSpec:
    """One line of the registry."""

    name: str
    description: str
    factory: EncoderFactory
    warning: str | None = None
    """Shown with ``warnings.warn`` every time the encoder is loaded."""


def _pretrained(
    name: str,
    *,
    precision: str,
    pooling: str,
    normalisation: str,
    device: str | torch.device,
    seed: int,
) -> Encoder:
    from styleexp import assets
    from styleexp.encoders import vgg, weights

    loaded = weights.read(assets.find(name, "weights"))
    return vgg.build(
        name,
        loaded,
        precision=precision,
        pooling=pooling,
        normalisation=normalisation,
        device=device,
    )


def _random(
    name: str,
    *,
    precision: str,
    pooling: str,
    normalisation: str,
    device: str | torch.device,
    seed: int,
) -> Encoder:
    from styleexp.encoders import vgg

    return vgg.build(
        name,
        vgg.random_weights(vgg.VGG19_CONVS, seed),
        precision=precision,
        pooling=pooling,
        normalisation=normalisation,
        device=device,
    )


ENCODERS: dict[str, EncoderSpec] = {
    spec.name: spec
    for spec in (
        EncoderSpec(
            "vgg16",
            "VGG-16 trained on ImageNet, to conv5_3 (default; 61 MB from the Python index)",
            _pretrained,
        ),
        EncoderSpec(
            "vgg19",
            "VGG-19 trained on ImageNet, to conv5_4: the paper's encoder (548 MB download)",
            _pretrained,
        ),
        EncoderSpec(
            "vgg16_edges",
            "VGG-16 fine-tuned for edges, to conv5_3: for judging (55 MB from the Python index)",
            _pretrained,
        ),
        EncoderSpec(
            "vgg19_random",
            "VGG-19 with random weights, no download: smoke tests only",
            _random,
            warning="the encoder 'vgg19_random' has random weights: it is for smoke tests only, "
            "its results say nothing about style.",
        ),
    )
}
"""Name -> spec. A plain dictionary: plugins add their own lines."""


def load_encoder(
    name: str,
    *,
    precision: str = "auto",
    pooling: str = "max",
    normalisation: str = "weights",
    device: str | torch.device = "cpu",
    seed: int = 0,
) -> Encoder:
    """Load a frozen encoder; the first use of a pretrained one downloads its weights.

    Args:
        name: a name in :data:`ENCODERS`. Never replaced by another one when it cannot be had.
        precision: ``fp32``, ``bf16``, or ``auto``: bf16 where this processor gains from it. What
            was chosen is in ``encoder.precision``.
        pooling: ``max`` as trained, or ``avg`` (Gatys et al. 2016).
        normalisation: ``weights`` subtracts and divides by what the network was trained with,
            ``paper`` by the paper's mean (0.481, 0.458, 0.408) and std (0.268, 0.261, 0.276).
        device: where to put it.
        seed: for random encoders only; the global random state is left alone.

    Raises:
        UserError: unknown name or option; weights that can be neither found nor downloaded.
    """
    if name not in ENCODERS:
        raise unknown_name("encoder", name, ENCODERS)
    for option, value, known in (
        ("precision", precision, PRECISIONS),
        ("pooling", pooling, POOLINGS),
        ("normalisation", normalisation, NORMALISATIONS),
    ):
        if value not in known:
            raise UserError(f"encoder.{option} is '{value}'; it must be one of {', '.join(known)}.")
    spec = ENCODERS[name]
    if spec.warning:
        warnings.warn(spec.warning, stacklevel=2)
    return spec.factory(
        name,
        precision=precision,
        pooling=pooling,
        normalisation=normalisation,
        device=device,
        seed=seed,
    )
