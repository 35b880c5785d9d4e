"""Likeness to a style, where the answer is known by construction, and the words about it."""

import numpy as np
import pytest
import torch

from styleexp.experiments import ratings
from styleexp.experiments.metrics.likeness import (
    Likeness,
    bank_of,
    like_noise,
    likeness,
    nearest,
    unit_slopes,
)
from styleexp.experiments.metrics.truth import noise
from styleexp.inputs import meshes, shapes
from styleexp.method.patches import Relief
from styleexp.method.synthesis.shape import exemplar_of


@pytest.fixture(scope="module")
def bank():
    return bank_of(exemplar_of(shapes.make("bubble", 10_000)))


@pytest.fixture(scope="module")
def ball():
    """A smooth ball, and the heights of bubbles that aren't the style's own on it."""
    mesh = shapes.make("sphere", 10_000)
    base = meshes.normalisation(mesh.vertices).apply(mesh.vertices)
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    height = shapes.relief("bubble", base @ turn)
    return base, mesh.faces, height - height.mean()


def carried(bank, ball, height, unit=1.0):
    base, faces, _ = ball
    return float(likeness(bank, Relief(base, faces, height), unit).carried.mean())


def test_the_style_itself_is_alike_and_nothing_else_is(bank, ball):
    base, _, height = ball
    own = carried(bank, ball, height)
    assert own > 0.8
    random = height.std() * noise(base, 1 / bank.wavelength, np.random.default_rng(2))
    other = shapes.relief("stripe", base)
    for wrong in (random, -height, other - other.mean()):
        assert carried(bank, ball, wrong) < 0.35 * own
    assert carried(bank, ball, np.zeros(len(base))) == 0
    assert bank.order > 0.8


def test_the_height_counts_little_and_a_bend_nothing(bank, ball):
    base, _, height = ball
    own = carried(bank, ball, height)
    assert carried(bank, ball, height + 0.3 + 0.1 * base[:, 0]) == pytest.approx(own, abs=0.02)
    assert carried(bank, ball, 0.5 * height) == pytest.approx(own * 0.5**0.25, abs=0.1)
    assert carried(bank, ball, 2 * height) == pytest.approx(own, abs=0.02)


def test_size_counts(bank, ball):
    assert carried(bank, ball, ball[2], unit=2.0) < 0.5 * carried(bank, ball, ball[2])


def test_a_half_covered_surface_is_told_by_its_regions(bank, ball):
    base, faces, height = ball
    local = likeness(bank, Relief(base, faces, height * (base[:, 1] < 0)), 1.0)
    assert local.coverage == pytest.approx(0.5, abs=0.12)
    regions = local.by_region()
    assert regions["bottom"] > 0.8
    assert regions["top"] < 0.1
    assert set(regions) == set(ratings.REGIONS)
    asked = (base[:, 1] < 0).astype(float)
    masked = likeness(bank, Relief(base, faces, height * asked), 1.0, mask=asked)
    assert masked.coverage > 0.8
    assert masked.points[:, 1].max() < 0


def test_same_seed_same_numbers(bank, ball):
    base, faces, height = ball
    relief = Relief(base, faces, height)
    first, again, other = (likeness(bank, relief, 1.0, seed) for seed in (0, 0, 1))
    assert np.array_equal(first.alike, again.alike)
    assert not np.array_equal(first.points, other.points)


def test_noise_keeps_the_spectrum_and_loses_the_pattern():
    x = torch.linspace(0, 6 * np.pi, 16)[:-1]
    patches = (torch.sin(x)[None, :, None] * torch.sin(x)[None, None]).repeat(4, 1, 1)
    random = like_noise(patches)
    spectra = [torch.fft.fft2(each).abs() for each in (patches, random)]
    assert torch.allclose(*spectra, atol=1e-4)
    assert nearest(unit_slopes(random), unit_slopes(patches)).max() < 0.9


def test_slopes_ignore_level_and_height():
    patches = torch.randn(3, 9, 9)
    assert torch.allclose(unit_slopes(patches), unit_slopes(2 * patches + 5), atol=1e-5)
    assert unit_slopes(torch.zeros(1, 9, 9)).isfinite().all()


def test_carried_needs_likeness_and_height():
    local = Likeness(np.zeros((3, 3)), np.array([1.0, 1.0, 0.0]), np.array([1.0, 1 / 16, 9.0]))
    assert local.carried.tolist() == [1.0, 0.5, 0.0]


# --------------------------------------------------------------------------------------- verdicts


def found(**more):
    regions = {f"coverage_{name}": 0.6 for name in ratings.REGIONS}
    return {"match": 3.14, "craft": 4.2, "coverage": 0.64, "order": 1.0} | regions | more


def test_verdict_names_what_is_bare():
    assert ratings.verdict(found()) == (
        "carries the style on 64 % of the surface; match about 3.1 of 5, craft about 4.2 of 5"
    )
    assert ratings.verdict(found(coverage_outer=0.31)) == (
        "carries the style on 64 % of the surface, on 31 % of the outer parts; match about 3.1 "
        "of 5, craft about 4.2 of 5"
    )
    # Where a style is like noise, nothing can be said of where it is.
    assert ratings.verdict(found(order=0.1)) == "match about 3.1 of 5, craft about 4.2 of 5"
    assert ratings.verdict(found(masked=0.3)).startswith(
        "carries the style on 64 % of the part that style.mask selects; match"
    )
    no_judge = found()
    del no_judge["match"]
    assert ratings.verdict(no_judge) == (
        "carries the style on 64 % of the surface, craft about 4.2 of 5"
    )
    assert ratings.verdict({"craft": 4.0}) == "craft about 4.0 of 5"
    assert ratings.verdict({"style_distance": 0.2}) is None


def measures(**changed):
    good = {"likeness": 0.5, "order": 1.0, "relief_distance": 1.0, "style_distance": 0.3}
    return good | changed


def test_estimates_fall_where_they_should_and_stay_on_the_scale():
    good = ratings.match(measures())
    for worse in ({"likeness": 0.1}, {"style_distance": 0.6}):
        assert ratings.match(measures(**worse)) < good
    assert ratings.craft(0.99, 0.1) > ratings.craft(0.9, 0.1) > ratings.craft(0.9, 0.8)
    bare = measures(likeness=0.0, style_distance=2.0)
    for extreme in (ratings.craft(1.0, 0.0), ratings.craft(0.0, 2.0), ratings.match(bare)):
        assert 1 <= extreme <= 5


def test_a_style_without_order_is_known_by_its_statistics():
    ordered = [measures(relief_distance=x) for x in (0.1, 2.0)]
    assert ratings.pattern(ordered[0]) == ratings.pattern(ordered[1])
    gravel = [measures(order=0.0, relief_distance=x) for x in (0.1, 2.0)]
    assert ratings.pattern(gravel[0]) > 2 * ratings.pattern(gravel[1])
