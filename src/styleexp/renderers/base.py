"""The renderer contract: what every backend is given and what it gives back.

Coordinates, once and for all backends::

      world                camera (OpenGL)           NDC                    image
      +Y up                +Y up                     (-1,+1)    (+1,+1)     (0,0)────► column
       │                    │                           ┌──────────┐          │
       │                    │                           │   +y     │          │
       └──── +X             └──── +X                    │    └─ +x │          ▼
      ╱                    ╱                            └──────────┘         row
    +Z  azimuth 0 looks   +Z  towards the viewer:    (-1,-1)    (+1,-1)    pixel (r, c) has its
        from +Z, +90°         the camera looks                             centre at
        from +X               along -Z                                     (c + 0.5, r + 0.5)

A point ``p`` in the world is at ``q = R p + t`` in the camera and at ``x = focal_x q.x / -q.z +
center_x``, ``y = focal_y q.y / -q.z + center_y`` in NDC. ``w = -q.z`` is its depth, positive in
front of the camera. Faces wind counter-clockwise seen from outside; back faces are culled.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import torch

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from torch import Tensor


@dataclass(frozen=True)
class Cameras:
    """A batch of pinhole cameras. Distances are in world units, NDC is [-1, 1] over the image."""

    rotation: Float[Tensor, "views 3 3"]
    """World to camera, rows are the camera's right, up and backward axes."""
    translation: Float[Tensor, "views 3"]
    focal: Float[Tensor, "views 2"]
    """NDC per unit of tangent, (x, y): 1 / tan(half the field of view) for a centred camera."""
    center: Float[Tensor, "views 2"]
    """NDC position of the optical axis, (x, y), +y up: (0, 0) unless the view is a crop."""
    near: float = 1e-2

    def __len__(self) -> int:
        return self.rotation.shape[0]

    def __getitem__(self, index: slice | Tensor) -> Cameras:
        """The sub-batch of cameras that a slice, mask or index tensor selects."""
        return Cameras(
            self.rotation[index],
            self.translation[index],
            self.focal[index],
            self.center[index],
            self.near,
        )


@dataclass(frozen=True)
class Shading:
    """How surfaces look; shared by all backends so that their pictures are comparable.

    Grey intensity, Text2Mesh's light: ``I = clamp(albedo (ambient + n . light), 0, 1)`` with n the
    unit normal in *camera* space, so that the light moves with the camera.
    """

    albedo: float = 0.5
    ambient: float = 0.28209
    light: Float[Tensor, "views 3"] | tuple[float, float, float] = (0.48860, 0.48860, 0.48860)
    """Camera-space direction times strength; a tensor gives each view a light of its own."""
    background: float = 1.0
    normals: str = "flat"
    """``flat`` (one normal a face) or ``smooth`` (area-weighted vertex normals, interpolated)."""
    outlines: bool = True
    """Whether backends that can differentiate visibility do: outlines are then anti-aliased and
    pull on the vertices. Without, outlines are hard and gradients are those of shading alone."""


@dataclass(frozen=True)
class RenderOutput:
    """What a backend returns. Only ``image`` and ``coverage`` are promised by every backend."""

    image: Float[Tensor, "views height width channels"]
    """In [0, 1]; one channel (grey) or three (RGB)."""
    coverage: Float[Tensor, "views height width"]
    """1 where the mesh covers the pixel, 0 on the background, between them along anti-aliased
    outlines. Carries gradients where the backend differentiates visibility."""
    face_ids: Int[Tensor, "views height width"] | None = None
    """Index of the visible face, -1 on the background."""
    depth: Float[Tensor, "views height width"] | None = None
    """Distance along the viewing axis (``w`` above), ``inf`` on the background."""


@dataclass(frozen=True)
class Capabilities:
    """What a backend can do, so that tests and users know what to expect of it."""

    differentiable_shading: bool
    differentiable_visibility: bool
    devices: tuple[str, ...] = ("cpu",)
    decides_ties: bool = True
    """Whether a pixel centre right on an edge belongs to exactly one of the faces that share it,
    and of faces in the very same place the first is seen. Ray tracers can't promise it."""


class Renderer(ABC):
    """A rendering backend. Stateless between calls, apart from caches."""

    capabilities: ClassVar[Capabilities]

    @abstractmethod
    def render(
        self,
        vertices: Float[Tensor, "vertices 3"],
        faces: Int[Tensor, "faces 3"],
        cameras: Cameras,
        shading: Shading,
        resolution: tuple[int, int],
    ) -> RenderOutput:
        """Render one mesh from every camera.

        ``resolution`` is (height, width) in pixels. Gradients flow from ``image`` (and, with
        visibility gradients, ``coverage``) to ``vertices``. An empty mesh gives the background.
        """

    def render_lights(
        self,
        vertices: Float[Tensor, "vertices 3"],
        faces: Int[Tensor, "faces 3"],
        cameras: Cameras,
        shading: Shading,
        lights: Float[Tensor, "lights views 3"],
        resolution: tuple[int, int],
    ) -> RenderOutput:
        """The same picture under several lights: each is seen in a channel of its own.

        ``lights`` stand where ``shading.light`` does in `render`. This renders once for each; a
        backend may share what doesn't depend on the light.
        """
        outs = [
            self.render(vertices, faces, cameras, replace(shading, light=light), resolution)
            for light in lights
        ]
        # Of a backend with colours, each light takes its own: red, green, blue.
        channels = [out.image[..., min(i, out.image.shape[-1] - 1)] for i, out in enumerate(outs)]
        return replace(outs[0], image=torch.stack(channels, dim=-1))
