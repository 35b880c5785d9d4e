"""A picture as style: the tone that renders should have, and the windows that are compared."""

import pytest
import torch

from styleexp.method import targets
from styleexp.method.options import StyleConfig


def blobs() -> torch.Tensor:
    """(60, 60, 3): bright spots of several sizes."""
    y, x = torch.meshgrid(torch.arange(60.0), torch.arange(60.0), indexing="ij")
    centres = ((15, 20, 4.0), (40, 12, 6.0), (42, 44, 5.0))
    grey = sum(torch.exp(-((y - a) ** 2 + (x - b) ** 2) / (2 * w * w)) for a, b, w in centres)
    return grey[..., None].expand(-1, -1, 3).clone()


def test_tone_has_the_contrast_and_mean_asked_for():
    tone = targets.tone(blobs(), 0.4, StyleConfig(image_contrast=0.05))
    assert tone.shape == (60, 60)
    assert float(tone.mean()) == pytest.approx(0.4, abs=1e-3)
    assert float(tone.std()) == pytest.approx(0.05, rel=1e-2)
    own = targets.tone(blobs(), 0.4, StyleConfig(image_contrast=None, image_match_mean=False))
    torch.testing.assert_close(own, blobs()[..., 0].clamp(0, 1))


def test_windows_of_a_picture_show_it_at_the_density_asked_for():
    picture = torch.linspace(0, 1, 40).expand(40, 40)
    seen = targets.picture_windows(picture, 80, 16, 5, torch.Generator().manual_seed(0))
    assert seen.image.shape == (5, 16, 16, 1)
    steps = (seen.image[:, 0, 1:, 0] - seen.image[:, 0, :-1, 0]).abs()
    assert float(steps.median()) == pytest.approx(1 / 80, rel=0.1)
    assert float(seen.coverage.min()) == 1.0
