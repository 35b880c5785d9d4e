"""The paper's loop in plain PyTorch, with this package's parts: no configuration, no files but one.

python examples/plain_loop.py            # about a minute on two cores, writes bumpy.ply
"""

import torch

from styleexp.inputs import meshes, shapes
from styleexp.method.fields import FourierMLP
from styleexp.method.losses import GramLoss
from styleexp.method.options import FieldConfig, LossConfig
from styleexp.method.surface import normalised
from styleexp.method.viewer import Images
from styleexp.method.views import orbit
from styleexp.plugins import load_encoder
from styleexp.renderers.base import Shading
from styleexp.renderers.soft_raster import SoftRaster

STEPS, VIEWS, SIZE = 60, 4, 160


def main(encoder: str = "vgg16", steps: int = STEPS) -> list[float]:
    """Put the bubbles of one sphere onto a torus; returns the loss of every step."""
    source, cpu = shapes.make("torus", 6000), torch.device("cpu")
    frame, surface = normalised(source, cpu)
    _, style = normalised(shapes.make("bubble", 6000), cpu)

    renderer, shading = SoftRaster(), Shading(normals="smooth", background=0.3, outlines=False)
    loss = GramLoss(LossConfig(), load_encoder(encoder))
    random = torch.Generator().manual_seed(0)
    field = FourierMLP(FieldConfig(depth=4), random, sigma=5.0, bound=0.1)
    adam = torch.optim.Adam(field.parameters(), lr=2e-3)

    def seen(vertices: torch.Tensor, faces: torch.Tensor, cameras) -> list[torch.Tensor]:
        out = renderer.render(vertices, faces, cameras, shading, (SIZE, SIZE))
        return loss.describe(Images(out.image, out.coverage))

    losses = []
    for _ in range(steps):
        turn = 2 * torch.pi * torch.rand(VIEWS, generator=random)
        cameras = orbit(0.6 * torch.randn(VIEWS, generator=random), turn, distance=2.0, fov=60.0)
        with torch.no_grad():
            target = seen(style.vertices, style.faces, cameras)
            scales = loss.scales(target, seen(surface.vertices, surface.faces, cameras))
        d = field(surface.vertices)
        moved = surface.vertices + d[:, None] * surface.normals
        total = loss.distance(seen(moved, surface.faces, cameras), target, scales)
        adam.zero_grad()
        total.backward()
        adam.step()
        losses.append(total.item())

    vertices = frame.invert(moved.detach().double().numpy())
    meshes.save_mesh(source, vertices, "bumpy.ply", d.detach().double().numpy())
    return losses


if __name__ == "__main__":
    found = main()
    print(f"loss {found[0]:.2f} at the first step, {found[-1]:.2f} at the last: bumpy.ply")
