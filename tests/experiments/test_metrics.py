"""The metrics on cases with a known answer. The whole truth board is in docs/metrics.md."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from styleexp.cli.metrics import main
from styleexp.config.compose import compose
from styleexp.config.schema import Config
from styleexp.experiments import metrics
from styleexp.experiments.metrics import shape, style, truth
from styleexp.experiments.metrics.board import nearest
from styleexp.inputs import meshes, shapes
from styleexp.inputs.style import Style
from styleexp.method import patches
from styleexp.method.pattern_size import pattern_unit

DETAIL = 6_000


@pytest.fixture(scope="module")
def source():
    return shapes.make("torus", DETAIL)


@pytest.fixture(scope="module")
def judge():
    from tests.helpers.needed import available

    return available(lambda: metrics.load_judge("vgg16_edges", 12))


def on(source, name, factor=1.0, scale=1.0):
    """The source with a style wrapped around it, and its frame's radius."""
    frame = meshes.normalisation(source.vertices)
    vertices = frame.apply(source.vertices)
    normals = meshes.vertex_normals(vertices, source.faces)
    config = compose([f"style={name}"]).style
    unit = scale * pattern_unit(config, source, Style.of(shapes.make(name)))
    height = factor * truth.wrapped(name, vertices, normals, unit, np.random.default_rng(3))
    return frame.invert(vertices + height[:, None] * normals)


def measured(source, name, vertices, judge=None):
    config = compose(["source=torus", f"style={name}"])
    return metrics.measure(
        config, source, Style.of(shapes.make(name)), vertices, source.faces, judge
    )


# ------------------------------------------------------------------------------------------- style


def test_the_true_style_is_near_and_its_absence_far(source, judge):
    true = measured(source, "bubble", on(source, "bubble"), judge)
    faint = measured(source, "bubble", on(source, "bubble", factor=0.25), judge)
    plain = measured(source, "bubble", source.vertices, judge)
    assert true["style_distance"] < 0.4 < faint["style_distance"] < plain["style_distance"]
    assert plain["style_distance"] == pytest.approx(1.0, abs=0.1)
    assert true["relief_distance"] < faint["relief_distance"] < plain["relief_distance"]
    assert true["relief_share"] == pytest.approx(1.0, abs=0.25)
    assert plain["relief_rms"] == 0.0


def test_a_shrunken_source_has_no_style(source, judge):
    normals = meshes.vertex_normals(source.vertices, source.faces)
    shrunken = measured(source, "bubble", source.vertices - 0.03 * normals, judge)
    assert shrunken["style_distance"] == pytest.approx(1.0, abs=0.1)
    assert shrunken["relief_rms"] < 1e-3
    assert shrunken["volume_change"] < -0.05


@pytest.mark.parametrize("scale", [0.5, 2.0])
def test_the_wrong_scale_is_farther(source, judge, scale):
    right = measured(source, "stripe", on(source, "stripe"), judge)
    wrong = measured(source, "stripe", on(source, "stripe", scale=scale), judge)
    assert right["style_distance"] < wrong["style_distance"]
    assert right["relief_distance"] < wrong["relief_distance"]


def test_styles_are_told_apart(source, judge):
    goals = {
        name: judge.style(compose([f"style={name}"]), Style.of(shapes.make(name)), 1.0)
        for name in ("stripe", "bubble", "wave_large")
    }
    for name in goals:
        config = compose([f"style={name}"])
        unit = pattern_unit(config.style, source, Style.of(shapes.make(name)))
        relief = patches.relief_of_result(source, on(source, name), source.faces, unit)
        looks = judge.looks(config, relief, unit)
        for distance in (
            style.appearance_distance,
            style.relief_distance,
            lambda a, b: style.style_distance(a, b, judge.plain),
        ):
            assert min(goals, key=lambda goal: distance(looks, goals[goal])) == name


def test_the_metrics_do_not_depend_on_frame_or_numbering(source, judge):
    vertices = on(source, "bubble")
    once = measured(source, "bubble", vertices, judge)
    moved = meshes.Mesh("torus", 3 * source.vertices + [1.0, 2.0, 3.0], source.faces)
    again = measured(moved, "bubble", 3 * vertices + [1.0, 2.0, 3.0], judge)
    assert again == pytest.approx(once, rel=0.02, abs=2e-3)


def test_a_picture_is_judged_as_a_photograph_of_the_relief(judge):
    relief = patches.relief_of_mesh(shapes.make("bubble", 20_000))
    seen = style.shaded(patches.windows(relief, 1.0, 4).height)
    picture = np.repeat(seen[0].numpy()[..., None], 3, axis=2).astype(np.float32)
    config = compose(["style.path=picture.png", "style.image_tile=0.28"])
    goal = style.judged_style(Style.of(picture), config, judge.encoder, 1.0)
    near = style.judged(relief, 1.0, judge.encoder, 12)
    other = style.judged(
        patches.relief_of_mesh(shapes.make("stripe", 20_000)), 1.0, judge.encoder, 12
    )
    distances = [style.style_distance(x, goal, judge.plain) for x in (near, other, judge.plain)]
    assert distances[0] < distances[1]
    assert distances[2] == pytest.approx(1.0)


def test_a_pictures_brightness_stands_for_a_relief_of_any_height(judge):
    reliefs = [patches.relief_of_mesh(shapes.make(name, 20_000)) for name in ("bubble", "stripe")]
    seen = patches.windows(reliefs[0], 1.0, 4).height[0].numpy()
    bright = (seen - seen.min()) / (seen.max() - seen.min())
    picture = np.repeat(bright[..., None], 3, axis=2).astype(np.float32)
    goal = style.judged_picture(picture, Config(), 1.0, judge.encoder)
    low = replace(reliefs[0], height=0.3 * reliefs[0].height)
    near, other, lower = (
        style.relief_distance(style.judged(each, 1.0, judge.encoder, 12), goal)
        for each in (*reliefs, low)
    )
    assert near < 0.5 * other
    assert lower == pytest.approx(near, rel=0.02)


def test_windows_lie_flat_on_a_curved_surface():
    relief = patches.relief_of_mesh(shapes.make("sphere", DETAIL))
    seen = patches.windows(relief, 0.5, 8)
    assert len(seen.mask) == 8
    assert seen.mask.float().mean() > 0.95
    # A sphere has no relief, but for what its uneven edges make of the graph Laplacian.
    assert seen.height.abs().max() < 0.03


def test_windows_show_heights_in_their_own_width():
    sphere = shapes.make("sphere", DETAIL)
    height = 0.05 * np.sin(20 * sphere.vertices[:, 1])
    for width in (0.5, 1.0):
        seen = patches.windows(patches.Relief(sphere.vertices, sphere.faces, height), width, 6)
        assert seen.height[seen.mask].abs().max() == pytest.approx(0.05 / width, rel=0.1)


def test_no_window_fits_on_a_thread():
    thread = shapes.make("torus", 500)
    thin = patches.Relief(0.001 * thread.vertices, thread.faces, np.zeros(len(thread.vertices)))
    assert len(patches.windows(thin, 1.0, 4).mask) == 0


def test_a_result_with_other_faces_is_measured_by_its_distance_from_the_source(source):
    vertices = on(source, "bubble")
    keep = np.arange(len(source.faces)) > 0  # one face less: another topology
    same = patches.relief_of_result(source, vertices, source.faces, 1.0)
    other = patches.relief_of_result(source, vertices, source.faces[keep], 1.0)
    assert np.corrcoef(same.height, other.height)[0, 1] > 0.95


def test_statistics_know_up_from_sideways():
    rows = torch.arange(96.0)[None, :, None].expand(1, 96, 96)
    ridges = patches.Windows(0.05 * torch.sin(rows / 3), torch.ones(1, 96, 96, dtype=torch.bool))
    turned = patches.Windows(ridges.height.transpose(1, 2), ridges.mask)
    level, upright = style.statistics(ridges), style.statistics(turned)
    strongest = int(level.energy.argmax())
    assert level.upright[strongest] > 0.9
    assert upright.upright[strongest] < -0.9
    assert level.coherence[strongest] > 0.9


# ----------------------------------------------------------------------------------------- content


def test_the_source_itself_keeps_all_of_its_shape(source):
    found = measured(source, "bubble", source.vertices)
    assert found["silhouette_iou"] == 1.0
    for name in ("chamfer", "hausdorff", "volume_change", "flipped_faces"):
        assert found[name] == pytest.approx(0.0, abs=1e-6)
    assert found["self_intersections"] == 0.0


def test_content_of_a_known_displacement():
    sphere = shapes.make("sphere", DETAIL)
    found = shape.content(sphere, 1.1 * sphere.vertices, sphere.faces)
    diagonal = 2 * 3**0.5
    assert found["chamfer"] == pytest.approx(0.1 / diagonal, rel=0.02)
    assert found["hausdorff"] == pytest.approx(0.1 / diagonal, rel=0.02)
    assert found["volume_change"] == pytest.approx(1.1**3 - 1, rel=1e-3)
    # A sphere's outline, seen from 2.5 radii away: a disc of tangent r / sqrt(2.5^2 - r^2).
    discs = [r**2 / (2.5**2 - r**2) for r in (1.0, 1.1)]
    assert found["silhouette_iou"] == pytest.approx(discs[0] / discs[1], abs=0.01)


def test_faces_that_fold_over_are_counted(source):
    pulled = source.vertices.copy()
    pulled[source.faces[0, 0]] += 5 * (pulled[source.faces[0]].mean(0) - pulled[source.faces[0, 0]])
    found = shape.content(source, pulled, source.faces)
    assert 1 <= found["flipped_faces"] * len(source.faces) <= 6


def test_two_spheres_cut_each_other_along_a_ring():
    vertices, faces = shapes.icosphere(600)
    both = np.concatenate([vertices, vertices + np.array([1.0, 0.02, 0.01])])
    joined = np.concatenate([faces, faces + len(vertices)])
    share = shape.self_intersections(both, joined)
    assert 0.03 < share < 0.25
    apart = np.concatenate([vertices, vertices + np.array([2.5, 0.0, 0.0])])
    assert shape.self_intersections(apart, joined) == 0.0


def test_one_large_face_through_many_small_ones_is_found():
    vertices, faces = shapes.icosphere(2_000)
    wall = np.array([[-9.0, 0.013, -9.0], [9.0, 0.013, -9.0], [0.0, 0.013, 18.0]])
    both = np.concatenate([vertices, wall])
    joined = np.concatenate([faces, [[len(vertices), len(vertices) + 1, len(vertices) + 2]]])
    assert shape.self_intersections(both, joined) > 0.02


# ------------------------------------------------------------------------------------ command line


def test_compare_measures_any_mesh(tmp_path, source, capsys):
    given, result = tmp_path / "source.ply", tmp_path / "result.ply"
    meshes.save_mesh(source, source.vertices, given, np.zeros(len(source.vertices)))
    meshes.save_mesh(source, on(source, "bubble"), result, np.zeros(len(source.vertices)))
    command = ["compare", str(result), str(given), "bubble", "--json", "--judge", "none"]
    assert main(command) == 0
    found = json.loads(capsys.readouterr().out)
    assert 0.5 < found["relief_share"] < 1.5
    assert "style_distance" not in found


def test_a_missing_result_is_one_sentence(tmp_path, capsys):
    assert main(["compare", str(tmp_path / "no.ply"), "torus", "bubble"]) == 2
    told = capsys.readouterr().err
    assert "there is no file" in told
    assert len(told.splitlines()) == 1


def test_a_folder_without_runs_is_one_sentence(tmp_path, capsys):
    assert main(["board", str(tmp_path), "--judge", "vgg19_random"]) == 2
    assert "contains no run" in capsys.readouterr().err
    assert main(["run", str(tmp_path), "--judge", "none"]) == 2
    assert "run.json" in capsys.readouterr().err


def test_a_turned_style_runs_the_other_way():
    x, y = np.meshgrid(np.linspace(-1, 1, 40), np.linspace(-1, 1, 40), indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
    normals = np.tile([0.0, 0.0, 1.0], (x.size, 1))

    def height(angle):
        rng = np.random.default_rng(0)
        return truth.wrapped("stripe", points, normals, 1.0, rng, angle).reshape(x.shape)

    upright, turned = height(0.0), height(np.pi / 2)
    assert np.ptp(upright, axis=0).max() < 1e-9 < 0.01 < np.ptp(upright, axis=1).min()
    assert np.ptp(turned, axis=1).max() < 1e-9 < 0.01 < np.ptp(turned, axis=0).min()


def test_the_verdict_tells_a_good_metric_from_a_bad_one(source):
    sample = {
        name: truth.Sample(style.Looks([], None, None), [], []) for name in ("right", "wrong")
    }
    board = truth.Board(styles=dict(sample), plain=sample["right"], own={"torus": sample["right"]})
    others = ("faint", "half", "double", "noise", "shrunken", "turned", *truth.IMPERFECT)
    for what in ("true", *others):
        board.cases["torus", "right", what] = sample["right"] if what == "true" else sample["wrong"]

    def good(result, goal, plain, own):
        return 0.0 if result is goal else 1.0

    verdict = truth._verdict(good, board)
    assert verdict["kept"]
    assert verdict["rank1"] == verdict["scale"] == verdict["no_style"] == 1.0
    assert verdict["imperfect"] == verdict["turned"] == 0.0  # these are the wrong style's
    verdict = truth._verdict(lambda *rest: 1.0 - good(*rest), board)
    assert not verdict["kept"]
    assert verdict["confusions"] == ["torus: right mistaken for wrong"]


def test_of_a_board_the_nearest_style_of_the_same_kind_is_named():
    mesh = style.Looks([], [], None)
    picture = style.Looks([], None, None)
    goals = {"bubble": mesh, "stripe": style.Looks([], [], None), "circles": picture}
    far = {id(goals["bubble"]): 2.0, id(goals["stripe"]): 1.0, id(picture): 0.0}

    def distance(looks, goal):
        return far[id(goal)]

    assert nearest(mesh, "bubble", goals, distance) == "stripe"
    assert nearest(mesh, "circles", goals, distance) == "circles"


@pytest.fixture(scope="module")
def board(tmp_path_factory):
    """Two finished runs of coarse meshes, and one that failed."""
    from styleexp.experiments.execute import run

    folder = tmp_path_factory.mktemp("board")
    for name, detail in (("torus", 2000), ("bubble", 5000), ("stripe", 5000)):
        mesh = shapes.make(name, detail)
        meshes.save_mesh(mesh, mesh.vertices, folder / f"{name}.ply")
    for name in ("bubble", "stripe"):
        overrides = [
            f"source.path={folder / 'torus.ply'}",
            f"style.path={folder / name}.ply",
            "method=robust",
            "profile=smoke",
            "encoder=vgg19_random",
        ]
        assert run(compose([*overrides, "report=false"]), folder / name, overrides) == 0
    (folder / "failed").mkdir()
    (folder / "failed" / "run.json").write_text((folder / "bubble" / "run.json").read_text())
    (folder / "failed" / "status.json").write_text('{"status": "failed"}')
    return folder


def test_a_board_is_measured_anew_and_says_which_runs_are_not_done(board, capsys):
    measured = board / "bubble" / "metrics.json"
    measured.write_text("{}")
    command = ["board", str(board), "--judge", "vgg19_random", "--windows", "4", "--write"]
    assert main([*command, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["of"] == found["styles"] == 2
    assert 0 <= found["identification"] <= 2
    assert 0 <= found["identification_features"] <= 2
    assert found["min_silhouette_iou"] > 0.9
    assert "failed, not done" in next(r for r in found["runs"] if r["run"] == "failed")["status"]
    assert "style_distance" in json.loads(measured.read_text())
    assert main(command) == 0
    assert "identified: " in capsys.readouterr().out


def test_a_run_measured_from_its_file_is_as_it_was_measured_when_it_ended(board, capsys):
    assert main(["run", str(board / "stripe"), "--judge", "none", "--json"]) == 0
    again = json.loads(capsys.readouterr().out)
    logged = json.loads((board / "stripe" / "metrics.json").read_text())
    assert {k: logged[k] for k in again} == pytest.approx(again, rel=0.01, abs=1e-4)


def test_the_pictures_truth_board_counts_every_case(monkeypatch, capsys, tmp_path):
    rows, columns = np.sin(np.mgrid[0:64, 0:64] / 2)
    dots = 2 * (rows * columns).clip(0) ** 3 - 1
    for name, grey in (("stripes", columns), ("dots", dots)):
        Image.fromarray((100 * grey + 128).astype(np.uint8)).save(tmp_path / f"{name}.png")
    monkeypatch.setenv("STYLEEXP_ASSETS", str(tmp_path))
    arguments = ["truth-board", "--pictures", "stripes,dots", "--sources", "sphere"]
    arguments += ["--vertices", "8000", "--windows", "8", "--judge", "vgg19_random", "--json"]
    assert main(arguments) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["cases"] == 2
    assert set(found["rank1"]) == {"style_distance", "relief_distance", "appearance_distance"}
    assert found["rank1"]["relief_distance"] == 1
    assert main([*arguments[:2], "bubble", *arguments[3:]]) == 2
    assert "is a mesh" in capsys.readouterr().err
