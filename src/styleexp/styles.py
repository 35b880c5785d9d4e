"""Style sources: a mesh or an image, turned into the Gram matrices to reach (Sec. 4.2)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import torch
from torch.nn import functional

from styleexp import views
from styleexp.viewer import Images

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jaxtyping import Float
    from torch import Tensor

    from styleexp.config import StyleConfig, ViewsConfig
    from styleexp.losses import Grams, StyleLoss
    from styleexp.viewer import Viewer

BANK_STEP = 1_000_000
"""Steps from here on number the views of the style bank, so that no training view is among them."""


class StyleTarget(Protocol):
    """The Grams that the generated mesh should have in a step: of global and of local views."""

    def __call__(self, step: int) -> tuple[Grams, Grams]: ...


class FixedTarget:
    """Grams averaged once over a bank of views of the style."""

    def __init__(self, loss: StyleLoss, batches: Iterator[tuple[Images, Images]]):
        with torch.no_grad():
            pairs = [
                (loss.grams(whole.image, whole.coverage), loss.grams(local.image, local.coverage))
                for whole, local in batches
            ]
        self.grams = _mean([g for g, _ in pairs]), _mean([g for _, g in pairs])

    def __call__(self, step: int) -> tuple[Grams, Grams]:
        """The same for every step."""
        return self.grams


class SameViewsTarget:
    """The style mesh rendered at the generated mesh's own views, as in the paper."""

    def __init__(self, loss: StyleLoss, viewer: Viewer, vertices: Float[Tensor, "vertices 3"]):
        self.loss, self.viewer, self.vertices = loss, viewer, vertices

    @torch.no_grad()
    def __call__(self, step: int) -> tuple[Grams, Grams]:
        """Grams of the style mesh at this step's views."""
        whole, local = self.viewer(self.vertices, step)
        return (
            self.loss.grams(whole.image, whole.coverage),
            self.loss.grams(local.image, local.coverage),
        )


def mesh_bank(
    viewer: Viewer, vertices: Float[Tensor, "vertices 3"], bank_views: int
) -> Iterator[tuple[Images, Images]]:
    """Views of a style mesh, in batches of a step's size."""
    batches = max(1, round(bank_views / viewer.config.count))
    for batch in range(batches):
        with torch.no_grad():
            yield viewer(vertices, BANK_STEP + batch)


def image_bank(
    picture: Float[Tensor, "height width"],
    style: StyleConfig,
    config: ViewsConfig,
    bank_views: int,
    seed: int,
) -> Iterator[tuple[Images, Images]]:
    """Windows of a style picture with the texel density that the views of the result have.

    The picture's longer side spans ``image_tile * scale`` radii of the source; it is mirrored at its
    borders where a view is wider. Each batch holds ``count`` global and ``count * per_view`` local
    windows at random places.
    """
    batches = max(1, round(bank_views / config.count))
    radius = global_texels(config)
    local_radius = local_texels(config)
    for batch in range(batches):
        generator = views.step_generator(seed, BANK_STEP + batch, stream=2)
        yield (
            _windows(picture, style, radius, config.resolution, config.count, generator),
            _windows(
                picture,
                style,
                local_radius,
                config.local.size,
                config.count * config.local.per_view,
                generator,
            ),
        )


def whole_image_bank(
    picture: Float[Tensor, "height width"], config: ViewsConfig, bank_views: int, seed: int
) -> Iterator[tuple[Images, Images]]:
    """The paper's reading: the picture itself is the global view, local views are its crops."""
    size = [config.resolution, config.resolution]
    resized = functional.interpolate(
        picture[None, None], size, mode="bilinear", antialias=True, align_corners=False
    )
    image = resized.permute(0, 2, 3, 1).expand(config.count, -1, -1, -1)
    everywhere = torch.ones_like(image[..., 0])
    for batch in range(max(1, round(bank_views / config.count))):
        generator = views.step_generator(seed, BANK_STEP + batch, stream=2)
        windows, view = views.crop_windows(config.local, config.count, generator)
        local = views.crop_images(
            image, windows.to(image), view.to(image.device), config.local.size
        )
        yield Images(image, everywhere), Images(local, torch.ones_like(local[..., 0]))


def tone(
    picture: Float[Tensor, "height width"], mean: float, style: StyleConfig
) -> Float[Tensor, "height width"]:
    """The picture with the tone of a render: its mean and its contrast set the relief's height."""
    centre = picture.mean()
    contrast = 1.0
    if style.image_contrast is not None:
        contrast = style.image_contrast / float(picture.std().clamp(min=1e-6))
    goal = mean if style.image_match_mean else float(centre)
    return ((picture - centre) * contrast + goal).clamp(0, 1)


def global_texels(config: ViewsConfig) -> float:
    """Pixels of a global view that a length of one source radius at the object's centre takes."""
    half = config.distance * torch.tensor(config.fov / 2).deg2rad().tan().item()
    return config.resolution / (2 * half)


def local_texels(config: ViewsConfig) -> float:
    """The same for local views."""
    local = config.local
    if local.mode == "surface":
        return local.size / local.extent
    side = local.share if local.crop == "side" else local.share**0.5
    return global_texels(config) * local.size / (side * config.resolution)


def _windows(
    picture: Float[Tensor, "height width"],
    style: StyleConfig,
    texels: float,
    size: int,
    count: int,
    generator: torch.Generator,
) -> Images:
    longer = max(picture.shape)
    factor = texels * style.image_tile * style.scale / longer
    shape = [max(8, round(side * factor)) for side in picture.shape]
    resized = functional.interpolate(
        picture[None, None], shape, mode="bilinear", antialias=True, align_corners=False
    )[0, 0]
    offsets = torch.rand(count, 2, generator=generator)
    cut = []
    for dy, dx in offsets.tolist():
        rows = _mirrored(int(dy * 2 * shape[0]), size, shape[0], picture.device)
        columns = _mirrored(int(dx * 2 * shape[1]), size, shape[1], picture.device)
        cut.append(resized[rows][:, columns])
    image = torch.stack(cut)[..., None]
    return Images(image, torch.ones_like(image[..., 0]))


def _mirrored(start: int, count: int, size: int, device: torch.device) -> Tensor:
    index = (start + torch.arange(count, device=device)) % (2 * size)
    return torch.where(index < size, index, 2 * size - 1 - index)


def _mean(batches: list[Grams]) -> Grams:
    return [torch.stack(layer).mean(0) for layer in zip(*batches, strict=True)]
