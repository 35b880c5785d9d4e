"""Every kind of part: ours and the guides' keep its contract, and what breaks it is found."""

import functools
import importlib.util
import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

from styleexp import plugins, testing
from styleexp.encoders import Encoder
from styleexp.inputs import meshes, shapes
from styleexp.method.base import Method, displaced
from styleexp.method.fields import Field, check_field
from styleexp.method.losses import GramLoss, Loss
from styleexp.method.options import (
    FieldConfig,
    LossConfig,
    NeighbourConfig,
    SlicedConfig,
    VertexConfig,
)
from styleexp.method.paper import PaperLoop
from styleexp.method.scene import Parts
from styleexp.method.stepping import gradient_norm
from styleexp.plugins.catalogue import BASELINES, FIELDS
from styleexp.renderers.soft_raster import SoftRaster
from styleexp.system import options as limits
from styleexp.system.errors import UserError
from styleexp.system.options import option
from styleexp.testing import encoders, fields, losses, methods, styles

DOCS = Path(__file__).resolve().parents[2] / "docs"
pytestmark = pytest.mark.filterwarnings("ignore:the encoder 'vgg19_random'")


@pytest.fixture(scope="module")
def encoder():
    return plugins.load_encoder("vgg19_random", precision="fp32")


def guide(page, folder, number=0):
    """The module that a guide's page has one write."""
    code = re.findall(r"```python\n(.*?)```", (DOCS / page).read_text(), re.DOTALL)[number]
    path = folder / f"{page.removesuffix('.md').replace('-', '_')}_{number}.py"
    path.write_text(code)
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


# --------------------------------------------------------------------------------- ours, and guides


def test_the_builtin_encoder(encoder):
    found = testing.check_encoder(encoder, ["conv1_1", "conv3_1"])
    assert set(found.values()) == {"passed"}


@pytest.mark.parametrize("masked", [True, False])
def test_the_gram_loss(encoder, masked):
    assert testing.check_loss(GramLoss(LossConfig(masked=masked), encoder))


@pytest.mark.parametrize("masked", [True, False])
@pytest.mark.parametrize("config", [SlicedConfig, NeighbourConfig])
def test_the_losses_of_cells(encoder, config, masked):
    loss = plugins.build("loss", config(masked=masked, cells=1024), encoder=encoder)
    assert set(testing.check_loss(loss).values()) == {"passed"}


@pytest.mark.parametrize("name", FIELDS)
def test_the_builtin_fields(name):
    build = functools.partial(plugins.build, "field", FIELDS[name].config(name=name))
    assert set(testing.check_field(build).values()) == {"passed"}


def test_the_vertex_field_with_large_steps():
    build = functools.partial(plugins.build, "field", VertexConfig(smoothness=5.0))
    assert set(testing.check_field(build).values()) == {"passed"}


@pytest.mark.parametrize("name", [*shapes.STYLES])
def test_the_analytic_styles(name):
    testing.check_style(shapes.make(name, 1500))


@pytest.mark.parametrize("name", BASELINES)
def test_the_builtin_methods(name):
    options = BASELINES[name].config(name=name)
    if name == "synthesis":
        options.bank = 500
    if name == "geometric_textures":
        options.iterations, options.base, options.levels = 1, 100, 2
    testing.check_method(lambda: plugins.build("baseline", options))


def test_the_papers_loop(encoder):
    def make():
        loss = GramLoss(LossConfig(layers=["conv1_1", "conv2_1"], bank_views=2), encoder)
        parts = Parts(SoftRaster(), encoder, loss)
        return PaperLoop(parts, functools.partial(plugins.build, "field", FieldConfig()))

    found = testing.check_method(make)
    assert set(found.values()) == {"passed"}


def test_the_guides_loss(encoder, tmp_path):
    module = guide("own-loss.md", tmp_path)
    assert testing.check_loss(module.build(module.Options(), encoder=encoder))
    assert module.MOMENTS.config is module.Options


def test_the_guides_field(tmp_path):
    module = guide("own-field.md", tmp_path)
    assert testing.check_field(functools.partial(module.build, module.Options()))


def test_the_guides_encoder(monkeypatch, tmp_path):
    from styleexp.encoders import vgg
    from styleexp.inputs import weights

    random = vgg.random_weights((1, 1, 1), 0)
    monkeypatch.setattr(weights, "read", lambda path: random)
    monkeypatch.setattr("styleexp.inputs.assets.find", lambda name, kind: None)
    module = guide("own-encoder.md", tmp_path)
    made = module.build(module.Options(precision="fp32"), device="cpu", seed=0)
    assert made.pooling == "avg"
    testing.check_encoder(made, ["conv1_1", "conv3_1"])


def test_the_guides_method(tmp_path):
    module = guide("baselines.md", tmp_path)
    testing.check_method(lambda: module.build(module.Options()))


def test_the_guides_renderer_acts_in_a_run(encoder, tmp_path):
    """Its hook shortens the gradients that reach the field."""
    module = guide("write-a-backend.md", tmp_path)
    norms = {}
    for limit in (1e3, 1e-9):
        loss = GramLoss(LossConfig(layers=["conv1_1"], bank_views=2), encoder)
        parts = Parts(module.GENTLE.factory(module.Options(limit=limit)), encoder, loss)
        method = PaperLoop(parts, functools.partial(plugins.build, "field", FieldConfig()))
        settings = methods._settings()
        settings.loss.relief_weight, settings.optim.unit_gradient = 0.0, False
        scene = methods._prepared(method, settings)
        state = method.start(scene)
        next(method.optimise(scene, state))
        norms[limit] = float(gradient_norm(state.field))
    assert 0 < norms[1e-9] < 1e-3 * norms[1e3]


# ------------------------------------------------------------------------------------- what breaks


def broken(check, part, told):
    with pytest.raises(AssertionError, match=told):
        check(part)


class Unmasked(Loss):
    """The mean of what is covered: 0 / 0 where nothing is."""

    def describe(self, seen):
        inside = (seen.image * seen.coverage[..., None]).sum((0, 1, 2))
        return [inside / seen.coverage.sum()]

    def distance(self, found, target, scales):
        return (found[0] - target[0]).square().sum()


class Remembering(GramLoss):
    """Each description is a little larger than the one before."""

    calls = 0

    def describe(self, seen):
        self.calls += 1
        return [self.calls * each for each in super().describe(seen)]


class Uphill(GramLoss):
    def distance(self, found, target, scales):
        return 1 / (super().distance(found, target, scales) + 1)


def test_losses_that_break_the_contract_are_found(encoder):
    config = LossConfig(layers=["conv1_1", "conv2_1"])
    broken(testing.check_loss, Unmasked(), "images_that_show_nothing_do_no_harm")
    broken(testing.check_loss, Unmasked(), "statistics_keep_their_shapes")  # grey and colour differ
    broken(
        testing.check_loss,
        Remembering(config, encoder),
        "the_same_images_give_the_same_numbers",
    )
    broken(testing.check_loss, Uphill(config, encoder), "equal_statistics_are_no_distance_apart")


def field(forward, parameter=True):
    class Made(Field):
        def __init__(self, points):
            super().__init__()
            self.latent = torch.nn.Parameter(torch.zeros(len(points)))
            self.calls = 0

        def forward(self, points, opened=1.0, precision=torch.float32):
            self.calls += 1
            return forward(self, points, precision)

    return lambda points, generator, sigma, bound: Made(points)


@pytest.mark.parametrize(
    ("forward", "told"),
    [
        (lambda self, points, precision: self.latent, "it_keeps_its_bound"),
        (lambda self, points, precision: 0.1 * self.latent.tanh().to(precision), "bfloat16"),
        (lambda self, points, precision: 0.1 * self.latent[:, None].tanh(), "shape"),
        (lambda self, points, precision: 0.1 * self.latent.detach().tanh(), "it_learns"),
        (
            lambda self, points, precision: 0.1 * (self.latent + 1e-3 * self.calls).tanh(),
            "a_checkpoint_brings_it_back",
        ),
    ],
)
def test_fields_that_break_the_contract_are_found(forward, told):
    broken(testing.check_field, field(forward), told)


def test_a_field_that_draws_from_the_global_generator_is_found():
    class Loose(Field):
        def __init__(self):
            super().__init__()
            self.latent = torch.nn.Parameter(torch.rand(300))

        def forward(self, points, opened=1.0, precision=torch.float32):
            return 0.1 * self.latent.tanh()

    broken(fields.equal_generators_make_equal_fields, lambda **given: Loose(), "global generator")


class Sloppy(Encoder):
    """One layer, which is the image itself, scaled by the batch's brightest pixel."""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.ones(()))

    def resolve(self, layers):
        return tuple(map(str, layers))

    def forward(self, images, layers):
        images = images.expand(-1, 3, -1, -1)
        images = images / images.amax(dim=(2, 3)).cumsum(0).flip(0)[:, :, None, None]
        return {str(layer): self.weight * images.double() for layer in layers}


def test_an_encoder_that_breaks_the_contract_is_found():
    asked = encoders.Asked(Sloppy(), ["all"])
    for check, told in (
        (encoders.unknown_layers_are_refused, "is accepted"),
        (encoders.it_is_frozen_and_gradients_reach_the_images, "it would be trained"),
        (encoders.images_do_not_mix, "not close"),
        (encoders.its_precision_is_what_it_says, "float64"),
    ):
        broken(check, asked, told)


def test_styles_that_break_the_contract_are_found():
    ball = shapes.make("sphere", 500)
    inside_out = meshes.Mesh("ball", ball.vertices, ball.faces[:, ::-1])
    broken(styles.a_mesh_is_sound, inside_out, "clockwise")
    twice = meshes.Mesh("ball", ball.vertices, np.vstack([ball.faces, [[0, 0, 1]]]))
    broken(styles.a_mesh_is_sound, twice, "without area")
    broken(styles.a_mesh_or_a_picture, np.zeros((8, 8)), "shape")
    broken(styles.a_mesh_or_a_picture, np.full((8, 8, 3), 255, np.uint8), "not floats")
    broken(styles.a_picture_has_contrast, np.full((8, 8, 3), 0.5), "one tone")


class Inflate(Method):
    """Forgets strength and mask, and draws from the global generator."""

    def finish(self, scene, state):
        height = 0.01 * torch.rand(len(scene.subject.areas))
        return displaced(scene.subject, height)


def test_a_method_that_breaks_the_contract_is_found():
    for check in (
        methods.equal_seeds_give_equal_results,
        methods.no_strength_is_no_displacement,
        methods.nothing_moves_outside_the_mask,
    ):
        with pytest.raises(AssertionError):
            check(Inflate)


def test_all_failed_checks_are_listed():
    def fine(part):
        pass

    def one(part):
        raise ValueError("the first")

    def other(part):
        raise AssertionError("the second")

    from styleexp.testing import checks

    with pytest.raises(
        AssertionError, match="2 of 3 checks failed:\none: ValueError: the first\nother"
    ):
        checks.run([fine, one, other], None)
    assert losses.images(0).image.shape == (2, losses.SIZE, losses.SIZE, 3)


def test_a_field_that_breaks_its_contract_stops_a_run_before_its_first_step():
    at = fields.points()
    for forward, message in (
        (lambda self, points, precision: self.latent[:, None], "shape"),
        (lambda self, points, precision: self.latent.double(), "float64"),
        (lambda self, points, precision: self.latent + 5, "beyond its bound of 0.1"),
    ):
        made = field(forward)(points=at, generator=None, sigma=5.0, bound=0.1)
        with pytest.raises(UserError, match=message):
            check_field(made, at, 0.1)


def test_options_have_limits_of_their_own():
    @dataclass
    class Inner:
        share: float = option(0.5, above=0, between=(0, 1))

    @dataclass
    class Options:
        kind: str | None = option(None, choices=("a", "b"))
        sizes: list[float] = option(factory=lambda: [1.0, 2.0], between=(0, 5))
        ways: list[str] = option(factory=list, choices=("up", "down"))
        inner: Inner = option(factory=Inner)

    limits.check(Options())
    limits.check(Options(ways=["down", "up"]))
    for options, message in (
        (Options(kind="c"), "unknown value for kind 'c'"),
        (Options(ways=["up", "left"]), "unknown value for ways 'left'"),
        (Options(sizes=[1.0, 9.0]), r"sizes=\[1.0, 9.0\] is not allowed: give a value from 0 to 5"),
        (Options(sizes=[math.nan]), "sizes=nan is not allowed: give a finite number"),
        (Options(inner=Inner(0.0)), "inner.share=0.0 is not allowed: give a value above 0"),
        (Options(inner=Inner(2.0)), "inner.share=2.0 is not allowed: give a value from 0 to 1"),
    ):
        with pytest.raises(UserError, match=message):
            limits.check(options)
