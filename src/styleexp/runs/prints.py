"""What a printer needs to know of a result: whether it encloses a volume, and how thin it gets."""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float, Int

PLACES = 20_000
"""Places at which the thickness is measured, spread over the surface by area."""
THIN = 0.01
"""Share of the surface that may be thinner than the thickness that is told: ridges and tips end in
an edge, where the thickness is 0."""
INSIDE = 1e-5
"""Depth at which a ray inwards starts, in extents."""


def notes(
    what: str, vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> list[str]:
    """Sentences about a mesh, ``what``, that is to be printed; lengths in its own units."""
    found = [_closed(what, faces)]
    if find_spec("embreex") is None:
        return [
            *found,
            "its thickness is measured with the extra bake: pip install 'styleexp[bake]'",
        ]
    depth, places = thickness(vertices, faces)
    thin = np.quantile(depth, THIN)
    at = places[np.abs(depth - thin).argmin()]
    where = ", ".join(f"{each:.3g}" for each in at)
    return [
        *found,
        f"{100 * THIN:.0f} % of its surface is thinner than {thin:.3g} units, such as at "
        f"({where}); half of it is thinner than {np.median(depth):.3g}",
    ]


def thickness(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> tuple[Float[np.ndarray, " places"], Float[np.ndarray, "places 3"]]:
    """How far it is from places of the surface straight inwards to the surface again, and these
    places; only where there is such a surface. Needs the extra ``bake``."""
    from styleexp.runs.bake.detail import Detail

    detail = Detail(vertices, faces)
    corners = detail.vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    face = np.random.default_rng(0).choice(len(faces), PLACES, p=area / area.sum())
    places = corners[face].mean(axis=1)
    inwards = -normal[face] / area[face, None]
    start = places + INSIDE * inwards
    far = np.full(PLACES, 4, np.float32)
    depth = detail.scene.run(
        start.astype(np.float32), inwards.astype(np.float32), dists=far, query="DISTANCE"
    )
    hit = depth < 3.5
    reached = np.asarray(depth[hit], np.float64) + INSIDE
    return reached * detail.extent, places[hit] * detail.extent + detail.middle


def _closed(what: str, faces: Int[np.ndarray, "faces 3"]) -> str:
    """Whether every edge joins two faces, wound alike."""
    edges = np.concatenate([faces[:, [k, (k + 1) % 3]] for k in range(3)])
    key = np.sort(edges, axis=1)
    order = np.lexsort(key.T)
    starts = np.flatnonzero(np.r_[True, (np.diff(key[order], axis=0) != 0).any(axis=1)])
    count = np.diff(np.r_[starts, len(order)])
    forward = (edges[:, 0] < edges[:, 1]).astype(np.int64)[order]
    one_way = np.add.reduceat(forward, starts)
    open_, many = int((count == 1).sum()), int((count > 2).sum())
    against = int(((count == 2) & (one_way != 1)).sum())
    if not (open_ or many or against):
        return f"{what} is watertight"
    faults = [
        (open_, "open edges"),
        (many, "edges of more than two faces"),
        (against, "edges whose two faces are wound against each other"),
    ]
    told = ", ".join(f"{what}: {number:,}" for number, what in faults if number)
    return f"{what} is not watertight, a slicer may have to repair it ({told})"
