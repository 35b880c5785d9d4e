"""Sliced Wasserstein distances and nearest neighbours of feature cells."""

import json

import pytest
import torch

from styleexp.config import build
from styleexp.config.compose import compose
from styleexp.method.cell_losses import (
    NeighbourLoss,
    SlicedLoss,
    cells_of,
    padded,
    resampled,
    sampled,
    sorting,
)
from styleexp.method.options import NeighbourConfig, SlicedConfig
from styleexp.method.targets import in_step
from styleexp.method.viewer import Images
from styleexp.plugins import load_encoder
from styleexp.system.errors import UserError
from tests.helpers import warm

SMOKE = ("profile=smoke", "encoder=vgg19_random")
pytestmark = pytest.mark.filterwarnings("ignore:the encoder 'vgg19_random'")


@pytest.fixture(scope="module")
def encoder():
    with pytest.warns(UserWarning, match="random"):
        return load_encoder("vgg19_random", precision="fp32")


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def cells(seed, count=40, channels=6):
    return torch.rand(count, channels, generator=generator(seed), dtype=torch.float64)


@pytest.fixture(params=["sliced", "neighbour"])
def loss(request, encoder):
    layers = {"layers": ["conv1_1", "conv2_1"], "cells": 512}
    if request.param == "sliced":
        return SlicedLoss(SlicedConfig(**layers), encoder)
    return NeighbourLoss(NeighbourConfig(**layers), encoder)


# -------------------------------------------------------------------------------------- the sample


def test_a_sample_holds_masked_cells_of_every_view_by_their_share():
    features = torch.arange(3 * 2 * 10 * 10.0).view(3, 2, 10, 10)
    mask = torch.zeros(3, 10, 10, dtype=torch.bool)
    mask[0], mask[1, :5] = True, True  # 100, 50 and no cells
    found = cells_of(sampled(features, mask, 30, generator()))
    assert found.shape == (30, 2)
    assert len(found.unique(dim=0)) == 30
    view = (found[:, 0] // 200).long()
    inside = features.permute(0, 2, 3, 1)[mask]
    assert all(any(torch.equal(row, cell) for cell in inside) for row in found)
    assert view.bincount(minlength=3).tolist() == pytest.approx([20, 10, 0], abs=5)

    everything = sampled(features, mask, 400, generator())
    assert everything.shape == (400, 3)
    assert not everything[150:].any()
    order = lambda rows: rows[rows[:, 0].argsort()]  # noqa: E731
    torch.testing.assert_close(order(cells_of(everything)), order(inside))


def test_a_sample_passes_the_gradient_to_the_cells_it_took():
    features = torch.rand(2, 3, 4, 5, generator=generator()).requires_grad_()
    found = sampled(features, None, 7, generator(1))
    (gradient,) = torch.autograd.grad(found[:, :-1].sum(), features)
    assert gradient.sum() == 7 * 3
    assert set(gradient.unique().tolist()) == {0.0, 1.0}


def test_an_empty_mask_gives_zeros():
    assert not sampled(torch.rand(1, 4, 8, 8), torch.zeros(1, 8, 8) > 0, 16, generator()).any()


def test_background_has_no_influence_when_masked(loss):
    coverage = torch.zeros(2, 64, 64)
    coverage[:, 16:48, 16:48] = 1
    image = torch.full((2, 64, 64, 1), 0.5)
    image[:, 16:48, 16:48] = torch.rand(2, 32, 32, 1, generator=generator())
    target = loss.describe(Images(torch.rand(2, 64, 64, 1, generator=generator(1)), coverage))
    white = torch.where(coverage[..., None] > 0, image, 1.0)
    described = [loss.describe(Images(each, coverage)) for each in (image, white)]
    assert all(each.any() for each in described[0])
    values = [loss.distance(each, target, loss.scales(target, target)) for each in described]
    torch.testing.assert_close(*values)
    for one, other in zip(*described, strict=True):
        torch.testing.assert_close(one, other)


def test_batches_are_pooled_by_equal_shares(loss):
    batch = [[torch.full((512, 5), float(i))] for i in (1, 2, 3, 4)]
    (found,) = loss.pooled(batch)
    assert found.shape == (512, 5)
    assert found[:, 0].long().bincount(minlength=5)[1:].tolist() == pytest.approx([128] * 4, abs=40)
    few = [[padded(torch.full((3, 5), 7.0), 512)], [torch.zeros(512, 5)]]
    (found,) = loss.pooled(few)
    assert (found[:3] == 7).all()
    assert not found[3:].any()


# ------------------------------------------------------------------------------------ the distances


def test_gradients_are_those_of_finite_differences(loss):
    found, goal = cells(1).requires_grad_(), cells(2, 30)
    torch.autograd.gradcheck(lambda each: loss.apart(each, goal, 0), found, atol=1e-6)


def test_equal_cells_are_no_distance_apart_and_their_order_does_not_matter(loss):
    found, goal = cells(1), cells(2, 30)
    shuffled = torch.randperm(40, generator=generator())
    assert loss.apart(found, found, 0) == 0
    assert loss.apart(found, found[shuffled], 0) == pytest.approx(0, abs=1e-12)
    apart = loss.apart(found, goal, 0)
    assert apart > 0
    torch.testing.assert_close(loss.apart(found[shuffled], goal, 0), apart)
    torch.testing.assert_close(loss.apart(found, goal.flip(0), 0), apart)


def test_equal_views_are_no_distance_apart(loss):
    seen = Images(torch.rand(2, 64, 64, 3, generator=generator()), torch.ones(2, 64, 64))
    described = loss.describe(seen)
    assert loss.distance(described, described, loss.scales(described, described)) == 0


def test_a_shift_is_found_by_every_direction(encoder):
    """W2 of a distribution and its copy moved by v is |v . direction|, on average |v|^2 / C."""
    loss = SlicedLoss(SlicedConfig(directions=4096), encoder)
    found, shift = cells(1), torch.tensor([1.0, 0, 0, 2, 0, 2], dtype=torch.float64)
    assert float(loss.apart(found, found + shift, 0)) == pytest.approx(9 / 6, rel=0.05)


def test_in_one_dimension_it_is_the_sorted_values_distance(encoder):
    loss = SlicedLoss(SlicedConfig(), encoder)
    found, goal = cells(1, channels=1), cells(2, channels=1)
    expected = (found.sort(0).values - goal.sort(0).values).square().mean()
    torch.testing.assert_close(loss.apart(found, goal, 0), expected)


def test_sorted_values_are_resampled_as_quantiles():
    ordered = torch.tensor([[0.0, 1, 2, 3]])
    assert torch.equal(resampled(ordered, 4), ordered)
    assert resampled(ordered, 2).tolist() == [[0.5, 2.5]]
    assert resampled(ordered, 8).tolist() == [[0, 0.25, 0.75, 1.25, 1.75, 2.25, 2.75, 3]]
    values = torch.rand(5, 100, generator=generator())
    assert torch.equal(values.gather(1, sorting(values)), values.sort(1).values)


def test_the_nearest_cell_is_what_counts(encoder):
    """Cells at right angles: one on the style's, one opposite to a direction it has."""
    loss = NeighbourLoss(NeighbourConfig(completeness=0.0), encoder)
    goal = torch.tensor([[1.0, 0], [-1, 0], [0, 1], [0, -1]], dtype=torch.float64)
    assert loss.apart(goal[:1] * 3, goal, 0) == 0  # whatever the length
    between = torch.tensor([[1.0, 1.0]], dtype=torch.float64)
    assert float(loss.apart(between, goal, 0)) == pytest.approx(1 - 0.5**0.5)
    both = NeighbourLoss(NeighbourConfig(completeness=1.0), encoder)
    # All of the style's cells look for the single one of the result: at 0, 90, 90 and 180 degrees.
    assert float(both.apart(goal[:1], goal, 0)) == pytest.approx((0 + (0 + 1 + 1 + 2) / 4) / 2)


def test_layers_of_weight_zero_are_not_computed(encoder):
    config = SlicedConfig(block_weights=[0, 0.5, 0, 0, 0])
    assert SlicedLoss(config, encoder).layers == ("conv2_1",)
    with pytest.raises(UserError, match=r"loss=sliced: every one .* weight zero"):
        SlicedLoss(SlicedConfig(block_weights=[0] * 5), encoder)


# ------------------------------------------------------------------------------------------ in runs


def test_a_step_draws_anew_and_a_seed_the_same(loss):
    before = torch.get_rng_state()
    one, same, later, other = (
        in_step(loss, seed, step) for seed, step in ((0, 5), (0, 5), (0, 6), (1, 5))
    )
    assert one.seed == same.seed
    assert len({loss.seed, one.seed, later.seed, other.seed}) == 4
    assert torch.equal(torch.get_rng_state(), before)
    if isinstance(loss, SlicedLoss):
        assert torch.equal(one.directions(6, 1), same.directions(6, 1))
        assert not torch.equal(one.directions(6, 1), later.directions(6, 1))
        assert not torch.equal(one.directions(6, 1), one.directions(6, 0))
        norms = one.directions(6, 0).norm(dim=0)
        torch.testing.assert_close(norms, torch.ones_like(norms))


@pytest.mark.parametrize(
    ("name", "preset", "start"),
    [("sliced", "paper_amended", "synthesis"), ("neighbour", "robust", "map")],
)
def test_every_start_and_target_works_and_the_same_seed_gives_the_same_steps(
    name, preset, start, coarse_shapes
):
    def steps():
        method, scene = build.prepare(
            compose(
                [
                    *SMOKE,
                    f"method={preset}",
                    f"loss={name}",
                    "source=sphere",
                    "style=bubble",
                    f"field.start={start}",
                    "optim.steps=2",
                ]
            )
        )
        state = method.start(scene)
        return [step.loss for step in method.optimise(scene, state)]

    first = steps()
    assert first == steps()
    assert all(0 < value < 1e3 for value in first)


@pytest.mark.parametrize("name", ["sliced", "neighbour"])
def test_a_picture_is_a_style_too(name):
    from styleexp.inputs.style import Style
    from styleexp.method.subject import measure

    config = compose([*SMOKE, "method=robust", f"loss={name}", "source=sphere", "optim.steps=1"])
    method = build.method_of(config)
    picture = torch.rand(64, 64, 3, generator=generator()).numpy()
    from styleexp.config import sources

    source = sources.load_source(config.source)
    subject = measure(config, source, Style.of(picture), torch.device("cpu"))
    scene = method.prepare(subject)
    (step,) = method.optimise(scene, method.start(scene))
    assert step.loss > 0


@pytest.mark.parametrize("name", ["sliced", "neighbour"])
def test_a_resumed_run_gives_the_same_bits(tmp_path, name):
    arguments = ["method=robust", f"loss={name}", "source=torus", "style=bubble", *SMOKE]
    done = warm.run(
        "-m", "styleexp", *arguments, "hydra.run.dir=whole", cwd=tmp_path, env=warm.coarse()
    )
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "whole"
    steps = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert [each["step"] for each in steps] == [1, 2, 3, 4]
    (folder / "checkpoint.previous.safetensors").replace(folder / "checkpoint.safetensors")
    before = (folder / "result.ply").read_bytes()
    (folder / "result.ply").unlink()
    done = warm.run("-m", "styleexp", "resume=whole", cwd=tmp_path, env=warm.coarse())
    assert "resuming at step" in done.stdout, done.stderr
    assert (folder / "result.ply").read_bytes() == before
