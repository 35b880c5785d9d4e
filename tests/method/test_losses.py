import copy

import numpy as np
import pytest
import torch
from torch.nn import functional

from styleexp.encoders import VGG
from styleexp.inputs import shapes
from styleexp.inputs.style import Style
from styleexp.method.losses import UNDIVIDED, GramLoss, gram_matrix, layer_mask, layer_masks
from styleexp.method.options import LossConfig
from styleexp.method.viewer import Images
from styleexp.plugins import load_encoder


def test_gram_is_the_normalised_product_averaged_over_views():
    features = torch.rand(3, 4, 5, 6)
    expected = sum(f.reshape(4, 30) @ f.reshape(4, 30).T for f in features) / (3 * 30 * 4)
    torch.testing.assert_close(gram_matrix(features), expected)


def test_masked_gram_sees_the_foreground_alone_and_not_how_large_it_is():
    features = torch.rand(1, 4, 8, 8)
    mask = torch.zeros(1, 8, 8, dtype=torch.bool)
    mask[:, 2:5, 3:7] = True
    masked = gram_matrix(features, mask)
    torch.testing.assert_close(masked, gram_matrix(features[:, :, 2:5, 3:7]))
    features[:, :, 7, 7] = 100.0
    torch.testing.assert_close(gram_matrix(features, mask), masked)


def test_gram_is_divided_as_asked():
    features, mask = torch.rand(3, 4, 5, 6), torch.rand(3, 5, 6) < 0.5
    product = torch.einsum("vchw,vdhw,vhw->cd", features, features, mask.float())
    for how, divisor in (
        ("none", UNDIVIDED),
        ("cells", mask.sum()),
        ("channels_cells", 4 * mask.sum()),
        ("mean", 16 * mask.sum()),
    ):
        torch.testing.assert_close(gram_matrix(features, mask, how), product / divisor)


def test_empty_mask_gives_zeros_not_nan():
    mask = torch.zeros(1, 8, 8, dtype=torch.bool)
    assert (gram_matrix(torch.rand(1, 4, 8, 8), mask) == 0).all()


def test_mask_keeps_whole_cells_and_erodes_from_holes_but_not_from_the_frame():
    coverage = torch.ones(1, 32, 32)
    coverage[0, 16, 0] = 0.4  # one half-covered pixel
    whole = layer_mask(coverage, (8, 8), 0)
    assert whole.sum() == 63
    assert not whole[0, 4, 0]
    eroded = layer_mask(coverage, (8, 8), 1)
    assert eroded.sum() == 64 - 6
    assert eroded[0, 0, 7]


@pytest.mark.parametrize("erosion", [0, 1, 3, 40])
@pytest.mark.parametrize(("height", "width"), [(64, 64), (97, 50), (31, 125)])
def test_masks_are_those_that_pooling_gives(height, width, erosion):
    generator = torch.Generator().manual_seed(height)
    coarse = torch.rand(3, 1, 6, 5, generator=generator)
    coverage = functional.interpolate(coarse, (height, width), mode="bilinear")[:, 0]
    coverage[2, 3, 4] = torch.nan  # foreground is what is known to be
    shapes = [(height // stride, width // stride) for stride in (1, 2, 4, 8, 16)]
    for shape, found in zip(shapes, layer_masks(coverage, shapes, erosion), strict=True):
        hole = functional.adaptive_max_pool2d((1 - coverage.nan_to_num(0))[:, None], shape)
        hole = functional.max_pool2d(hole, 2 * erosion + 1, stride=1, padding=erosion)
        assert torch.equal(found, hole[:, 0] < 0.5)


def grams(loss, image, coverage=None):
    """Grams of images, by default covered everywhere."""
    coverage = torch.ones_like(image[..., 0]) if coverage is None else coverage
    return loss.describe(Images(image, coverage))


@pytest.fixture(scope="module")
def encoder():
    with pytest.warns(UserWarning, match="random"):
        return load_encoder("vgg19_random", precision="fp32")


def test_the_papers_layers_by_index_and_by_name_are_the_same(encoder):
    by_index = GramLoss(LossConfig(layers=[1, 3, 5, 9, 13]), encoder)
    by_name = GramLoss(LossConfig(), encoder)
    assert by_index.layers == by_name.layers


def test_an_encoder_that_serves_other_activations_is_asked_for_them(encoder):
    class Doubled(VGG):
        def forward(self, images, layers):
            return {name: 2 * found for name, found in super().forward(images, layers).items()}

    other = copy.copy(encoder)
    other.__class__ = Doubled
    images, disc = torch.rand(2, 64, 64, 1), torch.zeros(2, 64, 64)
    disc[:, 5:60, 9:] = 1
    for config in (LossConfig(masked=False), LossConfig(erosion=0)):
        ours, theirs = (grams(GramLoss(config, each), images, disc) for each in (encoder, other))
        for single, doubled in zip(ours, theirs, strict=True):
            assert single.any()
            torch.testing.assert_close(4 * single, doubled, rtol=1e-4, atol=1e-5)


def test_distance_is_zero_at_the_target_and_weights_blocks(encoder):
    images = torch.rand(2, 64, 64, 1)
    loss = GramLoss(LossConfig(relative="none", block_weights=[1, 0, 0, 0, 0]), encoder)
    own, other = grams(loss, images), grams(loss, images.square())
    scales = loss.scales(own, other)
    assert loss.distance(own, own, scales) == 0
    first_layer = (own[0] - other[0]).square().sum()
    torch.testing.assert_close(loss.distance(other, own, scales), first_layer)


def test_relative_to_the_source_starts_every_layer_at_one(encoder):
    images = torch.rand(2, 64, 64, 1)
    loss = GramLoss(LossConfig(relative="source", block_weights=[1] * 5), encoder)
    target, source = grams(loss, images), grams(loss, 1 - images * 0.5)
    scales = loss.scales(target, source)
    assert loss.distance(source, target, scales) == pytest.approx(5.0, rel=1e-4)


def test_background_does_not_matter_when_masked(encoder):
    """The outline's influence must not reach past the erosion at the shallow layers."""
    images = torch.full((1, 64, 64, 1), 0.5)
    images[:, 16:48, 16:48] = torch.rand(32, 32, 1)
    coverage = torch.zeros(1, 64, 64)
    coverage[:, 16:48, 16:48] = 1
    white = images.clone()
    white[coverage == 0] = 1.0
    loss = GramLoss(LossConfig(layers=["conv1_1", "conv2_1"], erosion=2), encoder)
    for a, b in zip(grams(loss, images, coverage), grams(loss, white, coverage), strict=True):
        torch.testing.assert_close(a, b)


def test_a_layer_whose_target_is_empty_does_not_count(encoder):
    images = torch.rand(1, 64, 64, 1)
    dot = torch.zeros(1, 64, 64)
    dot[:, 20:44, 20:44] = 1  # no cell of conv5_1 is wholly inside
    loss = GramLoss(LossConfig(block_weights=[0, 0, 0, 0, 1]), encoder)
    target, source = grams(loss, images, dot), grams(loss, images * 0.5)
    assert target[4].abs().sum() == 0
    assert loss.distance(source, target, loss.scales(target, source)) == 0


@pytest.mark.parametrize(
    ("masked", "mesh", "picture"),
    [(True, True, True), (1, True, True), (False, False, False), ("pictures", False, True)],
)
def test_what_is_masked_is_decided_by_the_style(encoder, masked, mesh, picture):
    loss = GramLoss(LossConfig(masked=masked), encoder)
    assert loss.for_style(Style.of(shapes.make("sphere", 100))).masked == mesh
    assert loss.for_style(Style.of(np.zeros((8, 8, 3), np.float32))).masked == picture
