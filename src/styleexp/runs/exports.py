"""Write a run's result as meshes, for viewers, editors and printers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from styleexp.inputs import meshes
from styleexp.inputs.meshes import simplifying
from styleexp.runs import prints
from styleexp.system.progress import doing

if TYPE_CHECKING:
    from styleexp.config.schema import Config
    from styleexp.method.base import Result

ALWAYS = ("ply", "obj", "glb")
LOSS = 0.05
"""Largest estimated distance of a simplified result from the result, as a fraction of the relief's
range. On two pairs about half of the faces were gone at 0.02, three quarters at 0.04."""
RANGE = (0.01, 0.99)
"""Quantiles of the displacement between which its range is measured."""


def write(result: Result, config: Config, folder: Path) -> list[str]:
    """Write the result as PLY, OBJ and GLB and in ``config.formats``, also simplified if
    ``config.simplify`` is given; print notes on it. Returns the files' names."""
    kinds = (*ALWAYS, *config.formats)
    names = [f"result.{kind}" for kind in kinds]
    for name in names:
        doing(f"writing {name}")
        result.save(folder / name)
    shown = {"the result": (result.vertices, result.faces)}
    if config.simplify is not None:
        more, vertices, faces = _simplified(result, config.simplify, kinds, folder)
        names += more
        shown["the simplified result"] = vertices, faces
    if config.formats:
        doing("looking at the result as a printer would")
        for what, mesh in shown.items():
            for note in prints.notes(what, *mesh):
                print(f"note: for printing: {note}")
        if "3mf" in config.formats:
            size = " x ".join(f"{each:.3g}" for each in np.ptp(result.vertices, axis=0))
            print(f"note: for printing: a unit of the 3MF is a millimetre, it is {size} mm")
    return names


def _simplified(
    result: Result, faces: int, kinds: tuple[str, ...], folder: Path
) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Write it; return the files' names, its vertices and its faces."""
    doing("simplifying the result")
    extent = float(np.ptp(np.quantile(result.displacement, RANGE)))
    small, kept, error = simplifying.simplified(
        result.subject.source, result.vertices, faces, LOSS * extent
    )
    print(f"note: {told(len(small.faces), faces, len(result.faces), error, extent)}")
    names = [f"result_simplified.{kind}" for kind in kinds]
    for name in names:
        doing(f"writing {name}")
        meshes.save_mesh(small, result.vertices[kept], folder / name, result.displacement[kept])
    return names, result.vertices[kept], small.faces


def told(found: int, wanted: int, before: int, error: float, extent: float) -> str:
    """A sentence about a simplified result of ``found`` faces."""
    if before <= wanted:
        return f"the result has {before:,} faces already: result_simplified is no smaller"
    loss = f"by up to about {error / extent:.1%} of the relief" if extent > 0 else "nowhere"
    text = f"simplified from {before:,} to {found:,} faces, which moves the surface {loss}"
    if found > 1.05 * wanted:
        text += f"; {wanted:,} would lose more than {LOSS:.0%}"
    return text
