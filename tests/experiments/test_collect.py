"""Runs as a table: nothing is dropped, nothing is slow."""

import json

import pytest

from styleexp.experiments.reports import collect
from styleexp.experiments.reports.collect import write
from styleexp.experiments.sweeps import manifest, objective
from styleexp.system import locks
from styleexp.system.errors import UserError

pytest.importorskip("pandas", reason="needs the extra report")


def make_run(folder, status="done", **more):
    folder.mkdir(parents=True)
    record = {
        "schema": 1,
        "overrides": ["a=1"],
        "config": {"source": {"name": "spot", "path": None}, "optim": {"steps": 4, "rate": 2e-3},
                   "loss": {"layers": ["conv1_1", "conv2_1"]}, "shading": {"background": "white"}},
        "versions": {"torch": "2.13.0"},
        "device": "cpu",
        "assets": {"source": {"name": "spot", "sha256": "5fab"},
                   "style": {"name": "bubble", "sha256": None}},
    }  # fmt: skip
    record["config"]["optim"] |= more.pop("optim", {})
    record["config"]["shading"] |= more.pop("shading", {})
    (folder / "run.json").write_text(json.dumps(record))
    (folder / "status.json").write_text(json.dumps({"status": status, **more}))
    lines = [json.dumps({"step": n, "loss": float(n)}) for n in range(1, 41)]
    (folder / "metrics.jsonl").write_text("\n".join([*lines, '{"step": 41, "lo']) + "\n")
    return folder


def test_a_row_holds_everything(tmp_path):
    make_run(tmp_path / "a", seconds=12.5)
    (tmp_path / "a" / "metrics.json").write_text('{"style_distance": 0.31, "flipped_faces": 0}')
    (row,) = collect(tmp_path).to_dict("records")
    expected = {
        "run": "a",
        "status": "done",
        "seconds": 12.5,
        "device": "cpu",
        "loss": 38.5,  # steps 37 to 40; the line after them is cut off
        "config.source.name": "spot",
        "config.optim.steps": 4,
        "config.loss.layers": '["conv1_1", "conv2_1"]',
        "metric.style_distance": 0.31,
        "metric.flipped_faces": 0,
        "version.torch": "2.13.0",
        "asset.source": "5fab",
        "asset.style": "bubble",
    }
    assert {key: row[key] for key in expected} == expected


def test_failed_missing_dead_and_outdated_runs_are_rows(tmp_path):
    make_run(tmp_path / "sweep" / "0", seconds=1.0)
    make_run(tmp_path / "sweep" / "1", "failed", reason="no such mesh")
    (tmp_path / "sweep" / "jobs.json").write_text(json.dumps({"jobs": [["a=1"]] * 4}))
    make_run(tmp_path / "sweep" / "3", "running")
    plan = tmp_path / "plan"
    make_run(plan / "x" / "old", seconds=1.0)
    states = {"x/old": "outdated", "x/new": "missing", "x/gone": "outdated"}
    jobs = {name: {"state": state, "experiment": "x"} for name, state in states.items()}
    manifest._write(plan, jobs)
    make_run(tmp_path / "alone", "interrupted", step=3)
    with locks.hold(make_run(tmp_path / "now", "running")):
        frame = collect(tmp_path)
    found = dict(zip(frame["run"], frame["status"], strict=True))
    assert found == {
        "alone": "interrupted",
        "now": "running",
        "plan/x/new": "missing",
        "plan/x/old": "outdated",
        "sweep/0": "done",
        "sweep/1": "failed",
        "sweep/2": "missing",
        "sweep/3": "died",
    }
    reasons = frame.set_index("run")["reason"]
    assert reasons["sweep/1"] == "no such mesh"


def test_what_cannot_be_read_is_a_row_that_says_so(tmp_path):
    make_run(tmp_path / "a", seconds=1.0)
    (tmp_path / "a" / "run.json").write_text("{")
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "status.json").write_text("[]")
    frame = collect(tmp_path).set_index("run")
    assert frame.loc["a", "status"] == "done"
    assert "run.json cannot be read" in frame.loc["a", "reason"]
    assert frame.loc["b", "status"] == "unreadable"


def test_files_hold_the_table(tmp_path):
    import pandas

    make_run(tmp_path / "a", seconds=1.0, shading={"background": 0.5}, optim={"rate": 1})
    make_run(tmp_path / "b", "failed", reason="x")
    frame = collect(tmp_path)
    csv, parquet = write(frame, tmp_path)
    again = pandas.read_parquet(parquet)
    assert list(again.columns) == list(pandas.read_csv(csv).columns) == list(frame.columns)
    assert again["config.optim.rate"].tolist() == [1.0, 0.002]
    assert again["config.shading.background"].tolist() == ["0.5", "white"]  # mixed: text
    assert again["run"].tolist() == ["a", "b"]


def test_an_empty_folder_is_an_empty_table_and_none_is_a_mistake(tmp_path):
    assert len(collect(tmp_path)) == 0
    assert "status" in collect(tmp_path).columns
    with pytest.raises(UserError, match="no folder"):
        collect(tmp_path / "none")


def test_a_search_wants_a_match_with_enough_craft(tmp_path, monkeypatch):
    monkeypatch.setenv(objective.LEAST_CRAFT, "3")

    def value(**metrics):
        (tmp_path / "metrics.json").write_text(json.dumps(metrics))
        return objective.objective(tmp_path)

    assert value(match=4.0, craft=3.5) == 4.0
    assert value(match=4.0, craft=2.5) == pytest.approx(3.0)
    with pytest.raises(UserError, match="craft"):
        value(match=4.0)
