"""Files and folders from strangers: nothing in them is run, and nothing outside of them is read."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from styleexp.config import allow_list, compose
from styleexp.system.errors import UserError
from tests.helpers import ROOT, warm
from tests.helpers.trying import one_encoder

SOURCES = sorted((ROOT / "src").rglob("*.py"))


def calls():
    """Every call in the package: file, line, dotted name, keyword arguments."""
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call):
                keywords = {each.arg: ast.unparse(each.value) for each in node.keywords}
                yield path.name, node.lineno, ast.unparse(node.func), keywords


def test_nothing_reads_pickles_or_runs_text():
    forbidden = {"eval", "exec", "os.system", "os.popen", "yaml.load", "yaml.unsafe_load",
                 "pickle.load", "pickle.loads", "joblib.load", "pandas.read_pickle"}  # fmt: skip
    seen = 0
    for file, line, name, keywords in calls():
        where = f"{file}:{line}: {name}"
        assert name not in forbidden, where
        assert name.rsplit(".", 1)[-1] not in ("extractall", "extract"), where
        assert keywords.get("shell") in (None, "False"), where
        assert keywords.get("allow_pickle") in (None, "False"), where
        assert keywords.get("trust_remote_code") in (None, "False"), where
        if name == "torch.load":
            assert keywords.get("weights_only") == "True", where
            seen += 1
    assert seen == 1  # torchvision's published file, its sha256 checked
    for path in SOURCES:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        names = {a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names}
        assert not names & {"pickle", "dill", "cloudpickle", "marshal", "shelve"}, path


def test_only_one_resolver_is_ours_and_it_only_names_folders():
    registered = [(f, n) for f, _, n, _ in calls() if n.endswith("register_new_resolver")]
    assert registered == [("compose.py", "OmegaConf.register_new_resolver")]


EVIL = {
    "callback": "hydra:\n  callbacks:\n    x:\n      _target_: victim.run\n",
    "logging": "hydra:\n  job_logging:\n    version: 1\n    formatters:\n      x:\n"
               "        (): victim.run\n",
    "handler": "hydra:\n  hydra_logging:\n    version: 1\n    handlers:\n      x:\n"
               "        class: victim.run\n",
    "launcher": "hydra:\n  launcher:\n    _target_: victim.run\n",
}  # fmt: skip


@pytest.mark.parametrize("kind", EVIL)
def test_what_a_configuration_would_call_is_named(kind):
    import yaml
    from omegaconf import OmegaConf

    with pytest.raises(UserError, match=r"victim\.run, which would run code"):
        allow_list.check(OmegaConf.create(yaml.safe_load(EVIL[kind])))


@pytest.mark.parametrize("kind", ["callback", "logging"])
def test_a_configuration_file_can_not_run_code(kind, tmp_path):
    """An experiment from a stranger, taken in with --config-dir, by the real command."""
    (tmp_path / "victim.py").write_text(
        "from pathlib import Path\nPath('was-run').touch()\ndef run(*a, **k): pass\n"
    )
    (tmp_path / "conf" / "experiment").mkdir(parents=True)
    head = "# @package _global_\n"
    (tmp_path / "conf" / "experiment" / "evil.yaml").write_text(head + EVIL[kind])
    done = warm.run(
        "-m", "styleexp", "--config-dir", "conf", "+experiment=evil", "source=torus",
        "style=bubble", cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(tmp_path)},
    )  # fmt: skip
    assert done.returncode == 2, done.stderr
    assert "victim.run" in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "was-run").exists()


def test_our_own_targets_are_allowed():
    import hydra
    from omegaconf import OmegaConf

    compose.register()
    with hydra.initialize_config_module("styleexp.conf", version_base="1.3"):
        config = hydra.compose("config", return_hydra_config=True, overrides=[])
    allow_list.check(config)
    found = {value for _, value in allow_list._named(OmegaConf.to_container(config.hydra))}
    assert "styleexp.experiments.sweeps.report.OnSweep" in found


def test_a_runs_record_is_values_alone(tmp_path):
    from dataclasses import asdict

    from styleexp.experiments.execute import resume

    record = {"schema": 1, "config": asdict(compose.compose(["source=torus", "style=bubble"]))}
    assert compose.recorded(record["config"]).source.name == "torus"
    record["config"]["source"]["name"] = "${oc.env:HOME}"
    (tmp_path / "run.json").write_text(json.dumps(record))
    with pytest.raises(UserError, match="interpolation"):
        resume(tmp_path)
    for wrong in (None, [], "text", {"optim": 3}, {"no such key": 1}):
        (tmp_path / "run.json").write_text(json.dumps({"schema": 1, "config": wrong}))
        with pytest.raises(UserError, match="not a valid configuration for this version"):
            resume(tmp_path)


INTERPOLATIONS = {
    "a value": {"source": {"name": "${oc.env:HOME}"}},
    "a key": {"source": {"${oc.env:HOME}": 1}},
    "in a list": {"loss": {"layers": ["conv1_1", "${oc.env:HOME}"]}},
    "a plugin's part": {"logger": {"x": {"note": "a ${oc.decode:1} b"}}},
}


@pytest.mark.parametrize("where", INTERPOLATIONS)
def test_a_record_with_an_interpolation_is_refused_by_everything_that_reads_runs(where, tmp_path):
    pytest.importorskip("pandas", reason="needs the extra report")
    from dataclasses import asdict

    from omegaconf import OmegaConf

    from styleexp.experiments import agreement
    from styleexp.experiments.execute import resume
    from styleexp.experiments.metrics import board
    from styleexp.experiments.reports import collect, page, shown
    from styleexp.experiments.sweeps import figure, report
    from styleexp.runs import finding, jobs, reading
    from styleexp.runs.records import RunFolder, describe

    config = compose.compose(["source=torus", "style=bubble", "preview.resolution=64"])
    record = describe(config, [], ["styleexp"])
    evil = OmegaConf.merge(asdict(config), INTERPOLATIONS[where])
    record["config"] = OmegaConf.to_container(evil, resolve=False)
    run = tmp_path / "0"
    run.mkdir()
    (run / "run.json").write_text(json.dumps(record))
    (run / "status.json").write_text('{"status": "done"}')
    (tmp_path / "jobs.json").write_text(
        json.dumps({"jobs": [["source=torus", "style=bubble"]], "keys": [record["key"]]})
    )

    found = reading.read(run)
    assert (found.record, found.config) == ({}, {})
    assert any("holds an interpolation" in problem for problem in found.problems)
    for use in (
        resume,
        lambda at: reading.recorded(at, "use"),
        lambda at: board.measure_run(at, None),
        lambda at: agreement.held_out_losses(at, []),
    ):
        with pytest.raises(UserError, match="holds an interpolation"):
            use(run)
    (run / "result.ply").touch()
    with pytest.raises(UserError, match="can't be used"):
        shown.read_moved(run)
    assert RunFolder(run).unfinished(record) is None
    (job,) = jobs.planned(tmp_path)
    assert reading.of_job(job).status == "unreadable"
    assert [each.status for each in finding.find(tmp_path)] == ["unreadable"]
    (row,) = collect(tmp_path).to_dict("records")
    assert row["status"] == "unreadable"
    assert "holds an interpolation" in row["reason"]
    assert not [column for column in row if column.startswith("config.")]
    assert agreement.compare(tmp_path)[0]["status"] == "unreadable"
    figure.write_figure([job], RunFolder(tmp_path))
    report.finish(tmp_path)
    text = page.rewrite(run).read_text(encoding="utf-8")
    assert "holds an interpolation" in text
    home = os.environ.get("HOME", "/root")
    for path in (*tmp_path.glob("*.csv"), run / "report.html", run / "status.json"):
        assert home not in path.read_text(encoding="utf-8").replace(str(tmp_path), "")


def test_a_page_of_a_strangers_run_shows_no_file_that_the_run_did_not_use(tmp_path):
    """run.json may name any mesh of ours; without its sha256 it is not put on the page."""
    from dataclasses import asdict

    from styleexp.experiments.reports import shown
    from styleexp.inputs import meshes, shapes
    from styleexp.runs import reading

    secret = tmp_path / "secret.ply"
    torus = shapes.make("torus", detail=300)
    meshes.save_mesh(torus, torus.vertices, secret)
    config = asdict(compose.compose(["style=bubble", f"source.path={secret}"]))
    run = tmp_path / "run"
    run.mkdir()
    (run / "run.json").write_text(json.dumps({"schema": 1, "config": config, "overrides": []}))
    (run / "status.json").write_text('{"status": "done"}')
    found = shown.read(reading.read(run))
    assert found.source is None
    assert any("source can't be shown" in told for told in found.missing)


def test_a_checkpoint_with_a_pickle_inside_is_damaged_not_run(tmp_path):
    import pickle

    from styleexp.config.build import prepare
    from styleexp.runs.reading import recorded
    from styleexp.runs.records import RunFolder

    class Evil:
        def __reduce__(self):
            return Path.touch, (tmp_path / "was-run",)

    (tmp_path / "checkpoint.safetensors").write_bytes(pickle.dumps(Evil()))
    with one_encoder():
        method, scene = prepare(
            compose.compose(
                [
                    "method=robust",
                    "profile=smoke",
                    "encoder=vgg19_random",
                    "source=torus",
                    "style=bubble",
                ]
            )
        )
    state = method.start(scene)
    told = RunFolder(tmp_path).load_checkpoint(state)
    assert told is not None
    assert "damaged" in told
    assert state.step == 0
    assert not (tmp_path / "was-run").exists()
    with pytest.raises(UserError):
        recorded(tmp_path, "resume")


def test_plugins_come_from_entry_points_or_the_variable_alone(tmp_path):
    """A module that lies about in the working folder is not imported."""
    for name in ("styleexp_plugin_evil.py", "sitecustomize_.py", "plugins.py", "conf.py"):
        (tmp_path / name).write_text("open('was-run', 'w').close()\n")
    code = "from styleexp import plugins; plugins.everything()"
    subprocess.run([sys.executable, "-P", "-c", code], cwd=tmp_path, check=True)
    assert not (tmp_path / "was-run").exists()


def test_a_page_of_a_strangers_run_holds_its_texts_as_texts(tmp_path):
    """Wherever run.json and status.json may hold text; test_reports_browser.py has a mesh of
    such a name in a real browser."""
    from styleexp.experiments.reports import page

    evil = "</script></code><script>window.ran=1</script><img src=x onerror=window.ran=1>"
    record = {
        "schema": 1,
        "overrides": [f"source={evil}"],
        "command": [evil],
        "config": {"source": {"name": evil, "path": evil}, evil: evil},
        "notes": [evil],
        "versions": {evil: evil},
        "platform": {evil: evil},
        "chosen": {evil: evil},
        "assets": {"source": {"name": evil, "path": evil, "sha256": evil}},
        "started": evil,
        "threads": evil,
    }
    (tmp_path / "run.json").write_text(json.dumps(record))
    (tmp_path / "status.json").write_text(json.dumps({"status": "failed", "reason": evil}))
    (tmp_path / "metrics.json").write_text(json.dumps({evil: 1.0}))
    text = page.rewrite(tmp_path).read_text(encoding="utf-8")
    assert text.count("window.ran") > 5
    assert "<script>window" not in text
    assert "<img src=x" not in text
