"""Global and local views of a mesh in one step (Sec. 3.3.1)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch

from styleexp.method import views

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from torch import Tensor

    from styleexp.method.options import ViewsConfig
    from styleexp.method.surface import Surface
    from styleexp.renderers.base import Cameras, Renderer, Shading

SURFACE_BANK = 192
"""Number of surface points that a run's local views are drawn from."""


@dataclass(frozen=True)
class Images:
    """Images for the encoder, and which of their pixels show the mesh."""

    image: Float[Tensor, "n height width channels"]
    coverage: Float[Tensor, "n height width"]

    def blank(self) -> Int[Tensor, ""]:
        """Number of images that don't show the mesh at all."""
        return (self.coverage.detach().flatten(1).amax(1) <= 0).sum()


class Viewer:
    """Renders a mesh's views for any step; equal seeds give equal views.

    ``scale`` magnifies the mesh: showing the style larger makes its pattern larger on the result.
    Images have one channel per light; the ``lights`` are evenly spaced about the viewing axis,
    starting with that of ``shading``, and fixed in the ``camera`` or in the ``world``.
    """

    def __init__(
        self,
        config: ViewsConfig,
        renderer: Renderer,
        shading: Shading,
        surface: Surface,
        *,
        seed: int = 0,
        scale: float = 1.0,
        lights: int = 1,
        light_frame: str = "camera",
    ):
        self.config = config
        self.light_frame = light_frame
        self.seed = seed
        self.renderer = renderer
        self.shading = shading
        self.lights = lights
        self.faces = surface.faces
        self.scale = scale
        self.surface_cameras: Cameras | None = None
        if self.config.local.mode == "surface":
            self.surface_cameras = views.surface_cameras(
                surface,
                self.config.local.extent / scale,
                SURFACE_BANK,
                views.step_generator(self.seed, 0, stream=1),
                renderer,
                shading,
            )

    def __call__(self, vertices: Float[Tensor, "vertices 3"], step: int) -> tuple[Images, Images]:
        """Global and local views of the mesh with these vertices."""
        generator = views.step_generator(self.seed, step)
        cameras = views.sample_global(self.config, generator)
        cameras = views.zoom(cameras, self.scale)
        size = self.config.resolution
        whole = self._render(vertices, cameras, size)
        warped = self._perspective(whole, generator)
        cut_from = warped if self.config.local.perspective == "before" else whole
        return warped, self._local(vertices, cut_from, generator)

    def _local(
        self,
        vertices: Float[Tensor, "vertices 3"],
        whole: Images,
        generator: torch.Generator,
    ) -> Images:
        local, count = self.config.local, self.config.count
        if self.surface_cameras is not None:
            bank = self.surface_cameras
            chosen = torch.randint(len(bank), (count * local.per_view,), generator=generator)
            return self._render(vertices, bank[chosen], local.size)
        windows, view = views.crop_windows(local, count, generator)
        cut = views.crop_images(
            torch.cat([whole.image, whole.coverage[..., None]], dim=-1), windows, view, local.size
        )
        seen = Images(cut[..., :-1], cut[..., -1])
        return seen if local.perspective == "before" else self._perspective(seen, generator)

    def _render(self, vertices: Float[Tensor, "vertices 3"], cameras: Cameras, size: int) -> Images:
        turns = [torch.full((len(cameras),), 360 * i / self.lights) for i in range(self.lights)]
        lights = torch.stack([turned_light(self.shading, turn) for turn in turns])
        if self.light_frame == "world":
            lights = torch.einsum("vij,lvj->lvi", cameras.rotation, lights.to(cameras.rotation))
        shading = replace(self.shading, light=lights)
        out = self.renderer.render(vertices, self.faces, cameras, shading, (size, size))
        return Images(out.image, out.coverage)

    def _perspective(self, seen: Images, generator: torch.Generator) -> Images:
        if self.config.perspective == 0:
            return seen
        fill = self.config.perspective_fill
        fill = self.shading.background if fill is None else fill
        # The fill value is an image's; shifting by it makes coverage 0 outside the frame.
        both = torch.cat([seen.image, seen.coverage[..., None] + fill], dim=-1)
        both = views.random_perspective(self.config, both, fill, generator)
        return Images(both[..., :-1], both[..., -1] - fill)


def turned_light(shading: Shading, degrees: Float[Tensor, " views"]) -> Float[Tensor, "views 3"]:
    """Rotate the light about the viewing axis, by one angle per view."""
    x, y, z = torch.as_tensor(shading.light, dtype=torch.float32)
    angle = degrees.deg2rad()
    cos, sin = angle.cos(), angle.sin()
    return torch.stack([x * cos - y * sin, x * sin + y * cos, z.expand(len(degrees))], dim=1)
