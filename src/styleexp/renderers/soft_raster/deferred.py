"""Deferred rendering: find the visible face per pixel, then shade and anti-alias only those.

Finding visible faces (``DeferredRenderer.find_visible``) is not differentiated, and is the only
difference between backends built on this; they share light, outlines and all gradients.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import torch

from styleexp.renderers.base import (
    Cameras,
    Capabilities,
    Renderer,
    RenderOutput,
    Shading,
    lights_of,
)
from styleexp.renderers.soft_raster.composing import Compose
from styleexp.renderers.soft_raster.contour import (
    CrossingDistance,
    find_crossings,
    neighbours,
)
from styleexp.renderers.soft_raster.culling import candidate_pairs, facing
from styleexp.renderers.soft_raster.geometry import FaceNormals, Project, pixel_projection
from styleexp.renderers.soft_raster.shading import FlatSurface, SmoothSurface, world_light
from styleexp.system.errors import unknown_name

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from torch import Tensor

    from styleexp.renderers.soft_raster.culling import FacePairs
    from styleexp.renderers.soft_raster.raster import Visible

VISIBILITY_GRADIENTS = ("contour", "none")
MOST_PAIRS = {"cpu": 1 << 22, "cuda": 1 << 25}
"""Views times faces (or vertices) rendered per batch without gradients, by the device: bounds
memory, about 100 bytes each on a GPU, which then waits less often."""


@dataclass(frozen=True)
class Projected:
    """A mesh projected to all views, the input for visibility. Without gradients."""

    points: Float[Tensor, "3 views vertices"]
    """Homogeneous pixels ``(column w, row w, w)``; see ``pixel_projection``."""
    corners: Int[Tensor, "3 faces"]
    pairs: FacePairs
    """The candidate faces of each view; all others can be skipped."""
    near: float
    """Near plane, in world units along the viewing axis."""
    resolution: tuple[int, int]
    """(height, width) in pixels."""


class DeferredRenderer(Renderer):
    """Hard visibility, exact shading gradients, contour-edge visibility gradients.

    ``visibility_gradient`` is ``contour`` (anti-aliased outlines with visibility gradients) or
    ``none`` (hard outlines, shading gradients only). Grey images (one channel), float32 or float64
    like the vertices, on any torch device. Raises ``UserError`` for an unknown
    ``visibility_gradient`` or ``Shading.normals``.

    Gradients of smoothly shaded images and of coverage are within 10 % of finite differences of an
    8x supersampled render. Gradients of flat-shaded images ignore that borders between neighbouring
    faces' grey levels move; only outlines are accounted for. ``capabilities`` are those of
    ``contour``.
    """

    capabilities = Capabilities(
        differentiable_shading=True, differentiable_visibility=True, devices=("cpu", "cuda")
    )

    def __init__(self, visibility_gradient: str = "contour") -> None:
        if visibility_gradient not in VISIBILITY_GRADIENTS:
            raise unknown_name("visibility gradient", visibility_gradient, VISIBILITY_GRADIENTS)
        self.visibility_gradient = visibility_gradient
        self._known: tuple[Tensor, int, Tensor] | None = None

    @abstractmethod
    def find_visible(self, projected: Projected) -> Visible:
        """Find the nearest front face at every pixel centre. Called without gradients."""

    def render(
        self,
        vertices: Float[Tensor, "vertices 3"],
        faces: Int[Tensor, "faces 3"],
        cameras: Cameras,
        shading: Shading,
        resolution: tuple[int, int],
    ) -> RenderOutput:
        """Render one mesh from every camera; all lights share the visibility. See
        ``Renderer.render``."""
        # Cameras and lights are combined where they are, and sent to the device at once.
        lights = lights_of(shading, cameras, cameras.rotation.to(vertices.dtype))
        if shading.normals not in ("flat", "smooth"):
            raise unknown_name("kind of normals", shading.normals, ("flat", "smooth"))
        # Views are independent, so without gradients they can be rendered in batches.
        most = MOST_PAIRS.get(vertices.device.type, MOST_PAIRS["cpu"])
        at_once = max(1, most // max(faces.shape[0], vertices.shape[0], 1))
        if len(cameras) <= at_once or (torch.is_grad_enabled() and vertices.requires_grad):
            return self._render(vertices, faces, cameras, shading, lights, resolution)
        parts = []
        for start in range(0, len(cameras), at_once):
            some = slice(start, start + at_once)
            lit = lights[:, some]
            parts.append(self._render(vertices, faces, cameras[some], shading, lit, resolution))
        return RenderOutput(
            *(torch.cat([getattr(part, f.name) for part in parts]) for f in fields(RenderOutput))
        )

    def _render(
        self,
        vertices: Float[Tensor, "vertices 3"],
        faces: Int[Tensor, "faces 3"],
        cameras: Cameras,
        shading: Shading,
        lights: Float[Tensor, "lights views 3"],
        resolution: tuple[int, int],
    ) -> RenderOutput:
        corners = faces.t().contiguous().long()

        points = Project.apply(vertices, pixel_projection(cameras, resolution, vertices))
        face_normals = FaceNormals.apply(vertices, corners)

        with torch.no_grad():
            front = facing(vertices, corners, face_normals, _eyes(cameras, vertices))
            pairs = candidate_pairs(points, corners, front, cameras.near, resolution)
            visible = self.find_visible(
                Projected(points.detach(), corners, pairs, cameras.near, resolution)
            )

        light = world_light(cameras, lights, vertices)
        surface: FlatSurface | SmoothSurface
        if shading.normals == "flat":
            surface = FlatSurface(face_normals, light, shading)
        else:
            surface = SmoothSurface(points, face_normals, corners, light, shading)
        intensities = surface.at_pixels(visible)
        outlines = None
        if self.visibility_gradient == "contour" and shading.outlines:
            across = self._neighbours(faces, vertices.shape[0])
            edges = find_crossings(points, corners, across, front, pairs, visible, cameras.near)
            distance = CrossingDistance.apply(points, edges)
            outlines = distance, surface.at_crossings(edges), edges.inner, edges.outer
        image, coverage = Compose.apply(
            intensities, visible, shading.background, *(outlines or [None] * 4)
        )

        shape = visible.depth.shape
        return RenderOutput(
            image.view(len(lights), *shape).permute(1, 2, 3, 0),
            coverage.view(shape),
            visible.face_ids,
            visible.depth,
        )

    def _neighbours(self, faces: Tensor, count: int) -> Int[Tensor, "3 faces"]:
        """Faces across edges; cached, since a fit renders the same topology many times."""
        if self._known is None or self._known[0] is not faces or self._known[1] != faces._version:
            self._known = (faces, faces._version, neighbours(faces.long(), count))
        return self._known[2]


def _eyes(cameras: Cameras, like: Tensor) -> Float[Tensor, "views 3"]:
    """World positions of the cameras."""
    rotation, translation = cameras.rotation.to(like.dtype), cameras.translation.to(like.dtype)
    eyes = -(rotation * translation[:, :, None]).sum(1)
    return eyes.to(like.device, non_blocking=True)
