"""Free space around a surface, before it would meet itself."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float, Int

    from styleexp.method.synthesis.walk import Sheet


def ball_radius(
    sheet: Sheet, side: float, largest: float, some: Int[np.ndarray, " some"] | None = None
) -> Float[np.ndarray, " some"]:
    """Radius of the largest ball that touches each vertex, or ``some`` of them, and contains no
    other, up to ``largest``.

    ``side`` -1 is inside the surface (half the thickness), 1 outside (half the gap). Uses the
    shrinking ball algorithm (Ma, Bae and Choi 2012).
    """
    points, normals = sheet.vertices, side * sheet.normals
    radius = np.full(len(points), largest)
    todo = some = np.arange(len(points)) if some is None else some
    for _ in range(20):
        center = points[todo] + radius[todo, None] * normals[todo]
        away, hit = sheet.tree.query(center, workers=-1)
        smaller = (away < radius[todo] * (1 - 1e-3)) & (hit != todo)
        todo, hit = todo[smaller], hit[smaller]
        if not len(todo):
            break
        offset = points[hit] - points[todo]
        facing = (offset * normals[todo]).sum(1).clip(min=1e-12)
        radius[todo] = np.minimum((offset**2).sum(1) / (2 * facing), radius[todo])
    return radius[some]
