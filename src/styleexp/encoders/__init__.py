"""Multi-layer encoders: VGG activations of an image, by layer name (paper Sec. 3.3.2).

Importing this package is cheap: torch is imported by the first ``load_encoder`` call.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from styleexp.encoders.specs import ENCODERS, load_encoder

if TYPE_CHECKING:
    from styleexp.encoders.vgg import Encoder

__all__ = ["ENCODERS", "Encoder", "load_encoder"]


def __getattr__(name: str) -> Any:
    if name == "Encoder":
        from styleexp.encoders.vgg import Encoder

        return Encoder
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
