"""Points and meshes of the unit sphere."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    pass


def smoothstep(x: np.ndarray) -> np.ndarray:
    """Smooth rise from 0 to 1 as ``x`` goes from 0 to 1."""
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


@cache
def fibonacci(count: int) -> np.ndarray:
    """Evenly spread unit vectors (count, 3)."""
    k = np.arange(count) + 0.5
    y = 1.0 - 2.0 * k / count
    turn = np.pi * (1.0 + np.sqrt(5.0)) * k
    ring = np.sqrt(1.0 - y * y)
    return np.stack([ring * np.cos(turn), y, ring * np.sin(turn)], axis=1)


@cache
def gap(count: int) -> float:
    """Distance between neighbours of ``count`` evenly spread points, as if hexagonally packed."""
    return float(np.sqrt(8.0 * np.pi / (np.sqrt(3.0) * count)))


def icosahedron() -> tuple[np.ndarray, np.ndarray]:
    """Corners and outward faces of a regular icosahedron."""
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
def icosphere_of(frequency: int) -> tuple[np.ndarray, np.ndarray]:
    """An icosahedron whose edges are split into ``frequency`` parts, projected on the sphere."""
    corners, faces = icosahedron()
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
    points, faces = icosphere_of(frequency)
    return points.copy(), faces.copy()
