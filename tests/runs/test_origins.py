"""Who comes back to a run finds the very files that it was made from, or is told which is not."""

import json
import os
import shlex
import shutil
import signal
import time

import pytest

from styleexp.inputs import meshes, shapes
from styleexp.runs import identity, origins
from styleexp.system.errors import UserError
from tests.helpers import warm

SMOKE = ["method=robust", "profile=smoke", "encoder=vgg19_random", "report=false", "threads=1",
         "preview.resolution=32", "preview.turntable_frames=1"]  # fmt: skip


def run(module, *arguments, cwd):
    return warm.run("-m", module, *arguments, cwd=cwd, env=warm.coarse())


def complaint(done):
    assert done.returncode == 2, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    lines = [x for x in done.stderr.splitlines() if x.strip() and not x.startswith("warning: ")]
    assert len(lines) == 1, done.stderr
    return lines[0]


def save(name, path, detail=800):
    mesh = shapes.make(name, detail=detail)
    meshes.save_mesh(mesh, mesh.vertices, path)
    return mesh


def content(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory):
    """A folder with t.ply and a run of it that a closed terminal ended: the command it printed."""
    home = tmp_path_factory.mktemp("home dir")
    save("torus", home / "t.ply")
    process = warm.start(
        "-m", "styleexp", "source.path=t.ply", "style=bubble", *SMOKE, "optim.steps=400",
        "hydra.run.dir=run", cwd=home, env=warm.coarse(), stdout=warm.PIPE,
    )  # fmt: skip
    lines = home / "run" / "metrics.jsonl"
    until = time.monotonic() + 240
    while not (lines.exists() and lines.read_text().count("\n") > 1):
        assert process.poll() is None
        assert time.monotonic() < until
        time.sleep(0.05)
    process.send_signal(signal.SIGHUP)
    told, _ = process.communicate(timeout=120)
    assert process.returncode == 130, told
    # The rest of the four hundred steps would take long.
    record = json.loads((home / "run" / "run.json").read_text())
    step = json.loads((home / "run" / "status.json").read_text())["step"]
    record["config"]["optim"]["steps"] = step + 1
    (home / "run" / "run.json").write_text(json.dumps(record))
    return home, told


@pytest.fixture
def lain(interrupted, tmp_path):
    """The same in a place of its own: its folder, and another working folder with another t.ply."""
    home, elsewhere = tmp_path / "home", tmp_path / "elsewhere"
    shutil.copytree(interrupted[0], home)
    record = json.loads((home / "run" / "run.json").read_text())
    record["assets"]["source"]["path"] = str(home / "t.ply")
    (home / "run" / "run.json").write_text(json.dumps(record))
    elsewhere.mkdir()
    save("sphere", elsewhere / "t.ply", detail=3000)
    return home, elsewhere


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A finished run of a relative source and style."""
    home = tmp_path_factory.mktemp("finished")
    save("torus", home / "t.ply")
    save("stripe", home / "s.ply", detail=2000)
    given = ("source.path=t.ply", "style.path=s.ply", *SMOKE, "method=displacement_map")
    done = run("styleexp", *given, "hydra.run.dir=run", cwd=home)
    assert done.returncode == 0, done.stderr
    return home


@pytest.fixture
def moved(finished, tmp_path, monkeypatch):
    """The same, together with its files, somewhere else; the old place is no more for it."""
    shutil.copytree(finished, tmp_path / "moved")
    record = json.loads((tmp_path / "moved" / "run" / "run.json").read_text())
    for kind, name in (("source", "t.ply"), ("style", "s.ply")):
        record["assets"][kind]["path"] = str(tmp_path / "moved" / name)
    (tmp_path / "moved" / "run" / "run.json").write_text(json.dumps(record))
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    save("sphere", tmp_path / "elsewhere" / "t.ply", detail=3000)
    return tmp_path / "moved"


def test_a_hangup_is_an_interruption(interrupted):
    home, told = interrupted
    status = json.loads((home / "run" / "status.json").read_text())
    assert status["status"] == "interrupted"
    assert (home / "run" / "checkpoint.safetensors").exists()
    assert "continue with: styleexp " in told


def test_the_command_that_was_printed_works_from_any_folder(interrupted, tmp_path):
    home, told = interrupted
    printed = told.split("continue with: ")[1].strip()
    assert "home dir" in printed  # a space: it has to be quoted
    save("sphere", tmp_path / "t.ply", detail=3000)
    done = run(*shlex.split(printed), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    result = meshes.load_mesh(home / "run" / "result.ply")
    source = meshes.load_mesh(home / "t.ply")
    assert (result.faces == source.faces).all()


@pytest.mark.parametrize(
    ("change", "told"), [("changed", "has changed since the run began"), ("gone", "is missing")]
)
def test_a_source_that_changed_or_is_gone_is_refused_by_its_name(change, told, lain):
    home, elsewhere = lain
    if change == "gone":
        (home / "t.ply").unlink()
    else:
        save("sphere", home / "t.ply", detail=3000)
    before = content(home)
    said = complaint(run("styleexp", f"resume={home / 'run'}", cwd=elsewhere))
    assert f"its source '{home / 't.ply'}' {told}" in said
    assert "restore it, or start the run again" in said
    assert {p: b for p, b in content(home).items() if p.name != ".lock"} == {
        p: b for p, b in before.items() if p.name != ".lock"
    }


def test_a_run_begun_where_hydra_changes_the_folder_has_its_own_source(tmp_path):
    save("torus", tmp_path / "t.ply")
    given = ("source.path=t.ply", "style=bubble", *SMOKE, "method=displacement_map")
    done = run("styleexp", *given, "hydra.job.chdir=true", "hydra.run.dir=run", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert record["assets"]["source"]["path"] == str(tmp_path / "t.ply")
    assert record["config"]["source"]["path"] == "t.ply"  # as it was typed
    assert not (tmp_path / "run" / "run").exists()
    done = run("styleexp", "-m", *given, "hydra.job.chdir=true", "optim.seed=0,1",
               "hydra.sweep.dir=all", cwd=tmp_path)  # fmt: skip
    assert done.returncode == 0, done.stderr


def test_metrics_maps_and_pages_work_from_elsewhere(moved, capsys):
    from styleexp.cli.metrics import main as metrics
    from styleexp.cli.report import main as report
    from styleexp.experiments.reports import shown

    assert metrics(["run", str(moved / "run"), "--judge", "none", "--json"]) == 0
    measured = json.loads(capsys.readouterr().out)
    recorded = json.loads((moved / "run" / "metrics.json").read_text())
    assert measured["silhouette_iou"] == pytest.approx(recorded["silhouette_iou"])
    source, vertices, _ = shown.read_moved(moved / "run")
    assert len(source.vertices) == len(vertices) == len(meshes.load_mesh(moved / "t.ply").vertices)
    assert report([str(moved / "run")]) == 0
    assert "The source can" not in (moved / "run" / "report.html").read_text()


@pytest.mark.parametrize("change", ["changed", "gone"])
def test_metrics_maps_and_boards_refuse_another_source(change, moved, capsys):
    from styleexp.cli.bake import main as bake
    from styleexp.cli.metrics import main as metrics
    from styleexp.cli.report import main as report

    (moved / "t.ply").unlink()
    if change == "changed":
        save("sphere", moved / "t.ply", detail=3000)
    for ended in (
        lambda: metrics(["run", str(moved / "run"), "--judge", "none"]),
        lambda: bake([str(moved / "run")]),
    ):
        assert ended() == 2
        told = capsys.readouterr().err
        assert told.count("\n") == 1, told
        assert f"its source '{moved / 't.ply'}' " in told
        assert "restore it, or start the run again." in told
    assert not (moved / "run" / "bake").exists()
    # A page shows what there is, and names what there is not.
    assert report([str(moved / "run")]) == 0
    told = capsys.readouterr().err
    assert "The source can't be shown" in told
    assert str(moved / "t.ply") in told


def test_a_board_tells_styles_of_one_name_apart(finished, tmp_path):
    from styleexp.experiments.metrics.board import _style_name

    one = {"config": {"style": {"path": "s.ply", "name": None}},
           "assets": {"style": {"sha256": "a" * 64}}}  # fmt: skip
    two = {**one, "assets": {"style": {"sha256": "b" * 64}}}
    seen = {}
    assert _style_name(one, seen) == "s.ply"
    assert _style_name(two, seen) == "s.ply (bbbbbbbb)"
    assert _style_name(one, seen) == "s.ply"


def test_a_figure_does_not_show_another_file_of_that_name(moved, tmp_path):
    from PIL import Image

    from styleexp.experiments.sweeps import figure
    from styleexp.runs import reading
    from styleexp.runs.jobs import Job

    run = reading.read(moved / "run")
    job = Job("0", tuple(run.overrides), run.folder, run.record["key"])
    config = figure._config(job, run)
    assert isinstance(figure._picture("source", config, run, 32), Image.Image)
    (moved / "t.ply").unlink()  # there is another t.ply in this folder
    assert figure._picture("source", config, run, 32) == "not found"


# ------------------------------------------------------------------------------------ the record


def test_a_record_names_every_file_that_was_read(finished):
    record = json.loads((finished / "run" / "run.json").read_text())
    for kind, name in (("source", "t.ply"), ("style", "s.ply")):
        assert record["assets"][kind]["path"] == str(finished / name)
        assert record["assets"][kind]["sha256"] == identity.sha256(finished / name)
    assert record["weights"] == {}  # random ones are no file


def test_weights_are_in_the_record(tmp_path, monkeypatch):
    from styleexp.config.compose import compose
    from styleexp.inputs import assets

    (tmp_path / "w").write_bytes(b"weights")
    monkeypatch.setattr(assets, "locate", lambda name, kind: tmp_path / "w")
    config = compose(["source=torus", "style=bubble", "encoder=vgg16", "metrics.judge=vgg16_edges"])
    found = origins.noted(config, ["vgg16", "vgg16_edges", None])["weights"]
    assert set(found) == {"vgg16", "vgg16_edges"}
    assert found["vgg16"]["path"] == str(tmp_path / "w")
    assert found["vgg16"]["sha256"] == identity.sha256(tmp_path / "w")


def test_a_gltf_is_known_by_its_buffers_too(tmp_path):
    path = tmp_path / "t.gltf"
    path.write_text(json.dumps({"buffers": [{"uri": "t.bin", "byteLength": 3}]}))
    (tmp_path / "t.bin").write_bytes(b"abc")
    before = identity.sha256(path)
    (tmp_path / "t.bin").write_bytes(b"abd")
    assert identity.sha256(path) != before
    path.write_text(json.dumps({"buffers": [{"uri": "data:x;base64,", "byteLength": 3}]}))
    assert len(identity.sha256(path)) == 64


def test_a_record_of_an_earlier_version_finds_its_file_by_its_content(tmp_path, monkeypatch):
    """Its path is relative: to the working folder, or the folder that the run's lies in."""
    from styleexp.config.compose import compose

    save("torus", tmp_path / "t.ply")
    monkeypatch.chdir(tmp_path)
    config = compose(["source.path=t.ply", "style=bubble"])
    told = {"path": "t.ply", "name": None, "sha256": identity.sha256(tmp_path / "t.ply")}
    record = {"assets": {"source": told}}
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    notes = []
    folder = tmp_path / "outputs" / "t-bubble"
    assert origins.find(record, config, "source", folder, notes.append) == tmp_path / "t.ply"
    assert len(notes) == 1
    assert "which has the same sha256" in notes[0]
    save("sphere", tmp_path / "t.ply")
    with pytest.raises(UserError, match=r"its source 't.ply' has changed .*looked for in '"):
        origins.find(record, config, "source", folder)
    record["assets"] = {}
    with pytest.raises(UserError, match=r"no sha256 of its source 't.ply': start the run again"):
        origins.find(record, config, "source", folder)


def test_a_plan_goes_on_from_another_folder(tmp_path):
    from styleexp.experiments.sweeps import manifest

    save("torus", tmp_path / "t.ply")
    text = "profile: smoke\noverrides: [encoder=vgg19_random, method=displacement_map]\n"
    text += "experiments:\n  - {name: a, overrides: [source.path=t.ply, style=rail]}\n"
    (tmp_path / "plan.yaml").write_text(text)
    assert run("styleexp.cli.sweep", "plan.yaml", "--folder", "out", cwd=tmp_path).returncode == 0
    (tmp_path / "elsewhere").mkdir()
    save("sphere", tmp_path / "elsewhere" / "t.ply")
    again = run("styleexp.cli.sweep", "../plan.yaml", "--folder", "../out",
                cwd=tmp_path / "elsewhere")  # fmt: skip
    assert again.returncode == 0, again.stderr
    assert (
        f"note: relative paths refer to '{tmp_path}', where this plan was started" in again.stdout
    )
    assert "done in" not in again.stdout
    assert [job["state"] for job in manifest.read(tmp_path / "out").values()] == ["done"]
    assert manifest.home(tmp_path / "out") == tmp_path
    assert os.listdir(tmp_path / "elsewhere") == ["t.ply"]
