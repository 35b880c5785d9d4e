"""A picture as style: as a relief of its own, and as the tone that renders should have."""

import math

import pytest
import torch

from styleexp import styles
from styleexp.config import StyleConfig
from styleexp.geometry import Surface
from styleexp.renderers.base import Cameras, Shading
from styleexp.renderers.soft_raster import SoftRaster
from styleexp.viewer import turned_light

SIDE = 2.0


def blobs() -> torch.Tensor:
    """(60, 60, 3): bright spots of several sizes, none at the border."""
    y, x = torch.meshgrid(torch.arange(60.0), torch.arange(60.0), indexing="ij")
    centres = ((15, 20, 4.0), (40, 12, 6.0), (42, 44, 5.0))
    grey = sum(torch.exp(-((y - a) ** 2 + (x - b) ** 2) / (2 * w * w)) for a, b, w in centres)
    return grey[..., None].expand(-1, -1, 3).clone()


def plane(height: torch.Tensor) -> Surface:
    """A square of side ``SIDE`` facing +Z, with a vertex at each pixel's centre."""
    count = len(height)
    at = (torch.arange(count) + 0.5) / count * SIDE - SIDE / 2
    y, x = torch.meshgrid(-at, at, indexing="ij")  # row 0 is on top
    vertices = torch.stack([x, y, height], dim=-1).reshape(-1, 3)
    index = torch.arange(count * count).view(count, count)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = torch.cat([torch.stack(f, -1).reshape(-1, 3) for f in ((a, b, c), (a, c, d))])
    return Surface(vertices, faces, torch.zeros_like(vertices))


def test_a_bright_spot_of_a_picture_is_high():
    height = styles.height_map(blobs(), half_range=0.03)
    assert height.shape == (60, 60)
    assert abs(float(height.mean())) < 1e-6
    low, high = height.flatten().quantile(torch.tensor([0.01, 0.99]))
    assert float(high - low) == pytest.approx(0.06, rel=1e-4)
    assert divmod(int(height.argmax()), 60) in [(15, 20), (40, 12), (42, 44)]


def test_a_grey_picture_is_flat():
    height = styles.height_map(torch.full((20, 30, 3), 0.4), half_range=0.03)
    assert float(height.abs().max()) < 1e-5


@pytest.mark.parametrize("lights", [1, 3])
def test_a_lit_relief_is_what_the_renderer_shows_of_it(lights):
    shading = Shading(normals="smooth", background=0.0, outlines=False)
    height = styles.height_map(blobs(), half_range=0.05)
    picture = styles.lit_relief(height, SIDE, lights, shading)

    surface = plane(height)
    far = 200.0  # from so far away perspective doesn't show
    camera = Cameras(
        rotation=torch.eye(3)[None],
        translation=torch.tensor([[0.0, 0.0, -far]]),
        focal=torch.full((1, 2), 2 * far / SIDE),
        center=torch.zeros(1, 2),
    )
    turns = torch.arange(lights) * (360 / lights)
    rendered = (
        SoftRaster()
        .render_lights(
            surface.vertices,
            surface.faces,
            camera,
            shading,
            turned_light(shading, turns)[:, None],
            tuple(picture.shape[:2]),
        )
        .image[0]
    )
    inside = slice(16, -16)
    error = (picture - rendered)[inside, inside]
    assert float(rendered[inside, inside].std()) > 0.03
    assert float(error.square().mean().sqrt()) < 0.1 * float(rendered[inside, inside].std())


def test_tone_has_the_contrast_and_mean_asked_for():
    style = StyleConfig(image_as="tone", image_contrast=0.05)
    tone = styles.tone(blobs(), 0.4, style)
    assert tone.shape == (60, 60, 1)
    assert float(tone.mean()) == pytest.approx(0.4, abs=1e-3)
    assert float(tone.std()) == pytest.approx(0.05, rel=1e-2)
    own = styles.tone(blobs(), 0.4, StyleConfig(image_contrast=None, image_match_mean=False))
    torch.testing.assert_close(own[..., 0], blobs()[..., 0].clamp(0, 1))


def test_windows_of_a_picture_show_it_at_the_density_asked_for():
    picture = torch.linspace(0, 1, 40)[None, :, None].expand(40, 40, 2)
    generator = torch.Generator().manual_seed(0)
    seen = styles.picture_windows(picture, 80, 16, 5, generator)
    assert seen.image.shape == (5, 16, 16, 2)
    steps = seen.image[:, 0, 1:, 0] - seen.image[:, 0, :-1, 0]
    assert float(steps.abs().median()) == pytest.approx(1 / 80, rel=0.1)
    assert math.isclose(float(seen.coverage.min()), 1.0)
