"""Analytic shapes, styles with a known relief and sources to apply it to. Nothing to download.

Most styles are the unit sphere, displaced radially by a closed-form function of the direction, so
``relief(name, points)`` gives the true height anywhere. They are named after the paper's styles
(Sec. 4.2.1) and follow its descriptions. The others cover further kinds of style meshes: many
components, a drum, a high genus, an open surface. Lengths are in sphere radii; +Y is up. Everything
is deterministic.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from styleexp.inputs.meshes import Mesh
from styleexp.inputs.solids import bands, critter, drum, lattice, stitches, terrain, torus, wool
from styleexp.inputs.spheres import fibonacci, gap, icosahedron, icosphere, icosphere_of, smoothstep
from styleexp.system.errors import unknown_name

if TYPE_CHECKING:
    from jaxtyping import Float

STYLES: dict[str, str] = {
    "wave_small": "small, dense, smooth bumps and dimples",
    "wave_large": "large, prominent, smooth bumps and dimples",
    "stripe": "horizontal rounded bands around the y axis, layer upon layer",
    "rail": "straight raised rails with sharp edges, crossing each other",
    "bubble": "packed hemispheres of one size that touch each other",
    "buckyball": "raised struts around sunk pentagons and hexagons",
    "scales": "overlapping rounded scales, like a fish's, pointing down",
    "cracks": "irregular plates separated by narrow grooves, like dried mud",
    "wool": "curly tufts, each a separate ball that overlaps its neighbours",
    "knit": "rows of knitted stitches, V below V, around a drum",
    "weave": "flat bands that pass over and under each other, around a drum",
    "lattice": "round struts along a football's seams, with holes between them",
    "terrain": "hills and valleys on a square tile, an open surface",
}
SOURCES: dict[str, str] = {
    "sphere": "a smooth unit sphere",
    "torus": "a smooth ring around the y axis",
    "critter": "a smooth four-legged animal that looks towards +z",
}


def names() -> list[str]:
    """All names that `make` knows, styles first."""
    return [*STYLES, *SOURCES]


def make(name: str, detail: int | None = None) -> Mesh:
    """Make the named shape: manifold, oriented outward, closed except ``terrain``, uniform
    triangles.

    ``detail`` is the approximate number of vertices: by default 40,000 for a style, so that the
    relief is crisp, and about 16,000 for a source. Raises `UserError` for an unknown name.
    """
    if name in _MADE:
        points, faces = (array.copy() for array in _MADE[name](detail or 40_000))
    elif name in RELIEFS:
        points, faces = icosphere(detail or 40_000)
        points = points * (1.0 + relief(name, points))[:, None]
    elif name == "sphere":
        points, faces = icosphere(detail or 16_000)
    elif name == "torus":
        points, faces = torus(detail or 16_000)
    elif name == "critter":
        points, faces = (array.copy() for array in critter(detail or 16_000))
    else:
        raise unknown_name("shape", name, names())
    return Mesh(name, points, faces)


def relief(name: str, points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, " points"]:
    """Height of a style above the unit sphere in the directions of ``points``, in radii.

    Raises `UserError` for a name that is not a style on the sphere.
    """
    if name not in RELIEFS:
        raise unknown_name("style on a sphere", name, RELIEFS)
    points = np.asarray(points, dtype=np.float64)
    directions = points / np.linalg.norm(points, axis=1, keepdims=True)
    # In chunks, since most reliefs compare every point with every centre.
    pieces = [RELIEFS[name](directions[at : at + 4096]) for at in range(0, len(points), 4096)]
    return np.concatenate(pieces) if pieces else np.zeros(0)


# ---------------------------------------------------------------------------------------- reliefs


def _wave(directions: np.ndarray, frequency: int, height: float) -> np.ndarray:
    # Gaussians on a hexagonal lattice, wide enough to overlap: nearly a sum of cosines, and without
    # a preferred direction, which the spirals of a Fibonacci lattice would have.
    centers = icosphere_of(frequency)[0][:, [1, 0, 2]]  # rotated, to avoid the rails' nodes
    sharpness = 1.0 / (0.30 * gap(len(centers))) ** 2
    total = np.exp(sharpness * (directions @ centers.T - 1.0)).sum(axis=1)
    mean = len(centers) / (2.0 * sharpness)  # of the sum over the sphere
    return height * (total - mean)


def _stripe(directions: np.ndarray) -> np.ndarray:
    latitude = np.arcsin(np.clip(directions[:, 1], -1.0, 1.0))
    period = np.pi / 14  # a whole number of bands, so that both poles are crests
    across = 2.0 * latitude / period
    across = across - 2.0 * np.round(across / 2.0)  # -1 .. 1 over a band
    return 0.06 * (1.0 - np.abs(across) ** 2) - 0.04


@cache
def _dome(frequency: int) -> np.ndarray:
    """Inward unit normals (faces, 3, 3) of the planes through the edges of a geodesic dome."""
    points, faces = icosphere_of(frequency)
    a, b, c = (points[faces[:, k]] for k in range(3))
    normals = np.stack([np.cross(a, b), np.cross(b, c), np.cross(c, a)], axis=1)
    return normals / np.linalg.norm(normals, axis=2, keepdims=True)


def _rail(directions: np.ndarray) -> np.ndarray:
    # In its own triangle a direction is on the inner side of all three planes.
    planes = _dome(3)
    away = np.min([directions @ planes[:, k].T for k in range(3)], axis=0).max(axis=1)
    # A bar with a flat top and slanted, sharp-edged flanks.
    return 0.06 * np.clip((0.055 - away) / 0.035, 0.0, 1.0) - 0.025


def _bubble(directions: np.ndarray) -> np.ndarray:
    centers, depth, radius = fibonacci(130), 0.92, 0.18
    cosine = (directions @ centers.T).max(axis=1)
    # Where the ray from the origin exits the ball of that radius around depth * center.
    inside = radius**2 - depth**2 * (1.0 - cosine**2)
    outer = depth * cosine + np.sqrt(np.maximum(inside, 0.0))
    return np.maximum(np.where(inside > 0, outer, 0.0), 0.985) - 1.0


@cache
def _truncated_icosahedron() -> np.ndarray:
    """Face normals divided by face distances (32, 3) of the truncated icosahedron."""
    points, faces = icosahedron()
    hexagons = points[faces].mean(axis=1)  # these lie in the icosahedron's faces
    a, b = points[faces[0, 0]], points[faces[0, 1]]
    corner = (2.0 * a + b) / 3.0
    pentagons = points * (corner @ a)
    planes = np.concatenate([pentagons, hexagons])
    return planes / np.einsum("ij,ij->i", planes, planes)[:, None]


def _buckyball(directions: np.ndarray) -> np.ndarray:
    away, _ = _from_border(directions, _truncated_icosahedron())
    strut = np.maximum(1.0 - (away / 0.085) ** 2, 0.0)
    floor = smoothstep((away - 0.06) / 0.2)
    return 0.06 * strut - 0.025 - 0.025 * floor


def _from_border(directions: np.ndarray, planes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance of each direction (n, 3) from its cell's border, and the cell's index.

    Cell i is the region where p_i . d is larger than every other p_j . d.
    """
    value = directions @ planes.T
    cell = value.argmax(axis=1)
    rows = np.arange(len(directions))
    apart = np.linalg.norm(planes[:, None] - planes[None], axis=2) + 1e9 * np.eye(len(planes))
    gap = (value[rows, cell][:, None] - value) / apart[cell]
    gap[rows, cell] = np.inf
    return gap.min(axis=1), cell


def _scales(directions: np.ndarray) -> np.ndarray:
    centers = fibonacci(260)
    radius = 0.85 * gap(len(centers))
    up = np.array([0.0, 1.0, 0.0]) - centers * centers[:, 1:2]
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    cosine = directions @ centers.T
    near = np.argpartition(-cosine, 8, axis=1)[:, :8]  # at most 8 discs overlap
    # Each scale is a disc, tilted so that its lower edge lies on top of the next ones.
    away = np.sqrt(np.maximum(2.0 - 2.0 * np.take_along_axis(cosine, near, axis=1), 0.0)) / radius
    down = -np.einsum("nk,njk->nj", directions, up[near]) / radius
    side = np.maximum(away**2 - down**2, 0.0)
    edge = smoothstep((1.0 - away) / 0.12)
    return 0.09 * (edge * (0.5 + 0.5 * down - 0.25 * side)).max(axis=1) - 0.045


@cache
def _plates() -> np.ndarray:
    count = 150
    jitter = np.random.default_rng(7).normal(size=(count, 3))
    centers = fibonacci(count) + 0.18 * gap(count) * jitter
    return centers / np.linalg.norm(centers, axis=1, keepdims=True)


def _cracks(directions: np.ndarray) -> np.ndarray:
    # Perturb the directions, so that the cracks aren't straight.
    bent = directions.copy()
    for k, (wave, phase) in enumerate(((9.0, 0.3), (17.0, 1.1), (29.0, 2.3))):
        bent += 0.12 / wave * np.sin(wave * np.roll(directions, k + 1, axis=1) + phase)
    bent /= np.linalg.norm(bent, axis=1, keepdims=True)
    away, cell = _from_border(bent, _plates())
    plate = smoothstep((away - 0.006) / 0.034)
    level = 0.006 * np.sin(12.9898 * np.arange(len(_plates())))[cell]
    return 0.055 * plate * (1.0 + level / 0.055) - 0.04


RELIEFS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "wave_small": lambda directions: _wave(directions, 7, 0.07),
    "wave_large": lambda directions: _wave(directions, 3, 0.16),
    "stripe": _stripe,
    "rail": _rail,
    "bubble": _bubble,
    "buckyball": _buckyball,
    "scales": _scales,
    "cracks": _cracks,
}
"""Height functions of the styles on the sphere, from directions to heights."""


# ----------------------------------------------------------------------------------------- meshes


# ------------------------------------------------------------------------ styles beyond the sphere


_MADE: dict[str, Callable[[int], tuple[np.ndarray, np.ndarray]]] = {
    "wool": wool,
    "knit": lambda detail: drum(detail, stitches, 24),
    "weave": lambda detail: drum(detail, bands, 32),
    "lattice": cache(lattice),
    "terrain": terrain,
}
