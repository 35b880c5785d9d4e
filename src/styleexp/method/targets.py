"""The style as what the loss compares with: statistics of its views, such as Gram matrices (Sec.
4.2)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Protocol

import torch

from styleexp.method import pictures, views
from styleexp.method.viewer import Images

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jaxtyping import Float
    from torch import Tensor

    from styleexp.method.losses import Loss, Statistics
    from styleexp.method.options import Settings, StyleConfig, ViewsConfig
    from styleexp.method.viewer import Viewer

BANK_STEP = 1_000_000
"""First step number of the style bank's draws, so that no training step draws the same."""
OWN_VIEWS = 2_000_000
"""First step number of the style's views with ``loss.target=own_views``."""
LOSS_STREAM = 8
"""Stream of the random numbers that a loss draws (`losses.Loss.for_step`)."""


class StyleTarget(Protocol):
    """Target Statistics of a step, for global and local views."""

    def __call__(self, step: int) -> tuple[Statistics, Statistics]:
        """The Statistics for this step."""
        ...


class FixedTarget:
    """Constant statistics, averaged over a bank of views."""

    def __init__(self, whole: Statistics, local: Statistics):
        self.statistics = whole, local

    def __call__(self, step: int) -> tuple[Statistics, Statistics]:
        """The constant statistics, for any step."""
        return self.statistics


class RenderedTarget:
    """Statistics of the style mesh, rendered in every step: at the generated mesh's views, as in
    the paper, or at those of ``later`` steps, so that the two see different views."""

    def __init__(
        self, loss: Loss, viewer: Viewer, vertices: Float[Tensor, "vertices 3"], later: int = 0
    ):
        self.loss, self.viewer, self.vertices, self.later = loss, viewer, vertices, later

    @torch.no_grad()
    def __call__(self, step: int) -> tuple[Statistics, Statistics]:
        """Statistics of the style mesh at this step's views."""
        loss = in_step(self.loss, self.viewer.seed, step)
        whole, local = self.viewer(self.vertices, step + self.later)
        return loss.describe(whole), loss.describe(local)


def in_step(loss: Loss, seed: int, step: int) -> Loss:
    """The loss to use in this step of a run with this seed; see `losses.Loss.for_step`."""
    return loss.for_step(views.step_generator(seed, step, stream=LOSS_STREAM))


def mean_statistics(
    loss: Loss, batches: Iterator[tuple[Images, Images]]
) -> tuple[Statistics, Statistics]:
    """Statistics of global and local views, pooled over batches."""
    with torch.no_grad():
        pairs = [(loss.describe(whole), loss.describe(local)) for whole, local in batches]
    return loss.pooled([g for g, _ in pairs]), loss.pooled([g for _, g in pairs])


def mesh_statistics(
    loss: Loss, viewer: Viewer, vertices: Float[Tensor, "vertices 3"], bank_views: int
) -> tuple[Statistics, Statistics]:
    """Statistics of a mesh, averaged over a bank of about ``bank_views`` global views."""
    batches = max(1, round(bank_views / viewer.config.count))
    return mean_statistics(loss, (viewer(vertices, BANK_STEP + batch) for batch in range(batches)))


def image_bank(
    picture: Float[Tensor, "height width"], config: Settings, unit: float
) -> Iterator[tuple[Images, Images]]:
    """Windows of a style image, at the texel density of the result's views.

    A square image has the area of a sphere of radius ``image_tile * unit``, in radii of the source;
    it is mirrored where a view is wider. Each batch holds ``count`` global and ``count * per_view``
    local windows at random positions.
    """
    views_, local = config.views, config.views.local
    span = config.style.image_tile * unit * math.sqrt(4 * math.pi)
    for generator in _batches(config):
        yield (
            picture_windows(
                picture, span * global_texels(views_), views_.resolution, views_.count, generator
            ),
            picture_windows(
                picture,
                span * local_texels(views_),
                local.size,
                views_.count * local.per_view,
                generator,
            ),
        )


def whole_image_bank(
    picture: Float[Tensor, "height width"], config: Settings
) -> Iterator[tuple[Images, Images]]:
    """As in the paper: the image is the global view, and local views are its crops; with
    ``loss.target=whole`` local views are also the whole image."""
    count, local = config.views.count, config.views.local
    size = [config.views.resolution, config.views.resolution]
    image = pictures.shrunk(picture, size)[None, :, :, None].expand(count, -1, -1, -1)
    for generator in _batches(config):
        if config.loss.target == "whole":
            yield _all_seen(image), _all_seen(image)
            continue
        windows, view = views.crop_windows(local, count, generator)
        cut = views.crop_images(image, windows, view, local.size)
        yield _all_seen(image), _all_seen(cut)


def _batches(config: Settings) -> Iterator[torch.Generator]:
    for batch in range(max(1, round(config.loss.bank_views / config.views.count))):
        yield views.step_generator(config.optim.seed, BANK_STEP + batch, stream=2)


def _all_seen(image: Float[Tensor, "n height width channels"]) -> Images:
    return Images(image, torch.ones_like(image[..., 0]))


def tone(
    rgb: Float[Tensor, "height width 3"], mean: float, style: StyleConfig
) -> Float[Tensor, "height width"]:
    """The image in grey, with the tone of a render; its contrast sets the relief's height."""
    picture = rgb @ rgb.new_tensor([0.299, 0.587, 0.114])  # luma, ITU-R BT.601
    centre = picture.mean()
    contrast = 1.0
    if style.image_contrast is not None:
        contrast = style.image_contrast / float(picture.std().clamp(min=1e-6))
    goal = mean if style.image_match_mean else float(centre)
    return ((picture - centre) * contrast + goal).clamp(0, 1)


def global_texels(config: ViewsConfig) -> float:
    """Pixels per source radius at the object's centre, in global views."""
    half = config.distance * torch.tensor(config.fov / 2).deg2rad().tan().item()
    return config.resolution / (2 * half)


def local_texels(config: ViewsConfig) -> float:
    """Pixels per source radius, in local views."""
    local = config.local
    if local.mode == "surface":
        return local.size / local.extent
    side = local.share if local.crop == "side" else local.share**0.5
    return global_texels(config) * local.size / (side * config.resolution)


def picture_windows(
    picture: Float[Tensor, "height width"],
    longer_side: float,
    size: int,
    count: int,
    generator: torch.Generator,
) -> Images:
    """``count`` square windows of ``size`` pixels at random positions in an image resized to
    ``longer_side`` pixels and mirrored at its borders."""
    shown = pictures.resized(picture, longer_side)
    height, width = shown.shape
    cut = []
    for dy, dx in torch.rand(count, 2, generator=generator).tolist():
        rows = _mirrored(int(dy * 2 * height), size, height, picture.device)
        columns = _mirrored(int(dx * 2 * width), size, width, picture.device)
        cut.append(shown[rows][:, columns])
    return _all_seen(torch.stack(cut)[..., None])


def _mirrored(start: int, count: int, size: int, device: torch.device) -> Tensor:
    index = (start + torch.arange(count, device=device)) % (2 * size)
    return torch.where(index < size, index, 2 * size - 1 - index)
