"""Three lights of three colours: what a grey picture hides of the normal, the colours show."""

import math
from dataclasses import replace

import torch

from styleexp.renderers.base import Renderer, RenderOutput, one_light_at_a_time
from styleexp.renderers.soft_raster import SoftRaster


class Normals(Renderer):
    """Red is the shared light, green and blue are that light turned about the viewing axis."""

    capabilities = SoftRaster.capabilities

    def __init__(self, turn: float):
        self.turn = turn
        self.grey = SoftRaster()

    @one_light_at_a_time
    def render(self, vertices, faces, cameras, shading, resolution) -> RenderOutput:
        """Render once for each light; see ``Renderer.render``."""
        light = torch.as_tensor(shading.light).to(vertices).expand(len(cameras), 3)
        outs = []
        for colour in range(3):
            cos, sin = (f(colour * math.radians(self.turn)) for f in (math.cos, math.sin))
            about_z = light.new_tensor([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
            lit = replace(shading, light=light @ about_z)
            outs.append(self.grey.render(vertices, faces, cameras, lit, resolution))
        return replace(outs[0], image=torch.cat([out.image for out in outs], dim=-1))
