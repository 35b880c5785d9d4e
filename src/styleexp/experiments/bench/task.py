"""The task of a render benchmark: the same scene for every renderer, built-in or third-party."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from styleexp.inputs import meshes, shapes
from styleexp.method.views import orbit
from styleexp.renderers.base import Shading

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from torch import Tensor

    from styleexp.renderers.base import Cameras

DISTANCE, FOV = 2.2, 60.0
"""Camera distance in radii and field of view in degrees: the unit sphere fills most of the
frame."""

LIGHT = (0.0, 0.0, 0.7)
"""Light from the camera, because renderers clamp grazing light differently."""


@dataclass(frozen=True)
class Task:
    """The scene, the same for every contender. On the CPU; in the unit sphere."""

    vertices: Float[Tensor, "vertices 3"]
    faces: Int[Tensor, "faces 3"]
    cameras: Cameras
    shading: Shading
    resolution: int
    weights: Float[Tensor, "views height width"]
    """Gradient of the loss w.r.t. the image."""


@dataclass(frozen=True)
class Rendered:
    """A contender's output, to check that it did the same work."""

    image: Float[np.ndarray, "views height width"]
    gradient: Float[np.ndarray, "vertices 3"]


Contender = Callable[[], Rendered]


def make_task(name: str, faces: int, views: int, resolution: int) -> Task:
    """Make a task from an analytic style's mesh, viewed from all around, smoothly shaded."""
    mesh = shapes.make(name, faces // 2 + 2)
    points = meshes.normalisation(mesh.vertices).apply(mesh.vertices)
    generator = torch.Generator().manual_seed(0)
    elevation = (torch.rand(views, generator=generator) - 0.5) * math.pi / 2
    azimuth = torch.arange(views) * (2 * math.pi / views)
    # A smooth gradient, like an encoder's; noise would only measure sub-pixel behaviour.
    coarse = torch.randn(views, 1, 8, 8, generator=generator)
    size = (resolution, resolution)
    weights = torch.nn.functional.interpolate(coarse, size, mode="bicubic")[:, 0]
    return Task(
        torch.from_numpy(points).float(),
        torch.from_numpy(mesh.faces).long(),
        orbit(elevation, azimuth, DISTANCE, FOV),
        Shading(normals="smooth", background=1.0, outlines=True, light=LIGHT),
        resolution,
        weights,
    )
