"""The modules of the Blender extension that need no Blender."""

import importlib
import sys
import types

from tests.helpers import ROOT

FOLDER = ROOT / "blender" / "extension"


def load(name):
    """A module of ``blender/extension`` without its ``__init__``, which imports bpy."""
    if "styleexp_extension" not in sys.modules:
        package = types.ModuleType("styleexp_extension")
        package.__path__ = [str(FOLDER)]
        sys.modules["styleexp_extension"] = package
    return importlib.import_module(f"styleexp_extension.{name}")
