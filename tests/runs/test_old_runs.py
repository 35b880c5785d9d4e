"""Run folders that earlier and later versions wrote: read as they are, or refused in a sentence."""

import json
import re
from dataclasses import asdict
from pathlib import Path

import pytest

from styleexp.cli.main import main as run_command
from styleexp.cli.metrics import main as metrics_command
from styleexp.cli.report import main as report_command
from styleexp.cli.sweep import main as sweep_command
from styleexp.config.compose import compose, recorded
from styleexp.experiments.execute import resume
from styleexp.inputs import meshes, shapes
from styleexp.runs import reading
from styleexp.runs.schema import SCHEMA
from styleexp.system.errors import UserError

OLD = json.loads((Path(__file__).parent / "old_runs.json").read_text())
"""What two commits wrote, by their hashes: the first that had run folders, and a later one."""
FIRST, LATER = "97fcbcc", "9437844"
pytestmark = pytest.mark.filterwarnings("ignore:the encoder 'vgg19_random'")


@pytest.fixture
def old(tmp_path, monkeypatch):
    """A function that lays out the folder of a commit, its source and style beside it."""
    monkeypatch.chdir(tmp_path)
    saved = {}
    for name, detail in (("sphere", 300), ("bubble", 600)):
        saved[name] = shapes.make(name, detail=detail)
        meshes.save_mesh(saved[name], saved[name].vertices, tmp_path / f"{name}.ply")

    def lay(commit, folder="old", **changed):
        from styleexp.inputs.assets import sha256

        at = tmp_path / folder
        at.mkdir(parents=True)
        files = json.loads(json.dumps(OLD[commit]))
        for role, name in (("source", "sphere"), ("style", "bubble")):
            files["run.json"]["assets"][role]["sha256"] = sha256(f"{name}.ply")
        files["run.json"] |= changed
        lines = "".join(json.dumps(line) + "\n" for line in files.pop("metrics.jsonl"))
        (at / "metrics.jsonl").write_text(lines)
        for name, content in files.items():
            (at / name).write_text(json.dumps(content))
        sphere = saved["sphere"]
        meshes.save_mesh(
            sphere, sphere.vertices * 1.01, at / "result.ply", 0 * sphere.vertices[:, 0]
        )
        return at

    return lay


def refused(capsys, ended):
    """The one line of a refusal."""
    out, err = capsys.readouterr()
    assert ended == 2, out + err
    assert "Traceback" not in err
    lines = [line for line in err.splitlines() if not line.startswith("warning")]
    assert len(lines) == 1, err
    return lines[0]


@pytest.mark.parametrize("commit", [FIRST, LATER])
def test_pages_and_tables_read_them(commit, old, capsys, tmp_path):
    at = old(commit, "sweep/0")
    assert report_command([str(at)]) == 0
    page = (at / "report.html").read_text()
    assert "bubble" in page
    assert "has layout" not in page
    assert report_command([str(tmp_path / "sweep")]) == 0
    run = reading.read(at)
    steps = OLD[commit]["metrics.jsonl"]
    assert (run.status, run.loss) == ("done", pytest.approx(steps[-1]["loss"]))
    assert run.config["field.sigma"] == OLD[commit]["run.json"]["config"]["field"]["sigma"]


def test_a_run_without_a_version_of_its_layout_is_of_the_first(old):
    at = old(LATER)
    record = json.loads((at / "run.json").read_text())
    del record["schema"]
    (at / "run.json").write_text(json.dumps(record))
    assert reading.read(at).status == "done"
    assert reading.read(at).problems == ()


def test_one_is_measured_and_resumed_from_a_checkpoint_without_a_digest(old, capsys):
    from safetensors.torch import load_file, save_file

    at = old(LATER, versions={**OLD[LATER]["run.json"]["versions"], "torch": "2.0.1"})
    assert metrics_command(["run", str(at), "--judge", "none"]) == 0
    assert resume(at) == 0  # there is no checkpoint: from the first step on
    told = capsys.readouterr().out
    assert "the run was started with " in told
    assert "torch 2.0.1 (now " in told
    whole = (at / "result.ply").read_bytes()
    checkpoint = at / "checkpoint.previous.safetensors"
    (at / "checkpoint.safetensors").unlink()
    save_file(load_file(checkpoint), checkpoint, {"schema": "1", "step": "2"})
    assert resume(at) == 0
    assert "resuming at step 2 of 3" in capsys.readouterr().out
    assert (at / "result.ply").read_bytes() == whole


def test_options_that_are_no_more_are_named(old, capsys):
    at = old(FIRST)
    with pytest.raises(UserError, match=r"'smoothness'.*use the version of styleexp that wrote it"):
        resume(at)
    told = refused(capsys, metrics_command(["run", str(at), "--judge", "none"]))
    assert "'smoothness'" in told


def test_those_of_later_versions_are_refused_and_left_alone(old, capsys, monkeypatch, tmp_path):
    at = old(LATER, "sweep/0", schema=SCHEMA + 1)
    before = {path.name: path.read_bytes() for path in at.iterdir()}
    says = rf"its layout is {SCHEMA + 1}, but this version of styleexp reads layouts up to {SCHEMA}"
    with pytest.raises(UserError, match=rf"cannot resume.*{says}"):
        resume(at)
    assert re.search(says, refused(capsys, metrics_command(["run", str(at), "--judge", "none"])))
    assert re.search(says, refused(capsys, report_command([str(at)])))
    given = ["styleexp", *OLD[LATER]["run.json"]["overrides"], f"hydra.run.dir={at}"]
    monkeypatch.setattr("sys.argv", given)
    with pytest.raises(SystemExit) as ended:
        run_command()
    assert re.search(says, refused(capsys, ended.value.code))
    for name, content in before.items():
        assert (at / name).read_bytes() == content, name


def test_a_sweep_shows_the_others_beside_one_of_a_later_version(old, capsys, tmp_path):
    old(LATER, "sweep/0")
    at = old(LATER, "sweep/1", schema=SCHEMA + 1)
    assert report_command([str(tmp_path / "sweep")]) == 0
    assert "reads layouts up to" in (tmp_path / "sweep" / "report.html").read_text()
    run = reading.read(at)
    assert run.status == "newer"
    assert "reads layouts up to" in run.reason


def test_a_plan_does_not_touch_a_job_of_a_later_version(old, capsys, tmp_path):
    from styleexp.experiments.sweeps import plan

    text = "profile: smoke\noverrides: [method=robust, encoder=vgg19_random]\nexperiments:\n"
    (tmp_path / "plan.yaml").write_text(text + "  - {name: a, pairs: [[torus, rail]]}\n")
    ((job,),) = plan.jobs(plan.read(tmp_path / "plan.yaml"), tmp_path / "out").values()
    old(LATER, f"out/{job.name}", schema=SCHEMA + 1)
    told = refused(capsys, sweep_command(["plan.yaml", "--folder", "out"]))
    assert job.name in told
    assert "reads layouts up to" in told


def test_options_that_a_record_is_older_than_are_what_it_was_made_with():
    config = recorded(OLD[LATER]["run.json"]["config"])
    assert (config.field.start, config.field.unfold, config.shading.lights) == ("source", False, 1)
    assert not config.optim.unit_gradient
    now = asdict(compose(["source=sphere", "style=bubble"]))
    assert asdict(recorded(now)) == now
