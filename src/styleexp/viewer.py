"""What is seen of a mesh in one step: its global and its local views (Sec. 3.3.1)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch

from styleexp import views

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from torch import Tensor

    from styleexp.config import ViewsConfig
    from styleexp.renderers.base import Cameras, Renderer, Shading

SURFACE_BANK = 512
"""How many surface points the local views of a run are drawn from."""


@dataclass(frozen=True)
class Images:
    """Pictures for the encoder and which of their pixels show the mesh."""

    image: Float[Tensor, "n height width channels"]
    coverage: Float[Tensor, "n height width"]


class Viewer:
    """Renders a mesh's views for any step; equal seeds see equal views.

    ``scale`` enlarges what is seen: the style mesh is shown larger to make its pattern come out
    larger on the result. ``light`` is "fixed" or "random" (see ``ShadingConfig``).
    """

    def __init__(
        self,
        config: ViewsConfig,
        renderer: Renderer,
        shading: Shading,
        vertices: Float[Tensor, "vertices 3"],
        faces: Int[Tensor, "faces 3"],
        normals: Float[Tensor, "vertices 3"],
        *,
        light: str = "fixed",
        scale: float = 1.0,
        seed: int = 0,
    ):
        self.config = config
        self.renderer = renderer
        self.shading = shading
        self.faces = faces
        self.light = light
        self.scale = scale
        self.seed = seed
        self.surface: Cameras | None = None
        if config.local.mode == "surface":
            self.surface = views.surface_cameras(
                vertices,
                faces,
                normals,
                config.local.extent / scale,
                SURFACE_BANK,
                views.step_generator(seed, 0, stream=1),
                renderer,
                shading,
            )

    def __call__(
        self, vertices: Float[Tensor, "vertices 3"], step: int, count: int | None = None
    ) -> tuple[Images, Images]:
        """Global and local views of the mesh with these vertices."""
        generator = views.step_generator(self.seed, step)
        count = self.config.count if count is None else count
        cameras = views.sample_global(self.config, generator, vertices.device, count)
        cameras = views.zoom(cameras, self.scale)
        size = self.config.resolution
        whole = self._render(vertices, cameras, size, generator)
        return self._perspective(whole, generator), self._local(
            vertices, cameras, whole, count, generator
        )

    def _local(
        self,
        vertices: Float[Tensor, "vertices 3"],
        cameras: Cameras,
        whole: Images,
        count: int,
        generator: torch.Generator,
    ) -> Images:
        local = self.config.local
        if self.surface is not None:
            chosen = torch.randint(
                len(self.surface), (count * local.per_view,), generator=generator
            )
            return self._render(vertices, self.surface[chosen], local.size, generator)
        windows, view = views.crop_windows(local, count, generator)
        windows, view = windows.to(vertices), view.to(vertices.device)
        if local.mode == "zoom":
            zoomed = views.crop_cameras(cameras, windows, view)
            return self._render(vertices, zoomed, local.size, generator)
        cut = views.crop_images(
            torch.cat([whole.image, whole.coverage[..., None]], dim=-1), windows, view, local.size
        )
        return self._perspective(Images(cut[..., :-1], cut[..., -1]), generator)

    def _render(
        self,
        vertices: Float[Tensor, "vertices 3"],
        cameras: Cameras,
        size: int,
        generator: torch.Generator,
    ) -> Images:
        shading = self.shading
        if self.light == "random":
            shading = replace(shading, light=random_light(shading, len(cameras), generator))
        out = self.renderer.render(vertices, self.faces, cameras, shading, (size, size))
        return Images(out.image, out.coverage)

    def _perspective(self, seen: Images, generator: torch.Generator) -> Images:
        if self.config.perspective == 0:
            return seen
        both = torch.cat(
            # The fill is an image's; shifted by it, coverage comes out as 0 beyond the frame.
            [seen.image, seen.coverage[..., None] + self.config.perspective_fill],
            dim=-1,
        )
        both = views.random_perspective(self.config, both, generator)
        return Images(both[..., :-1], both[..., -1] - self.config.perspective_fill)


def random_light(
    shading: Shading, count: int, generator: torch.Generator
) -> Float[Tensor, "views 3"]:
    """The light turned about the viewing axis by a random angle for each view."""
    light = torch.as_tensor(shading.light, dtype=torch.float32)
    angle = 2 * math.pi * torch.rand(count, generator=generator)
    across = light[:2].norm()
    return torch.stack([across * angle.cos(), across * angle.sin(), light[2].expand(count)], dim=1)
