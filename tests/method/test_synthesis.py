"""method=synthesis: walking, directions, patches, and what comes of them."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from scipy.ndimage import gaussian_filter

import styleexp
from styleexp.config import build
from styleexp.config.compose import compose
from styleexp.inputs import meshes, shapes, spheres
from styleexp.method import scene
from styleexp.method.options import StyleConfig
from styleexp.method.patches import relief_of_mesh
from styleexp.method.pattern_size import MOST_GROWN, pattern_unit, thickness
from styleexp.method.relief import heat_smoother, smoother
from styleexp.method.subject import Style
from styleexp.method.synthesis import method as synthesis
from styleexp.method.synthesis.direction import FLOW, UP, direction_field, turned
from styleexp.method.synthesis.exemplar import MeshExemplar, PictureExemplar, measure
from styleexp.method.synthesis.optimise import DISORDERED, bank, matched
from styleexp.method.synthesis.quilting import quilt
from styleexp.method.synthesis.room import ball_radius
from styleexp.method.synthesis.shape import exemplar_of
from styleexp.method.synthesis.walk import Sheet
from styleexp.system.errors import UserError

CHEAP = ("method=synthesis", "metrics.judge=none", "baseline.bank=2000", "source.refine=none")


@pytest.fixture(scope="module")
def ball():
    shape = trimesh.creation.icosphere(5)
    return Sheet(shape.vertices, np.asarray(shape.faces))


@pytest.fixture(scope="module")
def plane():
    across = np.linspace(-1, 1, 61)
    x, y = np.meshgrid(across, across)
    number = np.arange(61 * 61).reshape(61, 61)
    a, b = number[:-1, :-1].ravel(), number[:-1, 1:].ravel()
    c, d = number[1:, 1:].ravel(), number[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return Sheet(np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1), faces)


def test_a_walk_over_a_ball_stays_on_it_and_comes_home(ball):
    start = np.arange(50)
    up = np.broadcast_to([0.0, 1.0, 0.0], ball.vertices.shape)
    state = ball.vertices[start], direction_field(ball, up, UP)[start], start
    steps = 60
    for _ in range(steps):
        state = ball.step(*state, (2 * np.pi / steps, 0.0))
    assert np.abs(np.linalg.norm(state[0], axis=1) - 1).max() < 0.01
    assert np.linalg.norm(state[0] - ball.vertices[start], axis=1).max() < 0.1  # a great circle


def test_a_grid_on_a_plane_is_a_grid(plane):
    middle = np.array([30 * 61 + 30])
    points, nears, ahead = plane.grids(middle, np.array([[0.0, 1.0, 0.0]]), 5, 0.1)
    expected = (np.arange(5) - 2) * 0.1
    assert np.allclose(points[0, :, :, 0], expected[None], atol=1e-12)  # column 0 to the left
    assert np.allclose(points[0, :, :, 1], -expected[:, None], atol=1e-12)  # row 0 ahead
    assert np.allclose(ahead, [0.0, 1.0, 0.0])
    assert plane.on_the_mesh(points, nears).all()
    beyond, nears, _ = plane.grids(np.array([0]), np.array([[0.0, 1.0, 0.0]]), 9, 0.1)
    assert not plane.on_the_mesh(beyond, nears).all()


def test_interpolation_is_exact_for_what_is_linear(plane):
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.95, 0.95, (500, 2)), np.zeros(500)])
    matrix = plane.interpolation(points, plane.nearest(points))
    values = 3 * plane.vertices[:, 0] - 2 * plane.vertices[:, 1] + 1
    assert np.allclose(matrix @ values, 3 * points[:, 0] - 2 * points[:, 1] + 1, atol=1e-5)
    assert np.allclose(matrix.sum(axis=1), 1, atol=1e-6)


def test_the_field_is_tangent_and_holds_up_where_it_can(ball):
    up = np.broadcast_to([0.0, 1.0, 0.0], ball.vertices.shape)
    field = direction_field(ball, up, UP)
    assert np.allclose(np.linalg.norm(field, axis=1), 1)
    assert np.abs((field * ball.normals).sum(1)).max() < 1e-9
    level = np.abs(ball.vertices[:, 1]) < 0.7
    tangent = up - (up * ball.normals).sum(1, keepdims=True) * ball.normals
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True).clip(min=1e-9)
    assert (field * tangent).sum(1)[level].min() > 0.98
    across = turned(field, ball.normals, np.pi / 2)
    assert np.abs((across * field).sum(1)).max() < 1e-9


def test_the_flow_does_not_depend_on_how_the_mesh_lies(ball):
    """With the wish turned along, the field turns along."""
    rotation = trimesh.transformations.rotation_matrix(1.0, [1, 2, 3])[:3, :3]
    wish = np.array([0.0, 1.0, 0.0])
    one = direction_field(ball, np.broadcast_to(wish, ball.vertices.shape), FLOW)
    turned_ball = Sheet(ball.vertices @ rotation.T, ball.faces)
    wishes = np.broadcast_to(rotation @ wish, ball.vertices.shape)
    other = direction_field(turned_ball, wishes, FLOW)
    # Next to a singularity it is anybody's guess.
    assert np.quantile((one @ rotation.T * other).sum(1), 0.02) > 0.999


@pytest.mark.parametrize(
    ("style", "shortest", "longest", "directed"),
    [
        ("stripe", 0.15, 0.27, True), ("scales", 0.13, 0.3, True),
        ("wave_small", 0.1, 0.25, False), ("buckyball", 0.4, 0.8, False),
    ],
)  # fmt: skip
def test_wavelength_and_direction_are_measured(style, shortest, longest, directed):
    from styleexp.method.synthesis.method import DIRECTED

    relief = relief_of_mesh(shapes.make(style, detail=12_000))
    found = measure(
        MeshExemplar(Sheet(relief.base, relief.faces), relief.height), np.random.default_rng(0)
    )
    assert shortest < found.wavelength < longest
    assert (found.directed > DIRECTED) == directed


def test_the_measured_wavelength_does_not_depend_on_the_seed():
    rail = exemplar_of(shapes.make("rail"))
    found = [measure(rail, np.random.default_rng(seed)) for seed in range(4)]
    assert np.ptp([each.wavelength for each in found]) < 1e-9
    assert np.ptp([each.directed for each in found]) < 0.05


def test_a_pictures_waves_are_measured_in_its_own_size():
    rows = torch.arange(256) / 256
    waves = torch.sin(2 * np.pi * 8 * rows)[:, None].expand(256, 256)
    found = measure(PictureExemplar(waves, 2 / 256), np.random.default_rng(0))
    assert found.wavelength == pytest.approx(2 / 8, rel=0.15)
    assert found.directed > 0.5


def test_patches_of_a_picture_are_its_parts():
    picture = torch.rand(64, 64, generator=torch.Generator().manual_seed(0))
    exemplar = PictureExemplar(picture, 1 / 64)
    patches, places = exemplar.sample(20, 5, 1 / 64, np.random.default_rng(0), False)
    assert patches.shape == (20, 5, 5)
    assert torch.equal(exemplar.patches(places[3:7], 5, 1 / 64), patches[3:7])
    assert float(patches.min()) >= float(picture.min()) - 1e-6
    assert float(patches.std()) > 0.1


def test_the_nearest_patch_is_the_nearest():
    """As a search through all of them says, with the weights that the bank compares with."""
    made = torch.rand(300, 9, 9, generator=torch.Generator().manual_seed(1))
    known = bank(made, 100.0 * np.arange(300)[:, None], 1.0)
    wanted = torch.tensor([5, 17, 200])
    best, misfit = known.nearest(known.compared(made.flatten(1)[wanted] + 1e-3))
    assert best.tolist() == wanted.tolist()
    assert float(misfit.max()) < 0.01


def test_the_nearest_among_the_like_is_found_from_one_of_them():
    made = torch.rand(300, 9, 9, generator=torch.Generator().manual_seed(1))
    known = bank(made, 100.0 * np.arange(300)[:, None], 1.0)
    similar = known.similar(torch.arange(300))
    before = similar[:, 3]
    before[:100] = -1  # nothing was found before
    features = known.compared(made.flatten(1))
    best, misfit = known.found(features, before)
    assert torch.equal(best[:100], torch.arange(100))
    found = (similar[before] == torch.arange(300)[:, None]).any(dim=1)
    assert found.any()
    assert torch.equal(best[found], torch.arange(300)[found])
    apart = (features - known.reduced[best]).square().sum(1)
    assert torch.allclose(misfit, apart, atol=1e-5)


@pytest.mark.parametrize("any_way", [False, True])
def test_a_quilt_is_the_exemplar_in_each_vertexs_own_frame(plane, any_way):
    """Of a slope, which no seam hides: where up is turned, patches are turned with it."""
    rows = torch.arange(400) / 400
    slope = PictureExemplar((-rows[:, None]).expand(400, 400), 16 / 400)  # falls by 1 over 16
    angle = 0.7
    ahead = np.broadcast_to([np.sin(angle), np.cos(angle), 0.0], plane.vertices.shape)
    laid = quilt(plane, ahead, slope, 0.05, 0.05, 1.0, any_way, 0, 300)
    inner = np.flatnonzero(np.abs(plane.vertices[:, :2]).max(axis=1) < 0.7)
    patches = laid.patches(torch.from_numpy(inner), 3, 0.05)
    steps = patches[:, :, 1] - patches[:, :, 7]  # from the row below to that above: 0.1
    if any_way:  # a piece as a whole is turned, how steep it is stays
        steps = (steps**2 + (patches[:, :, 3] - patches[:, :, 5]) ** 2).sqrt()
    # But at the picture's border, where it is mirrored.
    assert ((steps - 0.1 / 16).abs() < 1e-4).float().mean() > 0.98
    heights = laid.heights().numpy()[inner]
    assert np.allclose(heights, patches[:, 0, 4].numpy(), atol=1e-6)


def test_heights_get_the_distribution_and_keep_their_order():
    heights, like = torch.tensor([0.1, 0.3, 0.2, 0.9]), torch.linspace(-1, 1, 1000)
    found = matched(heights, like)
    assert found.argsort().tolist() == heights.argsort().tolist()
    assert float(found.min()) == pytest.approx(-1)
    assert float(found.max()) == pytest.approx(1)


def test_room_is_half_the_thickness_inside_and_half_the_gap_outside():
    low, high = trimesh.creation.box([4, 4, 0.4]), trimesh.creation.box([4, 4, 0.4])
    high.apply_translation([0, 0, 0.6])  # 0.2 apart
    both = trimesh.util.concatenate([low, high]).subdivide_to_size(0.1)
    fine = meshes.from_arrays(both.vertices, both.faces)
    sheet = Sheet(fine.vertices, fine.faces)
    middle = (np.abs(sheet.vertices[:, :2]) < 1).all(axis=1)
    top_of_low = middle & (np.abs(sheet.vertices[:, 2] - 0.2) < 1e-6)
    assert ball_radius(sheet, -1, 1.0)[top_of_low] == pytest.approx(0.2, rel=0.05)
    assert ball_radius(sheet, 1, 1.0)[top_of_low] == pytest.approx(0.1, rel=0.05)


def test_many_components_are_one_relief():
    """Overlapping balls round a big one: bumps as high as the balls stand out."""
    ways = spheres.fibonacci(40)
    balls = [trimesh.creation.icosphere(2, radius=0.3).apply_translation(0.8 * way) for way in ways]
    joined = trimesh.util.concatenate([trimesh.creation.icosphere(3, radius=0.7), *balls])
    exemplar = exemplar_of(meshes.from_arrays(joined.vertices, joined.faces))
    assert np.isfinite(exemplar.height).all()
    assert 0.03 < np.ptp(np.percentile(exemplar.height, [2, 98])) < 0.25
    out = exemplar.sheet.vertices / np.linalg.norm(exemplar.sheet.vertices, axis=1, keepdims=True)
    nearness = (out @ ways.T).max(axis=1)
    assert np.corrcoef(exemplar.height, nearness)[0, 1] > 0.6  # highest in the middle of a ball


@pytest.fixture(scope="module")
def striped():
    return styleexp.stylize("sphere", "stripe", *CHEAP)


def test_stripes_on_a_sphere_are_level_and_as_high_as_the_styles(striped):
    """Along up the height changes, across it hardly: a stripe may well be a spiral."""
    moved, mesh = striped.displacement, striped.subject.source
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    double = np.linalg.norm(normal, axis=1, keepdims=True)
    normal /= double
    ha, hb, hc = (moved[mesh.faces[:, k], None] for k in range(3))
    slope = np.cross(normal, ha * (c - b) + hb * (a - c) + hc * (b - a)) / double
    up = np.array([0.0, 1.0, 0.0]) - normal[:, 1:2] * normal
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    level = np.abs(normal[:, 1]) < 0.7
    along = (slope * up).sum(1)[level]
    across = (slope * np.cross(normal, up)).sum(1)[level]
    assert across.var() < 0.15 * along.var()
    style = relief_of_mesh(shapes.make("stripe")).height
    assert moved.std() == pytest.approx(style.std(), rel=0.35)


def test_the_same_seed_gives_the_same_bits_and_another_seed_another_relief(striped, capsys):
    again = styleexp.stylize("sphere", "stripe", *CHEAP)
    assert capsys.readouterr().out == ""  # what the command line tells is no business of a caller's
    assert (again.vertices == striped.vertices).all()
    other = styleexp.stylize("sphere", "stripe", *CHEAP, "optim.seed=1")
    assert not np.allclose(other.vertices, striped.vertices)


def test_strength_zero_gives_the_source_back_and_no_face_turns_over(striped):
    flat = styleexp.stylize("torus", "bubble", *CHEAP, "strength=0")
    assert (flat.vertices == flat.subject.source.vertices).all()
    source = trimesh.Trimesh(striped.subject.source.vertices, striped.faces, process=False)
    facing = (source.face_normals * striped.trimesh().face_normals).sum(1)
    assert facing.min() > 0


@pytest.mark.parametrize(
    ("style", "options", "told"),
    [
        ("bubble", ("style.direction=north",), "style.direction=north is not allowed"),
        ("bubble", ("baseline.bank=3",), "baseline.bank=3 is not allowed"),
    ],
)
def test_what_can_not_be_laid_is_said_in_one_sentence(style, options, told):
    with pytest.raises(UserError, match=told):
        styleexp.stylize("torus", style, *CHEAP, *options)


def test_a_pattern_is_finer_where_the_source_has_thin_parts():
    """Bumps as thick as a leg don't look like a pattern."""
    style = Style.of(shapes.make("bubble"))

    def factor(source, style, **more):
        by = {by: StyleConfig(scale_by=by, **more) for by in ("area", "parts")}
        unit = {each: pattern_unit(config, source, style) for each, config in by.items()}
        return unit["parts"] / unit["area"]

    ball = shapes.make("sphere")
    assert thickness(ball) == pytest.approx(2, rel=0.02)
    rod = trimesh.creation.capsule(3.0, 0.2)
    rod = meshes.Mesh("rod", np.array(rod.vertices), np.array(rod.faces))
    assert thickness(rod) == pytest.approx(0.4 / 1.7, rel=0.05)
    assert factor(ball, style) == pytest.approx(1, abs=0.03)
    assert factor(rod, style) < 0.9
    assert factor(rod, style, scale=2.0) == factor(rod, style)  # what is asked for is exact
    turned = trimesh.transformations.random_rotation_matrix(np.full(3, 0.4))[:3, :3]
    moved = meshes.Mesh("rod", 3 * rod.vertices @ turned.T + 5, rod.faces)
    assert factor(moved, style) == pytest.approx(factor(rod, style), rel=1e-3)
    flat = shapes.make("terrain")  # has no inside
    assert thickness(flat) == 2


def test_a_picture_is_large_enough_for_its_detail():
    """Blades of grass narrower than a few faces are lumps."""
    noise = np.random.default_rng(0).normal(size=(512, 512))
    source = shapes.make("sphere")
    size = {}
    for width in (1, 12):
        tone = gaussian_filter(noise, width, mode="wrap")
        style = Style.of(np.repeat((tone - tone.min())[..., None], 3, 2) / np.ptp(tone), "picture")
        size[width] = pattern_unit(StyleConfig(scale_by="parts"), source, style)
    assert size[12] < 1.05 < size[1] <= MOST_GROWN


def test_bumps_of_the_source_give_way_to_the_pattern_and_its_form_stays():
    ball = trimesh.creation.icosphere(5)
    base = np.array(ball.vertices)
    bumps = 0.01 * np.sin(20 * base).prod(axis=1)
    bent = 0.1 * base[:, 1] ** 2
    vertices = base * (1 + bumps + bent)[:, None]
    sheet = Sheet(vertices, np.array(ball.faces))
    own = synthesis.own_relief(sheet, 0.6, 0.02)
    assert np.corrcoef(own, bumps)[0, 1] > 0.8
    assert own.std() > 0.6 * bumps.std()
    sheet = Sheet(base * (1 + bent)[:, None], np.array(ball.faces))
    assert np.abs(synthesis.own_relief(sheet, 0.6, 0.02)).max() < 0.05 * np.ptp(bent)
    assert not synthesis.own_relief(sheet, 0.6, 0.0).any()
    needle = Sheet(vertices * [0.1, 1.0, 0.1], np.array(ball.faces))  # thinner than the bumps
    assert np.abs(synthesis.own_relief(needle, 0.6, 0.02)).max() < 1e-3


def test_learning_can_start_at_the_synthesis(coarse_shapes):
    """Before the first step it is what ``method=synthesis`` makes."""
    made = styleexp.stylize("torus", "stripe", "source.refine=none", "field.unfold=false")
    given = ["source=torus", "style=stripe", "style.scale_by=parts"]
    config = compose(["method=robust", "field.start=synthesis", *given])
    subject = build.subject_of(config, separate=True)
    base, notes = scene.base_of(subject)
    assert not notes
    assert np.allclose(base.numpy() * subject.frame.scale, made.displacement, atol=1e-6)


@pytest.mark.parametrize(("length", "directed"), [(1, False), (4, True)])
def test_long_forms_have_a_direction_though_they_have_no_spacing(length, directed):
    noise = np.random.default_rng(0).normal(size=(300, 300))
    blobs = gaussian_filter(noise, (3 * length, 3), mode="wrap")
    found = measure(
        PictureExemplar(torch.from_numpy(blobs).float(), 1 / 300), np.random.default_rng(0)
    )
    assert (found.coherence > synthesis.COHERENT) == directed


def test_a_direction_that_is_asked_for_is_followed_by_a_pattern_without_one():
    config = compose(["source=sphere", "style=bubble", "method=synthesis"])
    assert synthesis.any_way(build.subject_of(config, True), directed=False)
    assert not synthesis.any_way(build.subject_of(config, True), directed=True)
    config = compose(["source=sphere", "style=bubble", "method=synthesis", "style.direction=up"])
    assert not synthesis.any_way(build.subject_of(config, True), directed=False)


def test_smoothing_leaves_a_slope_alone_on_uneven_triangles(plane):
    """The graph Laplacian drew ripples on every slope, along the mesh's own rows."""
    rng = np.random.default_rng(0)
    vertices = plane.vertices + [0.01, 0.01, 0] * rng.uniform(-1, 1, plane.vertices.shape)
    inside = np.abs(vertices).max(axis=1) < 0.7
    slope = vertices[:, 0]
    moved = {
        way: np.abs(way(vertices, plane.faces, 1.5 * plane.edge)(slope) - slope)[inside].max()
        for way in (heat_smoother, smoother)
    }
    assert moved[heat_smoother] < 1e-4 < 1e-3 < moved[smoother]


def test_a_pattern_without_order_is_told_from_a_regular_one():
    """Votes of patches that disagree made a blur of gravel; its quilt is left as it is."""
    noise = np.random.default_rng(0).normal(size=(512, 512))
    pebbles = gaussian_filter(noise, 2.0, mode="wrap")
    waves = np.sin(np.arange(512) * 2 * np.pi / 16)[:, None] * np.ones(512)
    measured = []
    for height in (waves, pebbles):
        exemplar = PictureExemplar(torch.from_numpy(height).float(), 1 / 64)
        rng = np.random.default_rng(0)
        patches, places = exemplar.sample(4000, 9, 3 / 64, rng, any_way=False)
        measured.append(bank(patches, exemplar.centres(places), 3 / 64).disorder)
    assert measured[0] < 0.1 * DISORDERED < DISORDERED < measured[1]
