"""Analytic shapes of an eighth of their vertices, wherever this folder is on ``PYTHONPATH``.

Python imports a module of this name when it starts, so all processes of a command have them: its
own (`warm.coarse`), joblib's and submitit's workers. For tests of what happens around a run, not of
how its result looks.
"""

import importlib.abc
import importlib.util
import sys

SOURCE, STYLE = 2_000, 5_000
"""Vertices, where the shapes have 16,000 and 40,000 by default."""


def coarsen(shapes):
    """Have ``inputs.shapes`` make coarse ones where nobody asks for a number of vertices."""
    make = shapes.make

    def make_coarse(name, detail=None):
        return make(name, detail or (SOURCE if name in shapes.SOURCES else STYLE))

    shapes.make = make_coarse


class _Finder(importlib.abc.MetaPathFinder):
    """Coarsens the module when it is first imported."""

    def find_spec(self, name, path, target=None):
        if name != "styleexp.inputs.shapes":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(name)
        load = spec.loader.exec_module

        def load_and_coarsen(module):
            load(module)
            coarsen(module)

        spec.loader.exec_module = load_and_coarsen
        return spec


if "styleexp.inputs.shapes" not in sys.modules:
    sys.meta_path.insert(0, _Finder())
