"""Numbers that go wrong stop a run at once: the step, the part, the last good checkpoint."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest
import torch

from styleexp.config.build import prepare
from styleexp.config.checks import check
from styleexp.config.compose import compose
from styleexp.experiments import execute as command
from styleexp.method.base import Diverged
from styleexp.method.viewer import Images
from styleexp.system.errors import UserError

SMOKE = (
    "method=robust",
    "profile=smoke",
    "encoder=vgg19_random",
    "style=bubble",
    "optim.checkpoint_every=1",
)
pytestmark = pytest.mark.filterwarnings("ignore:the encoder 'vgg19_random'")


@pytest.fixture(scope="module")
def prepared():
    return prepare(compose([*SMOKE, "source=torus", "optim.steps=3"]))


@pytest.fixture
def method(prepared):
    return prepared[0]


@pytest.fixture
def scene(prepared):
    return prepared[1]


def spoil(scene, part):
    """A scene in which, from step 1 on, that part of a step is not a number."""
    calls = iter(range(100))

    def later(value):
        return value * math.nan if next(calls) >= 1 else value

    class Spoilt:
        def __getattr__(self, name):
            return getattr(scene.loss if part.startswith("loss") else scene.viewer, name)

        def __call__(self, vertices, step):
            whole, local = scene.viewer(vertices, step)
            if part == "local views":
                local = dataclasses.replace(local, image=later(local.image))
            return whole, local

        def for_step(self, generator):
            return self

        def distance(self, grams, target, scales):
            value = scene.loss.distance(grams, target, scales)
            return later(value) if grams[0].requires_grad else value

    if part == "local views":
        return dataclasses.replace(scene, viewer=Spoilt())
    return dataclasses.replace(scene, loss=Spoilt())


@pytest.mark.parametrize(
    ("part", "named"),
    [("local views", "the local views became"), ("loss", "the loss of the local views became")],
)
def test_what_is_not_a_number_is_named_with_its_step(method, scene, part, named):
    broken = spoil(scene, part)
    state = method.start(broken)
    with pytest.raises(Diverged, match=f"^{named} NaN or infinite at step") as caught:
        list(method.optimise(broken, state))
    assert caught.value.step == state.step + 1
    assert all(p.isfinite().all() for p in state.field.parameters())


def test_a_gradient_that_is_not_a_number_never_reaches_the_field(method, scene):
    state = method.start(scene)
    weights = [p.clone() for p in state.field.parameters()]
    state.field.last.weight.register_hook(lambda grad: grad * math.inf)
    with pytest.raises(Diverged, match="the gradient became NaN or infinite at step 1"):
        list(method.optimise(scene, state))
    for before, after in zip(weights, state.field.parameters(), strict=True):
        assert torch.equal(before, after)


def test_an_exploding_loss_stops(method, scene):
    tiny = [torch.full_like(scale, 1e-12) for scale in scene.scales[1]]
    state = method.start(scene)
    steps = method.optimise(scene, state)
    next(steps)
    for scale, small in zip(scene.scales[1], tiny, strict=True):
        scale.copy_(small)
    try:
        with pytest.raises(Diverged, match=r"the loss exploded, from .* at step 2"):
            list(steps)
    finally:
        for scale in scene.scales[1]:
            scale.fill_(1.0)


def test_the_command_names_the_last_good_checkpoint(tmp_path, monkeypatch):
    """Through the run itself: its error, its status, and a checkpoint that holds numbers."""
    from styleexp.method.losses import GramLoss

    real, calls = GramLoss.distance, iter(range(100))

    def distance(self, grams, target, scales):
        value = real(self, grams, target, scales)
        return value * math.nan if next(calls) >= 4 else value  # two a step

    monkeypatch.setattr(GramLoss, "distance", distance)
    config = compose([*SMOKE, "source=torus"])
    with pytest.raises(UserError) as caught:
        command.run(config, tmp_path / "run", [])
    checkpoint = tmp_path / "run" / "checkpoint.safetensors"
    told = str(caught.value)
    assert "the loss of the global views became NaN or infinite at step 3" in told
    assert f"The last good checkpoint is from step 2: {checkpoint}." in told
    status = json.loads((tmp_path / "run" / "status.json").read_text())
    assert (status["status"], status["reason"]) == ("failed", told)
    from safetensors.numpy import load_file

    assert all(np.isfinite(values).all() for values in load_file(checkpoint).values())


def test_views_that_show_nothing_are_counted():
    coverage = torch.zeros(3, 8, 8)
    coverage[1, 2, 2] = 0.5
    assert Images(torch.ones(3, 8, 8, 1), coverage).blank() == 2


def test_blank_views_are_counted_step_by_step_and_change_nothing(method, scene):
    """A view that shows nothing has no cell in the Gram matrices: they are those of the others."""
    whole, _ = scene.viewer(scene.subject.surface.vertices, 0)
    empty = Images(
        torch.cat([whole.image, torch.rand_like(whole.image[:1])]),
        torch.cat([whole.coverage, torch.zeros_like(whole.coverage[:1])]),
    )
    for alone, among in zip(scene.loss.describe(whole), scene.loss.describe(empty), strict=True):
        torch.testing.assert_close(alone, among, rtol=1e-4, atol=1e-7)
    steps = list(method.optimise(scene, method.start(scene)))
    assert [step.blank_views for step in steps] == [0, 0, 0]


def test_a_mesh_that_no_view_sees_is_told_before_the_run():
    with pytest.raises(UserError, match="the views don't see"):
        prepare(compose([*SMOKE, "source=torus", "views.distance=900", "views.local.mode=image"]))


@pytest.mark.parametrize(
    "override",
    ["strength=nan", "optim.rate=inf", "views.elevation=nan", "loss.lambda_global=inf",
     "loss.block_weights=[1,1,nan,1,1]", "views.count=1000000", "style.scale=1e9"],
)  # fmt: skip
def test_numbers_without_meaning_are_refused(override):
    with pytest.raises(UserError, match=override.split("=")[0]):
        check(compose([*SMOKE, "source=torus", override]))
