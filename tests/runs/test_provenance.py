"""What a run was made with: plugins and this package by their code, and a run made again."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
import textwrap

import pytest

from styleexp.experiments import reproduce
from styleexp.plugins import code
from styleexp.runs import identity, provenance, reading
from styleexp.system import locks
from styleexp.system.errors import UserError
from tests.helpers import ROOT, warm

TINY = (
    "profile=smoke", "method=displacement_map", "encoder=vgg19_random", "report=false",
    "preview.resolution=32", "preview.turntable_frames=1", "threads=1",
)  # fmt: skip
PLUGIN = """
    from dataclasses import dataclass
    from styleexp.plugins import Spec, StyleConfig

    @dataclass
    class Options(StyleConfig):
        period: int = 16

    def style(options):
        import numpy as np
        row = (np.arange(96) // options.period % 2).astype(np.float32)
        return np.broadcast_to(row[:, None, None], (96, 96, 3)).copy()

    STRIPED = Spec("striped", "a square wave", Options, style)
"""
SWEEP = ("-m", "source=torus", "style=bubble,striped", *TINY, "hydra.sweep.dir=all")


def styleexp(*arguments, cwd):
    env = warm.coarse(**os.environ, STYLEEXP_PLUGINS="style=striped:STRIPED")
    return warm.run("-m", "styleexp", *arguments, cwd=cwd, env=env)


def record(folder):
    return json.loads((folder / "run.json").read_text())


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    """A sweep of two jobs, the second of a plugin; done."""
    cwd = tmp_path_factory.mktemp("swept")
    (cwd / "striped.py").write_text(textwrap.dedent(PLUGIN))
    done = styleexp(*SWEEP, cwd=cwd)
    assert done.returncode == 0, done.stderr
    return cwd


def test_the_record_has_the_code_of_plugins_and_of_the_package(swept):
    own, plugged = record(swept / "all/0"), record(swept / "all/1")
    assert own["plugins"] == []
    (used,) = plugged["plugins"]
    assert used["file"] == str(swept / "striped.py")
    assert used["sha256"] == hashlib.sha256((swept / "striped.py").read_bytes()).hexdigest()
    assert own["code"] == plugged["code"] == code.own()
    if (ROOT / ".git").exists() and shutil.which("git"):
        head = subprocess.run(
            ["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True
        )
        assert own["code"]["commit"] == head.stdout.strip()
        assert isinstance(own["code"]["dirty"], bool)


def test_an_edited_plugin_runs_what_it_is_in_again_and_nothing_else(swept, tmp_path):
    shutil.copytree(swept, tmp_path, dirs_exist_ok=True)
    text = (tmp_path / "striped.py").read_text()
    before = [record(tmp_path / f"all/{job}")["key"] for job in (0, 1)]
    (tmp_path / "striped.py").write_text(text.replace("int = 16", "int = 12"))  # a default, too
    done = styleexp(*SWEEP, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("already done") == 1
    assert "was of other code of style=striped: running it again" in done.stdout
    after = [record(tmp_path / f"all/{job}") for job in (0, 1)]
    assert after[0]["key"] == before[0]
    assert after[1]["key"] != before[1]
    assert after[1]["config"]["style"]["period"] == 12


def test_a_module_stands_for_its_package_and_a_file_for_itself(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    package = tmp_path / "lab_of_code"
    (package / "deep").mkdir(parents=True)
    for name in ("__init__.py", "deep/__init__.py", "deep/spec.py", "late.py", "notes.txt"):
        (package / name).write_text("")
    (tmp_path / "lone_lab.py").write_text("x = 1\n")
    import importlib

    for name in ("lab_of_code.deep.spec", "lone_lab"):
        importlib.import_module(name)

    def found(*names):
        return code.of_modules.__wrapped__(frozenset(names))

    try:
        assert found("lone_lab") == hashlib.sha256(b"x = 1\n").hexdigest()
        before = found("lab_of_code.deep.spec")
        (package / "notes.txt").write_text("no code")
        assert found("lab_of_code.deep.spec") == before
        (package / "late.py").write_text("y = 2\n")  # is imported when it is used
        assert found("lab_of_code.deep.spec") != before
        assert found("sys") is None
    finally:
        for name in [n for n in sys.modules if n.split(".")[0] in ("lab_of_code", "lone_lab")]:
            del sys.modules[name]


def test_a_run_of_our_own_parts_keeps_the_key_it_had(swept):
    """Records of before plugins' code was part of it must not become stale."""
    told = record(swept / "all/0")
    files = {kind: asset["sha256"] for kind, asset in told["assets"].items()}
    content = {
        "config": identity.essence(told["config"]), "files": files,
        "by": told["versions"]["styleexp"],
    }  # fmt: skip
    text = json.dumps(content, sort_keys=True)
    assert told["key"] == hashlib.sha256(text.encode()).hexdigest()


def test_differences_are_of_what_both_records_tell():
    then = {
        "versions": {"torch": "2.0", "gone": "1"},
        "code": {"commit": "a" * 40, "dirty": True, "sha256": "0" * 64},
        "device": "cpu",
    }
    now = {"versions": {"torch": "2.1", "new": "1"}, "code": {"commit": "a" * 40, "dirty": False}}
    assert [tuple(each) for each in provenance.differences(then, now)] == [
        ("torch", "2.0", "2.1"),
        ("commit", f"{'a' * 12} with changes", "a" * 12),
    ]


# ---------------------------------------------------------------------------------- made again


def test_a_run_is_made_again_and_left_as_it_is(swept, tmp_path):
    before = {path: path.read_bytes() for path in (swept / "all/1").rglob("*") if path.is_file()}
    done = styleexp("reproduce", "all/1", "--out", tmp_path / "again", cwd=swept)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "made with what it was made with then" in done.stdout
    assert "vertices: the same bits" in done.stdout
    assert done.stdout.rstrip().endswith("reproduced: all is equal")
    assert {path: path.read_bytes() for path in before} == before
    assert record(tmp_path / "again")["command"] == ["styleexp", "reproduce", "all/1"]


def test_a_run_that_still_goes_is_not_made_again(swept, tmp_path):
    shutil.copytree(swept / "all/0", tmp_path / "goes")
    (tmp_path / "goes/status.json").write_text('{"schema": 1, "status": "running"}')
    with (
        locks.hold(tmp_path / "goes"),
        pytest.raises(UserError, match="still running; wait until it is done"),
    ):
        reproduce.reproduce(tmp_path / "goes", tmp_path / "again")
    assert not (tmp_path / "again").exists()


def test_what_differs_is_told_one_by_one(swept, tmp_path, capsys, coarse_shapes):
    from styleexp.config import compose
    from styleexp.inputs.meshes import ply

    old, new = tmp_path / "old", tmp_path / "new"
    for folder in (old, new):
        shutil.copytree(swept / "all/0", folder)
    config = compose.recorded(record(old)["config"])

    def told():
        ended = reproduce.tell_results(reading.read(old), reading.read(new), config)
        return ended, capsys.readouterr().out

    assert told()[0] == reproduce.SAME
    metrics = json.loads((new / "metrics.json").read_text())
    (new / "metrics.json").write_text(json.dumps(metrics | {"bend": 99.5}))
    ended, out = told()
    assert ended == reproduce.DIFFERENT
    assert f"{metrics['bend']!r} then, 99.5 now" in out
    assert out.count("equal\n") == len(metrics) - 1
    content = (new / "result.ply").read_bytes()
    table = ply.parse(content)
    x = float(table.elements["vertex"]["x"][0])
    head = content.index(b"end_header\n") + len(b"end_header\n")
    kind = table.elements["vertex"]["x"].dtype
    moved = type(table.elements["vertex"]["x"][0])(x + 0.25).tobytes()
    (new / "result.ply").write_bytes(content[:head] + moved + content[head + kind.itemsize :])
    ended, out = told()
    assert ended == reproduce.DIFFERENT
    assert "vertices: 1 of " in out
    assert "radii of the source" in out
    assert "not reproduced" in out


def test_a_run_whose_plugin_or_input_has_changed_is_refused(swept, tmp_path, monkeypatch):
    from styleexp.inputs import meshes, shapes

    monkeypatch.setattr(identity, "plugin_code", lambda config: {"style=striped": "another"})
    monkeypatch.setattr(reproduce.origins, "restored", lambda *given: None)
    with pytest.raises(UserError, match=r"the code of the plugin style=striped .* has changed"):
        reproduce.reproduce(swept / "all/1", tmp_path / "again")
    monkeypatch.undo()
    told = record(swept / "all/0")
    torus = shapes.make("torus", detail=500)
    meshes.save_mesh(torus, torus.vertices, tmp_path / "t.ply")
    told["assets"]["source"] = {"name": None, "path": str(tmp_path / "t.ply"), "sha256": "0" * 64}
    told["config"]["source"] |= {"name": None, "path": str(tmp_path / "t.ply")}
    shutil.copytree(swept / "all/0", tmp_path / "run")
    (tmp_path / "run/run.json").write_text(json.dumps(told))
    with pytest.raises(UserError, match=r"cannot reproduce .* has changed since the run began"):
        reproduce.reproduce(tmp_path / "run", tmp_path / "again")
    assert not (tmp_path / "again").exists()


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["nowhere"], "there is no folder 'nowhere'"),
        (["all"], "it has no run.json"),
        (["all/0", "--out", "all/0/x"], "in the run's own folder"),
        (["all/0", "--out", "all"], "isn't empty"),
    ],
)
def test_it_refuses_with_one_sentence(arguments, told, swept, monkeypatch):
    from styleexp.cli import reproduce as command

    monkeypatch.chdir(swept)
    with pytest.raises(UserError, match=told):
        command.main(arguments)


def test_the_page_shows_the_code_and_what_a_run_was_resumed_with(tmp_path):
    from styleexp.experiments.reports import page

    digest = "c" * 64
    told = {
        "versions": {"torch": "2.0"},
        "code": {"commit": "a" * 40, "dirty": True, "sha256": "b" * 64},
        "plugins": [{"kind": "loss", "name": "<b>", "version": "1.2", "distribution": "lab",
                     "file": "/x/lab.py", "sha256": digest, "origin": "lab (lab:LOSS)"}],
        "resumed": [{"time": "2026-01-31", "differs": {"torch": ["2.0", "2.1"]}}],
    }  # fmt: skip
    (tmp_path / "run.json").write_text(json.dumps({"config": {}, "overrides": [], **told}))
    text = page.rewrite(tmp_path).read_text()
    for shown in (digest, "lab 1.2, /x/lab.py", "a" * 12 + " with changes", "torch 2.0 (then 2.1)"):
        assert shown in text
    assert "<b>" not in text
    damaged = {"plugins": [3], "code": [], "resumed": [{"time": 3}], "weights": {"vgg": 1}}
    (tmp_path / "run.json").write_text(json.dumps({"config": {}, "overrides": [], **damaged}))
    assert len(reading.read(tmp_path).faults) == 4
    page.rewrite(tmp_path)
