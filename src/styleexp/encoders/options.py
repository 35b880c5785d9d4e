"""Options of the encoders. Imports nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass

from styleexp.system.options import option


@dataclass
class EncoderConfig:
    """The feature encoder F (Sec. 3.3.2)."""

    name: str = "vgg16"
    precision: str = option("auto", choices=("auto", "fp32", "bf16"))
    """``auto`` (bf16 where the hardware is faster with it), ``fp32`` or ``bf16``. The run's record
    holds the choice."""
    activations: str = option("relu", choices=("relu", "conv"))
    """Features taken after the ReLU (``relu``) or before it (``conv``)."""
    normalisation: str = option("weights", choices=("weights", "paper"))
    """Input normalisation. ``weights``: the constants the weights were trained with. ``paper``:
    those of Sec. 4.1."""


@dataclass
class ClipConfig(EncoderConfig):
    """CLIP, for ``loss=clip``. Always fp32; ``normalisation`` is ignored."""

    name: str = "clip"
    weights: str | None = None
    """A folder with a CLIP model in transformers' format; nothing is downloaded."""


def judge_name(name: str, trained: str | None) -> str | None:
    """Resolve ``auto`` to an encoder other than ``trained``, the run's own, and ``none`` to
    None."""
    if name == "auto":
        return "vgg16" if trained == "vgg16_edges" else "vgg16_edges"
    return None if name == "none" else name
