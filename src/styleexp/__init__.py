"""Put the local geometry of a mesh or picture onto another mesh.

The public names load what they need when they are first used, so importing the package is instant.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from styleexp.errors import UserError as UserError
    from styleexp.meshes import Mesh as Mesh
    from styleexp.meshes import load_mesh as load_mesh
    from styleexp.stylize import stylize as stylize

__version__ = "0.1.0"

_HOMES = {
    "load_mesh": "styleexp.meshes",
    "Mesh": "styleexp.meshes",
    "UserError": "styleexp.errors",
}

__all__ = ["Mesh", "UserError", "load_mesh", "stylize"]


def __getattr__(name: str) -> object:
    if name == "stylize":  # the function's module has its name and is callable in its stead
        return importlib.import_module("styleexp.stylize")
    if name not in _HOMES:
        raise AttributeError(f"module 'styleexp' has no attribute '{name}'")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
