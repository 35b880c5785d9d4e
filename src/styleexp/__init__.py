"""Put the local geometry of a mesh or picture onto another mesh.

The public names load what they need when they are first used, so importing the package is instant.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from styleexp.api import stylize as stylize
    from styleexp.inputs.meshes import Mesh as Mesh
    from styleexp.inputs.meshes import load_mesh as load_mesh
    from styleexp.system.errors import UserError as UserError

__version__ = "0.1.0"

_HOMES = {
    "load_mesh": "styleexp.inputs.meshes",
    "Mesh": "styleexp.inputs.meshes",
    "UserError": "styleexp.system.errors",
    "stylize": "styleexp.api",
}

__all__ = ["Mesh", "UserError", "load_mesh", "stylize"]


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'styleexp' has no attribute '{name}'")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
