"""The studio without its page: settings, what is made of them, what is saved."""

import json
import time
import xml.etree.ElementTree as ET
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from PIL import Image

import styleexp
from styleexp.cli.studio.settings import Settings, safe_name
from styleexp.cli.studio.workbench import Workbench
from styleexp.inputs import meshes, shapes
from styleexp.method.synthesis import method as synthesis
from styleexp.runs import bake
from styleexp.system.errors import UserError

QUICK = ("source.refine=none", "baseline.bank=600", "threads=1")


def until(bench, condition, seconds=120):
    """The first state that meets the condition."""
    deadline, since = time.monotonic() + seconds, -1
    while time.monotonic() < deadline:
        state = bench.state(since, 1.0)
        since = state["version"]
        if condition(state):
            return state
    pytest.fail(f"after {seconds} s still: {state}")


def done(state):
    return state["finished"] and state["stage"] == "done"


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("given")
    for name, detail in (("sphere", 1500), ("bubble", 3000)):
        mesh = shapes.make(name, detail)
        meshes.save_mesh(mesh, mesh.vertices, folder / f"{name}.ply")
    return folder


@pytest.fixture(scope="module")
def bench(files, tmp_path_factory):
    settings = Settings(str(files / "sphere.ply"), str(files / "bubble.ply"), more=QUICK)
    bench = Workbench(settings, tmp_path_factory.mktemp("out"))
    bench.start()
    until(bench, done)
    return bench


def saved_vertices(bench):
    (path, _) = bench.save(["ply"])
    return meshes.load_mesh(path).vertices, (path.parent / "command.txt").read_text()


def test_what_is_saved_is_what_the_command_makes(bench, files):
    given = (str(files / "sphere.ply"), str(files / "bubble.ply"))
    bench.change({"strength": 0.5, "scale": 2.0, "mask": "height:0.5..1"})
    state = until(bench, lambda s: done(s) and s["settings"]["scale"] == 2.0)
    assert any("covers" in note for note in state["notes"])
    vertices, command = saved_vertices(bench)
    overrides = command.split()[3:]
    assert set(overrides) == {"strength=0.5", "style.scale=2", "style.mask=height:0.5..1", *QUICK}
    expected = styleexp.stylize(*given, *overrides)
    assert np.array_equal(vertices, expected.vertices.astype(np.float32))
    assert bench.settings.command().split() == command.split()


def test_height_and_place_need_no_synthesis_and_direction_no_sampling(bench, monkeypatch):
    bench.change({"mask": "", "scale": 1.0, "strength": 1.0})
    until(bench, lambda s: done(s) and s["settings"]["strength"] == 1.0)
    stages = []
    tell = bench._tell
    monkeypatch.setattr(
        bench, "_tell", lambda stage=None, **f: (stages.append(stage), tell(stage, **f))
    )
    bench.change({"strength": 0.3, "mask": "slope:60"})
    until(bench, lambda s: done(s) and s["settings"]["strength"] == 0.3)
    assert not any(stage and "synthesising" in stage for stage in stages)
    bench.change({"rotation": 45.0})
    until(bench, lambda s: done(s) and s["settings"]["rotation"] == 45.0)
    assert any(stage and "synthesising" in stage for stage in stages)


def test_learning_goes_on_from_the_synthesis_until_it_is_stopped(files, tmp_path, monkeypatch):
    relief = synthesis.relief
    monkeypatch.setattr(
        synthesis, "relief", lambda s, config, x: relief(s, replace(config, bank=600), x)
    )
    rows, columns = np.sin(np.mgrid[0:64, 0:64] / 4)
    discs = (255 * (rows * columns).clip(0)).astype(np.uint8)
    Image.fromarray(discs).save(tmp_path / "discs.png")  # which isn't rendered, as a mesh is
    small = ("encoder=vgg19_random", "views.resolution=48", "views.local.per_view=1")
    given = Settings(str(files / "sphere.ply"), str(tmp_path / "discs.png"), more=(*QUICK, *small))
    bench = Workbench(given.changed({"steps": 1000}), tmp_path)
    bench.start()
    until(bench, done)
    start = saved_vertices(bench)[0]
    bench.learn()
    until(bench, lambda state: state["learned"] > 0)
    bench.stop()
    state = until(bench, done)
    assert 0 < state["learned"] < 1000
    vertices, command = saved_vertices(bench)
    assert not np.array_equal(vertices, start)
    assert {"method=robust", "field.start=synthesis", "optim.steps=1000"} < set(command.split())
    bench.change({"strength": 0.5})
    state = until(bench, lambda state: done(state) and state["learned"] == 0)
    assert "method=robust" not in state["command"]


def test_a_wrong_mask_is_said_and_the_next_settings_work(bench):
    bench.change({"mask": "attribute:eyes"})
    state = until(bench, lambda s: s["stage"] == "failed")
    assert "has no such vertex attribute" in state["error"]
    with pytest.raises(UserError, match="isn't finished"):
        bench.save(["ply"])
    bench.change({"mask": ""})
    assert until(bench, done)["error"] == ""


def test_prints_hold_the_same_surface(bench):
    bench.change({"mask": ""})
    until(bench, done)
    paths = {path.suffix: path for path in bench.save(["ply", "stl", "3mf"])}
    expected = meshes.load_mesh(paths[".ply"])
    printed = trimesh.load(paths[".stl"])
    assert printed.is_watertight
    assert printed.volume == pytest.approx(
        trimesh.Trimesh(expected.vertices, expected.faces).volume, rel=1e-5
    )
    with zipfile.ZipFile(paths[".3mf"]) as package:
        assert "[Content_Types].xml" in package.namelist()
        model = ET.fromstring(package.read("3D/3dmodel.model"))
    core = "{http://schemas.microsoft.com/3dmanufacturing/core/2015/02}"
    points = [[float(each.get(axis)) for axis in "xyz"] for each in model.iter(f"{core}vertex")]
    corners = [
        [int(each.get(f"v{k}")) for k in (1, 2, 3)] for each in model.iter(f"{core}triangle")
    ]
    assert model.get("unit") == "millimeter"
    assert trimesh.Trimesh(points, corners).volume == pytest.approx(printed.volume, rel=1e-5)


def test_maps_are_laid_on_the_source_as_it_was(bench, files):
    until(bench, done)
    saved = {path.name: path for path in bench.save(["maps"], 256)}
    assert {f"{each}.png" for each in ("height", "normal", "occlusion", "curvature")} < set(saved)
    low = meshes.load_mesh(saved["sphere-bubble_low.glb"])
    assert len(low.faces) == len(meshes.load_mesh(files / "sphere.ply").faces)
    content = saved["sphere-bubble_low.glb"].read_bytes()
    document = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])
    assert {"normalTexture", "occlusionTexture"} < set(document["materials"][0])
    notes = bench.state(-1, 0)["notes"]
    assert any("has no texture coordinates: unwrapped" in note for note in notes)


def test_without_a_library_for_maps_nothing_is_written(bench, monkeypatch):
    until(bench, done)
    before = sorted(bench.folder.iterdir())
    monkeypatch.setattr(bake, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"styleexp\[bake\]"):
        bench.save(["glb", "maps"])
    assert sorted(bench.folder.iterdir()) == before


def test_another_file_of_the_same_name_is_another_mesh(files, tmp_path):
    bench = Workbench(Settings(style=str(files / "bubble.ply"), more=QUICK), tmp_path)
    content = (files / "sphere.ply").read_bytes()
    bench.receive("source", "ball.ply", content)
    bench.start()
    until(bench, done)
    first = bench.look("source").version
    bench.receive("source", "ball.ply", content)
    with pytest.raises(UserError, match="isn't finished"):
        bench.save(["ply"])
    until(bench, done)
    assert bench.look("source").version > first


def test_learning_keeps_the_options_that_were_given():
    learning = Settings(more=("source.refine=none", "baseline.bank=600")).learning
    assert "source.refine=none" in learning
    assert not {"source.refine=auto", "baseline.bank=600"} & set(learning)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"strength": 9}, "from -2 to 2"),
        ({"strength": True}, "must be a number"),
        ({"scale": float("nan")}, "must be a number"),
        ({"direction": "left"}, "is not one of auto"),
        ({"source": "a\nb"}, "must be a short text"),
        ({"invert": 1}, "must be true or false"),
        ({"more": ["hydra.run.dir=/"]}, "no setting 'more'"),
        ({"hydra.run.dir": "/"}, "no setting"),
    ],
)
def test_settings_that_are_refused(given, said):
    with pytest.raises(UserError, match=said):
        Settings().changed(given)


@pytest.mark.parametrize(
    ("given", "kept"),
    [
        ("head.obj", "head.obj"),
        ("../../etc/passwd.obj", "passwd.obj"),
        ("C:\\meshes\\head.obj", "head.obj"),
        ("/etc/x.ply", "x.ply"),
        ("-rf.obj", "rf.obj"),
        ("a\x00b\n.png", "ab.png"),
        ("李明 头.obj", "李明 头.obj"),
    ],
)
def test_names_stay_in_their_folder(given, kept):
    assert safe_name(given) == kept


@pytest.mark.parametrize("given", ["", "..", "/", "...", "x" * 300 + ".obj"])
def test_names_that_are_refused(given):
    with pytest.raises(UserError, match="can't be used"):
        safe_name(given)


def test_files_that_are_refused(bench):
    with pytest.raises(UserError, match="can't be read"):
        bench.receive("source", "virus.exe", b"x")
    with pytest.raises(UserError, match="no place"):
        bench.receive("elsewhere", "a.obj", b"x")
    assert not (bench.folder / "files" / "virus.exe").exists()
