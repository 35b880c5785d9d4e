"""Analytic meshes that aren't a sphere with a relief: a torus, an animal, wool, fabrics, a lattice,
a terrain."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from styleexp.inputs.spheres import fibonacci, gap, icosahedron, icosphere, smoothstep

if TYPE_CHECKING:
    pass


def torus(detail: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a torus of about ``detail`` vertices."""
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
def critter(detail: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of the animal, of about ``detail`` vertices."""
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


def wool(detail: int) -> tuple[np.ndarray, np.ndarray]:
    """Balls around a ball, each with a spiral ridge that starts at its outermost point."""
    rng = np.random.default_rng(3)
    count = 80
    centers = fibonacci(count) + 0.2 * gap(count) * rng.normal(size=(count, 3))
    centers *= (rng.uniform(0.74, 0.84, count) / np.linalg.norm(centers, axis=1))[:, None]
    ball, faces = icosphere(int(detail / (count + 1)))
    points = [0.75 * ball]
    for center, size in zip(centers, rng.uniform(0.20, 0.26, count), strict=True):
        out = center / np.linalg.norm(center)
        right = np.cross(out, rng.normal(size=3))
        right /= np.linalg.norm(right)
        from_pole = np.arccos(np.clip(ball @ out, -1.0, 1.0))
        turn = np.arctan2(ball @ np.cross(out, right), ball @ right)
        ridge = np.cos(10.0 * from_pole - turn) * smoothstep(2.5 * np.sin(from_pole))
        points.append(center + size * (1.0 + 0.1 * ridge)[:, None] * ball)
    shifted = [faces + k * len(ball) for k in range(count + 1)]
    return np.concatenate(points), np.concatenate(shifted)


def drum(
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
    inner = smoothstep((0.9 * radius - np.abs(points[:, 1])) / (0.05 * radius))
    top = smoothstep((0.9 * radius - side) / (0.05 * radius))
    total = unit * (inner * (wall - middle) + top * (end - middle))
    slope = np.stack([points[:, 0] * side ** (power - 2), points[:, 1] ** (power - 1),
                      points[:, 2] * side ** (power - 2)], axis=1)  # fmt: skip
    return points + total[:, None] * slope / np.linalg.norm(slope, axis=1, keepdims=True), faces


def stitches(across: np.ndarray, up: np.ndarray) -> np.ndarray:
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


def bands(across: np.ndarray, up: np.ndarray) -> np.ndarray:
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


def lattice(detail: int) -> tuple[np.ndarray, np.ndarray]:
    """Struts along the edges of a truncated icosahedron, with holes through them."""
    from scipy.spatial import cKDTree

    points, faces = icosahedron()
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


def terrain(detail: int) -> tuple[np.ndarray, np.ndarray]:
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
