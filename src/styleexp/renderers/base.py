"""The renderer interface: inputs and outputs of every backend.

Coordinate conventions, shared by all backends::

      world                camera (OpenGL)           NDC                    image
      +Y up                +Y up                     (-1,+1)    (+1,+1)     (0,0)────► column
       │                    │                           ┌──────────┐          │
       │                    │                           │   +y     │          │
       └──── +X             └──── +X                    │    └─ +x │          ▼
      ╱                    ╱                            └──────────┘         row
    +Z  azimuth 0 looks   +Z  towards the viewer:    (-1,-1)    (+1,-1)    pixel (r, c) has its
        from +Z, +90°         the camera looks                             centre at
        from +X               along -Z                                     (c + 0.5, r + 0.5)

A world point ``p`` is at ``q = R p + t`` in camera space and at ``x = focal_x q.x / -q.z +
center_x``, ``y = focal_y q.y / -q.z + center_y`` in NDC. ``w = -q.z`` is its depth, positive in
front of the camera. Faces wind counter-clockwise seen from outside; back faces are culled.
"""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float, Int


@dataclass(frozen=True)
class Cameras:
    """A batch of pinhole cameras. Distances are in world units, NDC is [-1, 1] over the image."""

    rotation: Float[Tensor, "views 3 3"]
    """World-to-camera rotation; rows are the camera's right, up and backward axes."""
    translation: Float[Tensor, "views 3"]
    focal: Float[Tensor, "views 2"]
    """Focal length in NDC, (x, y): 1 / tan(half the field of view) for a centred camera."""
    center: Float[Tensor, "views 2"]
    """NDC position of the optical axis, (x, y), +y up: (0, 0) unless the view is a crop."""
    near: float = 1e-2

    def __len__(self) -> int:
        return self.rotation.shape[0]

    def __getitem__(self, index: slice | Tensor) -> Cameras:
        """Select cameras by a slice, mask or index tensor."""
        return Cameras(
            self.rotation[index],
            self.translation[index],
            self.focal[index],
            self.center[index],
            self.near,
        )


@dataclass(frozen=True)
class Shading:
    """Appearance of surfaces, shared by all backends so that their images are comparable.

    Grey intensity with Text2Mesh's light: ``I = clamp(albedo (ambient + n . light), 0, 1)``, where
    n is the unit normal in *camera* space, so the light moves with the camera.
    """

    albedo: float = 0.5
    ambient: float = 0.28209
    light: Float[Tensor, "*lights views 3"] | tuple[float, float, float] = (0.4886, 0.4886, 0.4886)
    """Camera-space direction times strength. A tensor of shape (views, 3) sets one light per view;
    (lights, views, 3) renders one channel of the image under each light."""
    background: float = 1.0
    normals: str = "flat"
    """``flat`` (one normal per face) or ``smooth`` (interpolated area-weighted vertex normals)."""
    outlines: bool = True
    """Differentiate visibility, if the backend can: outlines are anti-aliased and have gradients.
    Otherwise outlines are hard, and only shading has gradients."""


@dataclass(frozen=True)
class RenderOutput:
    """Output of a backend. Only ``image`` and ``coverage`` are guaranteed."""

    image: Float[Tensor, "views height width channels"]
    """Image in [0, 1]: one channel per light, or, under a single light, one (grey) or three
    (RGB)."""
    coverage: Float[Tensor, "views height width"]
    """1 where the mesh covers the pixel, 0 on the background, in between along anti-aliased
    outlines. Has gradients if the backend differentiates visibility."""
    face_ids: Int[Tensor, "views height width"] | None = None
    """Index of the visible face, -1 on the background."""
    depth: Float[Tensor, "views height width"] | None = None
    """Distance along the viewing axis (``w`` above), ``inf`` on the background."""


@dataclass(frozen=True)
class Capabilities:
    """Features of a backend, for tests and users."""

    differentiable_shading: bool
    differentiable_visibility: bool
    devices: tuple[str, ...] = ("cpu",)
    decides_ties: bool = True
    """Whether a pixel centre exactly on an edge belongs to exactly one of its faces, and the first
    of coincident faces is visible. Ray tracers can't guarantee this."""


class Renderer(ABC):
    """A rendering backend. Stateless between calls, except for caches."""

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

        ``resolution`` is (height, width) in pixels. The output has the device and dtype of
        ``vertices``. Cameras and lights may be on another device: a run has them on the CPU, where
        a few numbers are combined sooner than a GPU is asked. ``shading.light`` may hold several
        lights (`lights_of`); a backend that shades with one at a time is decorated with
        `one_light_at_a_time`. Gradients flow from ``image`` (and, with visibility gradients,
        ``coverage``) to ``vertices``. An empty mesh renders the background.
        """


def lights_of(shading: Shading, cameras: Cameras, like: Tensor) -> Float[Tensor, "lights views 3"]:
    """``shading.light`` with all three axes, on the device and of the dtype of ``like``."""
    light = torch.as_tensor(shading.light).to(like)
    return light if light.ndim == 3 else light.expand(1, len(cameras), 3)


def one_light_at_a_time(render: Callable[..., RenderOutput]) -> Callable[..., RenderOutput]:
    """Decorate the ``render`` method of a backend that shades with one light: it is called once for
    each of several. Of an RGB backend's images the first light gives red, the second green, the
    third blue."""

    @functools.wraps(render)
    def under_each_light(
        self: Renderer,
        vertices: Float[Tensor, "vertices 3"],
        faces: Int[Tensor, "faces 3"],
        cameras: Cameras,
        shading: Shading,
        resolution: tuple[int, int],
    ) -> RenderOutput:
        if not isinstance(shading.light, Tensor) or shading.light.ndim < 3:
            return render(self, vertices, faces, cameras, shading, resolution)
        outs = [
            render(self, vertices, faces, cameras, replace(shading, light=light), resolution)
            for light in shading.light
        ]
        channels = [out.image[..., min(i, out.image.shape[-1] - 1)] for i, out in enumerate(outs)]
        return replace(outs[0], image=torch.stack(channels, dim=-1))

    return under_each_light
