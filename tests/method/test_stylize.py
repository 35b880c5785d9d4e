"""The whole pipeline on small shapes, with random weights where the style doesn't matter."""

import dataclasses
import itertools

import numpy as np
import pytest
import torch
from PIL import Image

import styleexp
from styleexp.config.build import choose_device, prepare
from styleexp.config.compose import compose
from styleexp.method.options import OptimConfig
from styleexp.method.stepping import gradient_norm, learning_rate, normalise_gradient
from styleexp.system.errors import UserError

SMOKE = ("method=robust", "profile=smoke", "encoder=vgg19_random")
pytestmark = pytest.mark.filterwarnings("ignore:the encoder 'vgg19_random'")


def run(*overrides):
    method, scene = prepare(compose([*SMOKE, *overrides]))
    state = method.start(scene)
    steps = list(method.optimise(scene, state))
    return method.finish(scene, state), steps


def test_robust_and_paper_run_and_displace_along_the_normals():
    for method in ("robust", "paper"):
        result, steps = run("source=sphere", "style=stripe", f"method={method}")
        assert [s.step for s in steps] == [1, 2, 3, 4]
        assert np.isfinite(result.vertices).all()
        moved = result.vertices - result.subject.source.vertices
        assert np.abs(result.displacement).max() > 0
        normals = result.subject.surface.normals.numpy()
        np.testing.assert_allclose(moved, result.displacement[:, None] * normals, atol=1e-6)
        assert np.abs(result.displacement).max() <= 0.1 * result.subject.frame.scale


def viewed(*overrides):
    _, scene = prepare(
        compose([*SMOKE, "source=sphere", "style=bubble", "method=paper", *overrides])
    )
    return scene, scene.viewer(scene.subject.surface.vertices, 0)


def test_a_perspective_brings_in_the_background_unless_a_fill_is_given():
    for fill, grey in (("null", 0.7), ("0.2", 0.2)):
        _, (whole, _) = viewed(
            "shading.background=0.7",
            f"views.perspective_fill={fill}",
            "views.perspective_probability=1",
        )
        assert whole.image[:, 0, 0].min() == pytest.approx(grey, abs=1e-4)
        assert whole.coverage[:, 0, 0].max() < 1e-4


def test_a_perspective_before_the_crop_is_that_of_the_whole_view():
    crops = "views.local.share=1", "views.local.size=64", "views.perspective_probability=1"
    for when in ("before", "after"):
        _, (whole, local) = viewed(*crops, f"views.local.perspective={when}")
        assert torch.allclose(local.image, whole.image, atol=1e-5) == (when == "before")


def test_a_light_in_the_camera_shows_a_sphere_alike_from_all_sides():
    for frame in ("camera", "world"):
        _, (whole, _) = viewed(
            f"shading.light_frame={frame}", "views.perspective=0", "shading.normals=smooth"
        )
        first, second = whole.image[:, 16:48, 16:48]
        assert ((first - second).abs().max() < 0.02) == (frame == "camera")


def test_the_style_can_be_seen_at_views_of_its_own():
    (same, _), (own, _) = viewed(), viewed("loss.target=own_views")
    differing = [
        not torch.equal(a, b) for a, b in zip(same.target(0)[0], own.target(0)[0], strict=True)
    ]
    assert all(differing)
    assert torch.equal(own.target(0)[0][0], own.target(0)[0][0])


def test_the_foreground_alone_can_be_for_pictures(tmp_path):
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (64, 64), np.uint8)).save(
        tmp_path / "noise.png"
    )
    mesh, picture = (
        prepare(compose([*SMOKE, "source=sphere", *style, "method=paper_amended"]))[1]
        for style in (["style=bubble"], [f"style.path={tmp_path / 'noise.png'}"])
    )
    assert not mesh.loss.masked
    assert picture.loss.masked


def test_sigma_and_bound_are_in_the_radii_asked_for():
    size = {}
    for unit in ("style", "source"):
        scene, _ = viewed(f"field.unit={unit}", "style.scale_by=area", "source=torus")
        size[unit] = scene.subject.sigma / 5, scene.subject.bound / 0.1
    assert size["source"] == (1, 1)
    assert size["style"] == pytest.approx((1 / scene.subject.unit, scene.subject.unit))


def test_same_seed_gives_the_same_mesh_and_another_seed_another():
    one, two = run("source=torus", "style=bubble")[0], run("source=torus", "style=bubble")[0]
    assert np.array_equal(one.vertices, two.vertices)
    other = run("source=torus", "style=bubble", "optim.seed=1")[0]
    assert not np.array_equal(one.vertices, other.vertices)


def test_the_rate_rises_then_falls_or_goes_down_in_the_papers_steps():
    cosine = OptimConfig(steps=100, rate=1.0, schedule="cosine")
    rates = [learning_rate(cosine, step) for step in range(100)]
    assert rates[0] == pytest.approx(0.1)
    assert rates.index(max(rates)) == 9
    assert all(a > b for a, b in itertools.pairwise(rates[9:]))
    assert rates[-1] == pytest.approx(0.05, abs=0.005)
    paper = OptimConfig(steps=1000, rate=5e-4, schedule="step", decay=0.9, decay_every=100)
    assert learning_rate(paper, 99) == 5e-4
    assert learning_rate(paper, 250) == pytest.approx(5e-4 * 0.81)


def test_a_short_run_goes_as_far_as_the_one_that_its_rate_is_meant_for():
    whole = OptimConfig(steps=1000, rate=5e-4, schedule="step", nominal_steps=1000)
    short = dataclasses.replace(whole, steps=200)
    assert learning_rate(whole, 250) == pytest.approx(5e-4 * 0.81)
    assert learning_rate(short, 50) == pytest.approx(5 * 5e-4 * 0.81)
    gone = [sum(learning_rate(each, step) for step in range(each.steps)) for each in (whole, short)]
    assert gone[1] == pytest.approx(gone[0])


def test_a_normalised_gradient_has_length_one_and_its_own_direction():
    field = torch.nn.Linear(3, 2)
    (field(torch.ones(3)) * torch.tensor([1e4, -3e3])).sum().backward()
    before = [p.grad.clone() for p in field.parameters()]
    normalise_gradient(field, gradient_norm(field))
    after = [p.grad for p in field.parameters()]
    assert sum(g.square().sum() for g in after).sqrt() == pytest.approx(1.0)
    ratios = torch.cat([(a / b).flatten() for a, b in zip(after, before, strict=True)])
    torch.testing.assert_close(ratios, ratios[:1].expand_as(ratios))
    field.zero_grad(set_to_none=False)
    normalise_gradient(field, gradient_norm(field))
    assert all((p.grad == 0).all() for p in field.parameters())


def test_strength_zero_gives_the_source_back_exactly():
    result, _ = run("source=torus", "style=bubble", "strength=0")
    assert np.array_equal(result.vertices, result.subject.source.vertices)


def test_result_is_in_the_sources_own_frame(tmp_path):
    """A scaled and shifted source must give the same result, scaled and shifted."""
    mesh = styleexp.load_mesh(save_torus(tmp_path / "near.ply", 1.0, 0.0))
    save_torus(tmp_path / "far.ply", 40.0, 7.0)
    near = run(f"source.path={tmp_path}/near.ply", "style=wave_large")[0]
    far = run(f"source.path={tmp_path}/far.ply", "style=wave_large")[0]
    np.testing.assert_allclose(far.displacement, 40 * near.displacement, atol=40 * 2e-3)
    np.testing.assert_allclose(
        far.vertices - far.displacement[:, None] * far.subject.surface.normals.numpy(),
        mesh.vertices * 40 + 7,
        atol=1e-3,
    )


def save_torus(path, scale, shift):
    from styleexp.inputs import meshes, shapes

    torus = shapes.make("torus", detail=2000)
    meshes.save_mesh(torus, torus.vertices * scale + shift, path)
    return path


def test_optimisation_reaches_for_the_style(coarse_shapes):
    """With enough steps on a small scene, the distance to the style falls by half."""
    overrides = "optim.steps=60", "field.start=source", "loss.erosion=2"  # not smoke's 0
    _, steps = run("source=sphere", "style=wave_large", *overrides)
    first, last = [np.mean([s.loss for s in part]) for part in (steps[:3], steps[-3:])]
    assert last < 0.5 * first


def test_image_style_runs_and_contrast_sets_the_relief(tmp_path):
    from PIL import Image

    rows = (np.sin(np.arange(128) / 3) * 100 + 128).astype(np.uint8)
    Image.fromarray(np.repeat(rows[:, None], 128, axis=1)).save(tmp_path / "rows.png")
    for method in ("robust", "paper"):
        result, _ = run("source=sphere", f"style.path={tmp_path}/rows.png", f"method={method}")
        assert np.abs(result.displacement).max() > 0


@pytest.mark.parametrize("mode", ["image", "surface"])
def test_every_kind_of_local_view_runs(mode):
    result, _ = run("source=torus", "style=rail", f"views.local.mode={mode}")
    assert np.abs(result.displacement).max() > 0


def test_python_call_equals_the_command_line(tmp_path):
    result = styleexp.stylize("torus", "bubble", *SMOKE)
    expected, _ = run("source=torus", "style=bubble")
    assert np.array_equal(result.vertices, expected.vertices)
    result.save(tmp_path / "out.glb")
    assert (tmp_path / "out.glb").stat().st_size > 1000


def test_a_loss_that_explodes_is_reported_with_its_step():
    method, scene = prepare(compose([*SMOKE, "source=torus", "style=bubble"]))
    broken = dataclasses.replace(scene, scales=([torch.tensor(0.0)] * 5, [torch.tensor(0.0)] * 5))
    with pytest.raises(UserError, match="at step 1"):
        list(method.optimise(broken, method.start(broken)))


def test_a_missing_device_is_an_error_not_a_fallback():
    with pytest.raises(UserError, match="device=cpu"):
        choose_device("cuda:77")


def test_a_stray_triangle_is_the_remedy_not_the_camera(tmp_path):
    import trimesh

    ball = trimesh.creation.icosphere(3)
    far = np.array([[100.0, 0, 0], [101, 0, 0], [100, 1, 0]])
    stray = np.vstack([ball.vertices, far]), np.vstack([ball.faces, [[642, 643, 644]]])
    with pytest.raises(UserError, match=r"1 of the 1281 faces of the source .* index 1280"):
        styleexp.stylize(stray, "bubble", *SMOKE)
    assert "are far from all others" not in str(
        styleexp.stylize("critter", "bubble", *SMOKE).subject.notes
    )
