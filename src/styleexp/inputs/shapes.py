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
        points, faces = _torus(detail or 16_000)
    elif name == "critter":
        points, faces = (array.copy() for array in _critter(detail or 16_000))
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


def _smoothstep(x: np.ndarray) -> np.ndarray:
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


@cache
def _fibonacci(count: int) -> np.ndarray:
    """Evenly spread unit vectors (count, 3)."""
    k = np.arange(count) + 0.5
    y = 1.0 - 2.0 * k / count
    turn = np.pi * (1.0 + np.sqrt(5.0)) * k
    ring = np.sqrt(1.0 - y * y)
    return np.stack([ring * np.cos(turn), y, ring * np.sin(turn)], axis=1)


@cache
def _gap(count: int) -> float:
    """Distance between neighbours of ``count`` evenly spread points, as if hexagonally packed."""
    return float(np.sqrt(8.0 * np.pi / (np.sqrt(3.0) * count)))


def _wave(directions: np.ndarray, frequency: int, height: float) -> np.ndarray:
    # Gaussians on a hexagonal lattice, wide enough to overlap: nearly a sum of cosines, and without
    # a preferred direction, which the spirals of a Fibonacci lattice would have.
    centers = _icosphere(frequency)[0][:, [1, 0, 2]]  # rotated, to avoid the rails' nodes
    sharpness = 1.0 / (0.30 * _gap(len(centers))) ** 2
    total = np.exp(sharpness * (directions @ centers.T - 1.0)).sum(axis=1)
    mean = len(centers) / (2.0 * sharpness)  # of the sum over the sphere
    return height * (total - mean)


def _stripe(directions: np.ndarray) -> np.ndarray:
    latitude = np.arcsin(np.clip(directions[:, 1], -1.0, 1.0))
    period = np.pi / 14  # a whole number of bands, so that both poles are crests
    across = 2.0 * latitude / period
    across = across - 2.0 * np.round(across / 2.0)  # -1 .. 1 over a band
    return 0.06 * (1.0 - np.abs(across) ** 2) - 0.04


def _icosahedron() -> tuple[np.ndarray, np.ndarray]:
    golden = (1.0 + np.sqrt(5.0)) / 2.0
    points = np.array(
        [
            *([0.0, s, t * golden] for s in (-1, 1) for t in (-1, 1)),
            *([s, t * golden, 0.0] for s in (-1, 1) for t in (-1, 1)),
            *([t * golden, 0.0, s] for s in (-1, 1) for t in (-1, 1)),
        ]
    ) / np.sqrt(1.0 + golden**2)
    near = (points @ points.T > 0.4) & (points @ points.T < 0.5)
    faces = [
        (a, b, c) if np.linalg.det(points[[a, b, c]]) > 0 else (a, c, b)
        for a in range(12)
        for b in range(a + 1, 12)
        for c in range(b + 1, 12)
        if near[a, b] and near[b, c] and near[c, a]
    ]
    return points, np.array(faces)


@cache
def _dome(frequency: int) -> np.ndarray:
    """Inward unit normals (faces, 3, 3) of the planes through the edges of a geodesic dome."""
    points, faces = _icosphere(frequency)
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
    centers, depth, radius = _fibonacci(130), 0.92, 0.18
    cosine = (directions @ centers.T).max(axis=1)
    # Where the ray from the origin exits the ball of that radius around depth * center.
    inside = radius**2 - depth**2 * (1.0 - cosine**2)
    outer = depth * cosine + np.sqrt(np.maximum(inside, 0.0))
    return np.maximum(np.where(inside > 0, outer, 0.0), 0.985) - 1.0


@cache
def _truncated_icosahedron() -> np.ndarray:
    """Face normals divided by face distances (32, 3) of the truncated icosahedron."""
    points, faces = _icosahedron()
    hexagons = points[faces].mean(axis=1)  # these lie in the icosahedron's faces
    a, b = points[faces[0, 0]], points[faces[0, 1]]
    corner = (2.0 * a + b) / 3.0
    pentagons = points * (corner @ a)
    planes = np.concatenate([pentagons, hexagons])
    return planes / np.einsum("ij,ij->i", planes, planes)[:, None]


def _buckyball(directions: np.ndarray) -> np.ndarray:
    away, _ = _from_border(directions, _truncated_icosahedron())
    strut = np.maximum(1.0 - (away / 0.085) ** 2, 0.0)
    floor = _smoothstep((away - 0.06) / 0.2)
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
    centers = _fibonacci(260)
    radius = 0.85 * _gap(len(centers))
    up = np.array([0.0, 1.0, 0.0]) - centers * centers[:, 1:2]
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    cosine = directions @ centers.T
    near = np.argpartition(-cosine, 8, axis=1)[:, :8]  # at most 8 discs overlap
    # Each scale is a disc, tilted so that its lower edge lies on top of the next ones.
    away = np.sqrt(np.maximum(2.0 - 2.0 * np.take_along_axis(cosine, near, axis=1), 0.0)) / radius
    down = -np.einsum("nk,njk->nj", directions, up[near]) / radius
    side = np.maximum(away**2 - down**2, 0.0)
    edge = _smoothstep((1.0 - away) / 0.12)
    return 0.09 * (edge * (0.5 + 0.5 * down - 0.25 * side)).max(axis=1) - 0.045


@cache
def _plates() -> np.ndarray:
    count = 150
    jitter = np.random.default_rng(7).normal(size=(count, 3))
    centers = _fibonacci(count) + 0.18 * _gap(count) * jitter
    return centers / np.linalg.norm(centers, axis=1, keepdims=True)


def _cracks(directions: np.ndarray) -> np.ndarray:
    # Perturb the directions, so that the cracks aren't straight.
    bent = directions.copy()
    for k, (wave, phase) in enumerate(((9.0, 0.3), (17.0, 1.1), (29.0, 2.3))):
        bent += 0.12 / wave * np.sin(wave * np.roll(directions, k + 1, axis=1) + phase)
    bent /= np.linalg.norm(bent, axis=1, keepdims=True)
    away, cell = _from_border(bent, _plates())
    plate = _smoothstep((away - 0.006) / 0.034)
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


@cache
def _icosphere(frequency: int) -> tuple[np.ndarray, np.ndarray]:
    corners, faces = _icosahedron()
    i, j = np.meshgrid(np.arange(frequency + 1), np.arange(frequency + 1), indexing="ij")
    inside = i + j <= frequency
    number = np.full(inside.shape, -1)
    number[inside] = np.arange(inside.sum())
    weights = np.stack([frequency - i - j, i, j], axis=-1)[inside] / frequency
    a, b = (k[i + j < frequency] for k in (i, j))
    up = np.stack([number[a, b], number[a + 1, b], number[a, b + 1]], axis=1)
    a, b = (k[i + j < frequency - 1] for k in (i, j))
    down = np.stack([number[a + 1, b], number[a + 1, b + 1], number[a, b + 1]], axis=1)
    pattern = np.concatenate([up, down])

    points = np.concatenate([weights @ corners[face] for face in faces])
    triangles = np.concatenate([pattern + k * len(weights) for k in range(len(faces))])
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    # The twenty pieces share their borders.
    _, first, inverse = np.unique(
        np.round(points * 1e7).astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    return points[first], inverse.ravel()[triangles]


def icosphere(detail: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit sphere of about ``detail`` vertices: an evenly subdivided icosahedron.

    Returns vertices (v, 3) and outward faces (f, 3).
    """
    frequency = max(1, round(np.sqrt(max(detail - 2, 10) / 10.0)))
    points, faces = _icosphere(frequency)
    return points.copy(), faces.copy()


def _torus(detail: int) -> tuple[np.ndarray, np.ndarray]:
    major, minor = 0.7, 0.3
    # Steps around the tube that make triangles equilateral on its centre line.
    around = max(8, round(np.sqrt(detail * minor / major * np.sqrt(3.0) / 2.0)))
    along = max(8, 2 * round(detail / around / 2))
    k, m = (
        axis.ravel() for axis in np.meshgrid(np.arange(along), np.arange(around), indexing="ij")
    )
    u = 2.0 * np.pi * k / along
    v = 2.0 * np.pi * (m + 0.5 * (k % 2)) / around
    ring = major + minor * np.cos(v)
    points = np.stack([ring * np.sin(u), minor * np.sin(v), ring * np.cos(u)], axis=1)

    def at(step: np.ndarray, turn: np.ndarray) -> np.ndarray:
        return (step % along) * around + turn % around

    # Offset every second ring by half a step, so that triangles between rings interlock.
    odd = k % 2
    before, after = at(k + 1, m + odd - 1), at(k + 1, m + odd)
    here, next_ = at(k, m), at(k, m + 1)
    fans = [(here, before, after), (here, after, next_)]
    return points, np.concatenate([np.stack(fan, axis=1) for fan in fans])


def _ball(points: np.ndarray, center: tuple[float, ...], radii: tuple[float, ...]) -> np.ndarray:
    """Approximate signed distance to an ellipsoid, negative inside."""
    at, size = points - np.array(center), np.array(radii)
    one = np.linalg.norm(at / size, axis=1)
    slope = np.linalg.norm(at / size**2, axis=1)
    return one * (one - 1.0) / np.maximum(slope, 1e-9)


def _limb(
    points: np.ndarray, a: tuple[float, ...], b: tuple[float, ...], ra: float, rb: float
) -> np.ndarray:
    """Signed distance to a capsule whose radius varies from ``ra`` to ``rb``."""
    start, axis = np.array(a), np.array(b) - np.array(a)
    along = np.clip((points - start) @ axis / (axis @ axis), 0.0, 1.0)
    return np.linalg.norm(points - start - along[:, None] * axis, axis=1) - (ra + (rb - ra) * along)


def _blend(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    """Smooth union: the minimum distance, rounded where both are within ``width``."""
    mix = np.maximum(width - np.abs(a - b), 0.0) / width
    return np.minimum(a, b) - mix**3 * width / 6.0


def _critter_distance(points: np.ndarray) -> np.ndarray:
    """Approximate signed distance to a four-legged animal, negative inside."""
    mirrored = np.abs(points * np.array([1.0, 0.0, 0.0])) + points * np.array([0.0, 1.0, 1.0])
    body = _ball(points, (0.0, 0.0, -0.02), (0.36, 0.35, 0.50))
    body = _blend(body, _ball(points, (0.0, 0.04, 0.26), (0.33, 0.34, 0.28)), 0.15)
    body = _blend(body, _limb(points, (0.0, 0.14, 0.28), (0.0, 0.42, 0.44), 0.25, 0.22), 0.18)
    fore = _limb(mirrored, (0.20, -0.08, 0.30), (0.21, -0.54, 0.32), 0.15, 0.125)
    hind = _limb(mirrored, (0.20, -0.06, -0.28), (0.21, -0.54, -0.30), 0.18, 0.125)
    feet = np.minimum(
        _ball(mirrored, (0.21, -0.58, 0.36), (0.14, 0.11, 0.17)),
        _ball(mirrored, (0.21, -0.58, -0.26), (0.14, 0.11, 0.17)),
    )
    body = _blend(body, _blend(np.minimum(fore, hind), feet, 0.10), 0.14)
    tail = _limb(points, (0.0, 0.10, -0.44), (0.0, 0.22, -0.64), 0.12, 0.10)
    tail = _blend(tail, _limb(points, (0.0, 0.22, -0.64), (0.0, 0.46, -0.70), 0.10, 0.11), 0.08)
    body = _blend(body, tail, 0.14)
    head = _ball(points, (0.0, 0.60, 0.52), (0.35, 0.31, 0.31))
    head = _blend(head, _ball(points, (0.0, 0.50, 0.77), (0.18, 0.135, 0.16)), 0.14)
    head = _blend(head, _ball(mirrored, (0.19, 0.49, 0.62), (0.14, 0.13, 0.14)), 0.12)
    ears = _limb(mirrored, (0.21, 0.80, 0.48), (0.30, 1.02, 0.45), 0.14, 0.09)
    head = _blend(head, ears, 0.10)
    head = _blend(head, _ball(mirrored, (0.14, 0.68, 0.745), (0.085, 0.095, 0.075)), 0.04)
    head = _blend(head, _ball(points, (0.0, 0.555, 0.90), (0.075, 0.058, 0.06)), 0.04)
    return _blend(body, head, 0.12)


def _surface_net(
    distance: Callable[[np.ndarray], np.ndarray],
    low: tuple[float, ...],
    high: tuple[float, ...],
    step: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Zero surface of a signed distance as a closed mesh, with one vertex per crossed cell.

    Uses the dual method, because gpytoolbox's marching cubes leaves seams open.
    """
    axes = [np.arange(low[k], high[k], step) for k in range(3)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    value = distance(grid.reshape(-1, 3)).reshape(grid.shape[:3])
    inside = value < 0
    cells = tuple(n - 1 for n in inside.shape)
    total, count = np.zeros((*cells, 3)), np.zeros(cells)
    quads = []
    for axis in range(3):
        a = [slice(None)] * 3
        b = [slice(None)] * 3
        a[axis], b[axis] = slice(None, -1), slice(1, None)
        va, vb = value[tuple(a)], value[tuple(b)]
        crossed = inside[tuple(a)] != inside[tuple(b)]
        where = np.argwhere(crossed)
        share = (va[crossed] / (va[crossed] - vb[crossed]))[:, None]
        point = grid[tuple(where.T)] + share * step * np.eye(3)[axis]
        u, v = np.eye(3, dtype=int)[(axis + 1) % 3], np.eye(3, dtype=int)[(axis + 2) % 3]
        around = [where - u - v, where - v, where, where - u]  # the four cells at this edge
        for cell in around:
            np.add.at(total, tuple(cell.T), point)
            np.add.at(count, tuple(cell.T), 1.0)
        quad = np.stack([np.ravel_multi_index(tuple(cell.T), cells) for cell in around], axis=1)
        leaving = inside[tuple(a)][crossed]
        quads.append(np.where(leaving[:, None], quad, quad[:, ::-1]))
    used = count > 0
    number = np.cumsum(used.ravel()) - 1
    quad = number[np.concatenate(quads)]
    return total[used] / count[used][:, None], np.concatenate([quad[:, :3], quad[:, [0, 2, 3]]])


@cache
def _critter(detail: int) -> tuple[np.ndarray, np.ndarray]:
    return _implicit(_critter_distance, (-0.55, -0.85, -1.0), (0.55, 1.2, 1.1), 0.035, detail)


def _implicit(
    distance: Callable[[np.ndarray], np.ndarray],
    low: tuple[float, ...],
    high: tuple[float, ...],
    step: float,
    detail: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Zero surface of a signed distance: extracted coarsely, remeshed, then projected."""
    import gpytoolbox

    points, faces = _surface_net(distance, low, high, step)
    corners = points[faces]
    area = 0.5 * np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    length = float(np.sqrt(2.0 * area.sum() / (np.sqrt(3.0) * detail)))
    points, faces = gpytoolbox.remesh_botsch(points, faces.astype(np.int32), 5, length, True)
    for _ in range(4):
        value = distance(points)
        slope = np.stack([distance(points + e) - value for e in 1e-4 * np.eye(3)], axis=1) / 1e-4
        points = points - slope * (value / np.maximum((slope**2).sum(axis=1), 1e-6))[:, None]
    return points, faces.astype(np.int64)


# ------------------------------------------------------------------------ styles beyond the sphere


def _wool(detail: int) -> tuple[np.ndarray, np.ndarray]:
    """Balls around a ball, each with a spiral ridge that starts at its outermost point."""
    rng = np.random.default_rng(3)
    count = 80
    centers = _fibonacci(count) + 0.2 * _gap(count) * rng.normal(size=(count, 3))
    centers *= (rng.uniform(0.74, 0.84, count) / np.linalg.norm(centers, axis=1))[:, None]
    ball, faces = icosphere(int(detail / (count + 1)))
    points = [0.75 * ball]
    for center, size in zip(centers, rng.uniform(0.20, 0.26, count), strict=True):
        out = center / np.linalg.norm(center)
        right = np.cross(out, rng.normal(size=3))
        right /= np.linalg.norm(right)
        from_pole = np.arccos(np.clip(ball @ out, -1.0, 1.0))
        turn = np.arctan2(ball @ np.cross(out, right), ball @ right)
        ridge = np.cos(10.0 * from_pole - turn) * _smoothstep(2.5 * np.sin(from_pole))
        points.append(center + size * (1.0 + 0.1 * ridge)[:, None] * ball)
    shifted = [faces + k * len(ball) for k in range(count + 1)]
    return np.concatenate(points), np.concatenate(shifted)


def _drum(
    detail: int, height: Callable[[np.ndarray, np.ndarray], np.ndarray], around: int
) -> tuple[np.ndarray, np.ndarray]:
    """A round drum with ``height(across, up)`` on its ends and on its wall, whose circumference is
    ``around`` units; the rim between them is smooth."""
    power, radius = 8.0, 0.8
    points, faces = icosphere(detail)
    side = np.hypot(points[:, 0], points[:, 2])
    size = (side**power + np.abs(points[:, 1]) ** power) ** (1.0 / power)
    points = radius * points / size[:, None]
    side = np.hypot(points[:, 0], points[:, 2])
    unit = 2.0 * np.pi * radius / around
    wall = height(np.arctan2(points[:, 0], points[:, 2]) * radius / unit, points[:, 1] / unit)
    end = height(points[:, 0] / unit, points[:, 2] / unit)
    middle = np.median(wall)
    inner = _smoothstep((0.9 * radius - np.abs(points[:, 1])) / (0.05 * radius))
    top = _smoothstep((0.9 * radius - side) / (0.05 * radius))
    total = unit * (inner * (wall - middle) + top * (end - middle))
    slope = np.stack([points[:, 0] * side ** (power - 2), points[:, 1] ** (power - 1),
                      points[:, 2] * side ** (power - 2)], axis=1)  # fmt: skip
    return points + total[:, None] * slope / np.linalg.norm(slope, axis=1, keepdims=True), faces


def _stitches(across: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Knitted stitches, 1 wide and 0.75 high, of two strands that lean outward."""
    across = np.abs(across - np.round(across))
    course = 0.75
    total = np.zeros(len(across))
    for row in (-1, 0, 1, 2):
        # The strand runs from the stitch's foot up and out, and dives under the next one.
        x, y = across - 0.25, up - course * (np.floor(up / course) + row)
        lean = np.array([0.28, 0.96])
        along = (x * lean[0] + y * lean[1]) / 0.72
        away = (x * lean[1] - y * lean[0]) / 0.245
        total = np.maximum(total, 0.42 * np.sqrt(np.maximum(1.0 - away**2 - along**2, 0.0)))
    return total


def _bands(across: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Bands 0.86 wide, 1 apart, over and under each other."""
    total = np.zeros(len(across))
    for aside, along in ((across, up), (up, across)):
        band = np.floor(aside)
        away = np.abs(aside - band - 0.5) / 0.43
        phase = 1.0 if aside is across else 0.0
        level = 0.5 + 0.5 * np.sin(np.pi * (along + band + phase))
        edge = np.sqrt(np.maximum(1.0 - away**4, 0.0))
        total = np.maximum(total, np.where(away < 1.0, 0.17 * level + 0.11 * edge, 0.0))
    return total


def _lattice(detail: int) -> tuple[np.ndarray, np.ndarray]:
    from scipy.spatial import cKDTree

    points, faces = _icosahedron()
    pairs = {tuple(sorted(pair)) for face in faces for pair in zip(face, np.roll(face, 1))}  # noqa: B905
    a, b = points[np.array(sorted(pairs))].transpose(1, 0, 2)
    corners = np.concatenate([(2.0 * a + b) / 3.0, (a + 2.0 * b) / 3.0])
    corners /= np.linalg.norm(corners, axis=1, keepdims=True)
    apart = np.linalg.norm(corners[:, None] - corners[None], axis=2)
    ends = np.argwhere(np.triu(apart < 1.05 * apart[apart > 1e-6].min(), 1))
    radius = 0.075

    def distance(points: np.ndarray) -> np.ndarray:
        total = np.full(len(points), 1.0)
        around = cKDTree(points).query_ball_point(corners[ends].mean(axis=1), 0.4)
        for near, (i, j) in zip(around, ends, strict=True):
            strut = _limb(points[near], tuple(corners[i]), tuple(corners[j]), radius, radius)
            total[near] = _blend(total[near], strut, 0.05)
        return total

    return _implicit(distance, (-1.203, -1.201, -1.207), (1.2, 1.2, 1.2), 0.03, detail)


def _terrain(detail: int) -> tuple[np.ndarray, np.ndarray]:
    """A 2 by 2 tile with octaves of billowy noise; the longest wavelength is the highest."""
    side = round(np.sqrt(detail))
    rng = np.random.default_rng(5)
    across = np.linspace(-1.0, 1.0, side)
    x, z = (axis.ravel() for axis in np.meshgrid(across, across, indexing="ij"))
    height = np.zeros(side * side)
    for frequency in 3.5 * 1.5 ** np.arange(7):
        octave = np.zeros(side * side)
        for turn in rng.uniform(0.0, 2.0 * np.pi, 12):
            phase = np.pi * frequency * (np.cos(turn) * x + np.sin(turn) * z)
            octave += np.cos(phase + rng.uniform(0.0, 2.0 * np.pi)) / np.sqrt(6.0)
        height += frequency**-2.0 * np.sqrt(octave**2 + 0.05)  # valleys are sharper than hills
    number = np.arange(side * side).reshape(side, side)
    a, b, c, d = (
        number[rows, columns].ravel()
        for rows, columns in (
            (slice(None, -1), slice(None, -1)), (slice(None, -1), slice(1, None)),
            (slice(1, None), slice(1, None)), (slice(1, None), slice(None, -1)),
        )
    )  # fmt: skip
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return np.stack([x, 0.055 * height / height.std(), z], axis=1), faces


_MADE: dict[str, Callable[[int], tuple[np.ndarray, np.ndarray]]] = {
    "wool": _wool,
    "knit": lambda detail: _drum(detail, _stitches, 24),
    "weave": lambda detail: _drum(detail, _bands, 32),
    "lattice": cache(_lattice),
    "terrain": _terrain,
}
