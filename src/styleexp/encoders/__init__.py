"""Encoders: features of images by layer (Sec. 3.3.2). The contract is in `base`.

Importing this package is cheap: torch is imported with the first name that needs it.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from styleexp.encoders.base import Encoder as Encoder
    from styleexp.encoders.vgg import VGG as VGG

_HOMES = {"Encoder": "base", "VGG": "vgg"}

__all__ = ["VGG", "Encoder"]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(importlib.import_module(f"styleexp.encoders.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
