"""Deferred rendering: find out which face is seen where, then shade and anti-alias only that.

Finding out (``DeferredRenderer.find_visible``) is not differentiated, and is all that the backends
built on this differ in; light, outlines and every gradient are theirs in common.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import torch

from styleexp.errors import unknown_name
from styleexp.renderers.base import Cameras, Capabilities, Renderer, RenderOutput, Shading
from styleexp.renderers.soft_raster.contour import (
    Compose,
    CrossingDistance,
    find_crossings,
    neighbours,
)
from styleexp.renderers.soft_raster.geometry import FaceNormals, Project, pixel_projection
from styleexp.renderers.soft_raster.raster import candidate_pairs, facing
from styleexp.renderers.soft_raster.shading import FlatSurface, SmoothSurface, world_light

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from torch import Tensor

    from styleexp.renderers.soft_raster.raster import FacePairs, Visible

VISIBILITY_GRADIENTS = ("contour", "none")
MOST_PAIRS = 1 << 22
"""Views times faces (or vertices) that are rendered at once without gradients: bounds memory."""


@dataclass(frozen=True)
class Projected:
    """A mesh on the screens of all views: what visibility is found from. Without gradients."""

    points: Float[Tensor, "3 views vertices"]
    """Homogeneous pixels ``(column w, row w, w)``; see ``pixel_projection``."""
    corners: Int[Tensor, "3 faces"]
    pairs: FacePairs
    """The faces that each view may see; all others can be left out."""
    near: float
    """Nothing nearer than this, in world units along the viewing axis, is seen."""
    resolution: tuple[int, int]
    """(height, width) in pixels."""


class DeferredRenderer(Renderer):
    """Hard visibility, exact shading gradients, contour-edge visibility gradients.

    ``visibility_gradient`` is ``contour`` (outlines are anti-aliased and carry the gradient of what
    covers what) or ``none`` (hard outlines; the gradient is that of shading alone). Grey images
    (one channel), float32 or float64 after the vertices, any device that torch knows. Raises
    ``UserError`` for an unknown ``visibility_gradient`` or ``Shading.normals``.

    Against finite differences of an 8 times supersampled render, gradients of smoothly shaded
    images and of coverage are within 10 %. Those of flat shaded images lack one thing: the borders
    between neighbouring faces' grey levels move too, and only outlines are accounted for here.
    ``capabilities`` are those of ``contour``.
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
        """The nearest front face at every pixel centre. Called with gradients off."""

    def render(
        self,
        vertices: Float[Tensor, "vertices 3"],
        faces: Int[Tensor, "faces 3"],
        cameras: Cameras,
        shading: Shading,
        resolution: tuple[int, int],
    ) -> RenderOutput:
        """Render one mesh from every camera; see ``Renderer.render``."""
        light = torch.as_tensor(shading.light).to(vertices).expand(1, len(cameras), 3)
        return self.render_lights(vertices, faces, cameras, shading, light, resolution)

    def render_lights(
        self,
        vertices: Float[Tensor, "vertices 3"],
        faces: Int[Tensor, "faces 3"],
        cameras: Cameras,
        shading: Shading,
        lights: Float[Tensor, "lights views 3"],
        resolution: tuple[int, int],
    ) -> RenderOutput:
        """All lights on what is found to be seen once; see ``Renderer.render_lights``."""
        if shading.normals not in ("flat", "smooth"):
            raise unknown_name("kind of normals", shading.normals, ("flat", "smooth"))
        # Views don't depend on each other, so without gradients they need not be there at once.
        at_once = max(1, MOST_PAIRS // max(faces.shape[0], vertices.shape[0], 1))
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
        """Faces across edges; remembered, since a fit renders the same topology many times."""
        if self._known is None or self._known[0] is not faces or self._known[1] != faces._version:
            self._known = (faces, faces._version, neighbours(faces.long(), count))
        return self._known[2]


def _eyes(cameras: Cameras, like: Tensor) -> Float[Tensor, "views 3"]:
    """Positions of the cameras in the world."""
    rotation, translation = cameras.rotation.to(like), cameras.translation.to(like)
    return -(rotation * translation[:, :, None]).sum(1)
