"""styleexp-bench at smoke sizes: structure and sanity, never a time's bound."""

import json
import subprocess
import sys

import pytest
import torch

from styleexp.cli.bench import main
from styleexp.experiments.bench import convergence, render, step
from styleexp.experiments.bench.floor import convolutions, operations
from styleexp.experiments.bench.measuring import interleaved
from styleexp.experiments.bench.parts import Parts
from styleexp.inputs import meshes, shapes
from styleexp.plugins import load_encoder
from styleexp.system.errors import UserError
from tests.helpers.needed import available

SMOKE = ["encoder=vgg19_random", "profile=smoke", "threads=1"]


SHAPES = ["source=sphere", "style=bubble"]


@pytest.fixture(autouse=True)
def one_thread(monkeypatch, tmp_path):
    monkeypatch.setenv("STYLEEXP_CACHE", str(tmp_path / "cache"))
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def smoke(tmp_path_factory):
    """Overrides of a run that takes moments."""
    folder = tmp_path_factory.mktemp("meshes")
    for name in ("sphere", "bubble"):
        mesh = shapes.make(name, 1000)
        meshes.save_mesh(mesh, mesh.vertices, folder / f"{name}.obj")
    return [*SMOKE, f"source.path={folder}/sphere.obj", f"style.path={folder}/bubble.obj"]


@pytest.fixture(scope="module")
def learned(smoke):
    return [*smoke, "method=robust"]


def test_contenders_take_turns():
    ran = []
    times = interleaved({"a": lambda: ran.append("a"), "b": lambda: ran.append("b")}, 3)
    assert ran == ["a", "b"] * 4
    assert len(times["a"].wall) == len(times["b"].cpu) == 3


def test_peak_memory_is_that_of_the_work():
    # In a process of its own: a test's may hold freed memory that the work would take first.
    code = """
import torch
from styleexp.experiments.bench.measuring import peak_memory_mb
nothing = peak_memory_mb(lambda: None)
print(peak_memory_mb(lambda: torch.ones(64 << 20, dtype=torch.uint8)) - nothing)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert 50 < float(done.stdout) < 100


def test_every_moment_counts_for_one_part_forward_and_backward():
    clock = Parts(torch.device("cpu"))
    double = clock.timed("double", lambda x: 2 * x)
    inner = clock.timed("inner", lambda x: x.exp())
    outer = clock.timed("outer", lambda x: {"out": inner(x).sin()})
    x = torch.ones(1000, requires_grad=True)
    clock.begin()
    outer(double(x))["out"].sum().backward()
    spent = clock.end()
    assert set(spent) == {
        *("other", "double", "inner", "outer"),
        *("double backward", "inner backward", "outer backward"),
    }
    assert all(wall >= 0 for wall, _ in spent.values())
    torch.testing.assert_close(x.grad, 2 * torch.exp(2 * x.detach()) * torch.exp(2 * x).cos())


def test_a_render_beside_another_renderer_of_ours(capsys):
    pytest.importorskip("moderngl", reason="the extra gl is not installed")
    given = ["--faces", "2000", "--views", "2", "--resolution", "64", "--repeats", "1"]
    code = main(["render", *given, "--peer", "moderngl_deferred", "--json"])
    told = capsys.readouterr()
    available(lambda: code == 0 or raised(told.err))
    row = json.loads(told.out)
    assert row["ratio"] == pytest.approx(row["peer_ms"] / row["ours_ms"])
    assert row["image_difference"] < 0.01
    assert row["gradient_cosine"] > 0.95
    assert row["machine"]["threads"] == 1
    assert {"visibility", "shading backward", "outlines backward"} <= set(row["parts_cpu_ms"])


def raised(message):
    raise UserError(message)


def test_deodr_draws_the_same_picture():
    pytest.importorskip("deodr", reason="the extra bench is not installed")
    task = render.make_task("bubble", 2000, 2, 64)
    row = render.measure(task, ["soft_raster", "deodr"], torch.device("cpu"), 1)
    assert row["image_difference"] < 0.04
    assert row["gradient_cosine"] > 0.5


def test_several_sizes_are_rows(capsys):
    given = ["--faces", "500,2000", "--views", "1", "--resolution", "32", "--repeats", "1"]
    assert main(["render", *given, "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [row["faces"] for row in rows] == sorted({row["faces"] for row in rows})
    assert len(rows) == 2


def test_the_instruments_leave_the_renderer_as_it_was():
    from styleexp.renderers.soft_raster import deferred, shading

    before = deferred.FaceNormals, deferred.Compose, shading.LightPixels
    task = render.make_task("bubble", 500, 1, 32)
    render.measure(task, ["soft_raster"], torch.device("cpu"), 1)
    after = deferred.FaceNormals, deferred.Compose, shading.LightPixels
    assert after == before


def test_a_steps_parts_sum_to_the_step(learned):
    found = step.measure(learned, 1)  # of several, medians are told, which don't sum
    for key in ("", "cpu_"):
        parts, whole = found[f"parts_{key}ms"], found[f"step_{key}ms"]
        assert sum(parts.values()) == pytest.approx(whole)
        assert 0 < found["encoder_share"] < 1
    expected = {"field", "normals", "render", "image views", "encoder", "loss", "optimiser"}
    expected |= {"field backward", "render backward", "encoder backward", "loss backward"}
    expected |= {"Gram matrices", "Gram matrices backward"}
    assert expected <= set(found["parts_ms"])
    assert found["encoder_over_floor"] >= found["encoder_over_convolutions"] > 0
    assert found["threads"] == 1
    assert found["steps"] == 1


def test_the_parts_do_not_change_the_result(learned):
    from styleexp.config import build
    from styleexp.config.compose import compose

    config = compose([*learned, "optim.steps=3"])
    method, scene = build.prepare(config)
    losses = [each.loss for each in method.optimise(scene, method.start(scene))]
    seen = []
    step.measure([*learned, "optim.steps=3"], 1, seen.append)
    # Gradients are added up in another order, no more.
    assert [each.loss for each in seen] == pytest.approx(losses, rel=1e-3)
    assert seen[0].loss == losses[0]


def test_the_encoders_operations_by_hand():
    encoder = load_encoder("vgg19_random")
    shapes = convolutions(encoder, (2, 3, 40, 24), ("conv2_1", "conv1_1"))
    assert shapes == [(2, 3, 64, 40, 24), (2, 64, 64, 40, 24), (2, 64, 128, 20, 12)]
    assert operations(shapes[0]) == 2 * 2 * 3 * 64 * 9 * 40 * 24


def test_convergence_measures_both_methods_and_can_be_redrawn(tmp_path, capsys, smoke):
    given = ["metrics.judge=vgg19_random", "metrics.windows=2"]
    out = tmp_path / "curve.png"
    arguments = ["--points", "2", "--out", str(out), "--json"]
    assert main(["convergence", *smoke, *given, *arguments]) == 0
    found = json.loads(capsys.readouterr().out)
    assert out.stat().st_size > 1000
    for points in found["methods"].values():
        assert [point["step"] for point in points] == [0, 1, 4]
        times = [point["seconds"] for point in points]
        assert times == sorted(times)
    begun = {name: points[0]["style_distance"] for name, points in found["methods"].items()}
    assert begun["paper"] == pytest.approx(1, abs=0.5)
    assert begun["robust"] < begun["paper"]  # it starts at the style's height map
    again = convergence.redraw(out.with_suffix(".json"), tmp_path / "again.png")
    assert again["methods"] == found["methods"]


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (["render", "--peer", "soft_raster"], "name each renderer once"),
        (["render", "--peer", "nothing"], "unknown renderer 'nothing'"),
        (["render", "--mesh", "nothing"], "unknown shape 'nothing'"),
        (["render", "--device", "cuda:77"], "can't be used"),
        (["step", "optim.stepz=3"], "did you mean optim.steps"),
        (["step", *SMOKE, *SHAPES, "source.refine=none"], "doesn't optimise a style loss"),
        (["convergence", *SMOKE, "method=paper"], "--methods"),
        (["convergence", "--redraw", "nowhere.json"], "can't be drawn"),
    ],
)
def test_mistakes_are_told_in_one_sentence(given, told, capsys):
    assert main(given) == 2
    error = capsys.readouterr().err
    assert told in error
    assert "Traceback" not in error
