"""The one reader of run folders: whatever they hold, it tells and doesn't raise."""

import ast
import json
import math

import numpy as np
import pytest

from styleexp.inputs import meshes, shapes
from styleexp.runs import finding, jobs, reading, results, untrusted
from styleexp.runs.jobs import Job
from styleexp.system.errors import UserError
from tests.helpers import ROOT

PACKAGE = ROOT / "src" / "styleexp"
GOOD = {"schema": 1, "overrides": ["a=1"], "config": {"source": {"name": "spot", "path": None}}}


def lay(folder, **files):
    """Write a run's files, by their names without the ending."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        path = folder / (f"{name}.jsonl" if name == "steps" else f"{name}.json")
        path = folder / "metrics.jsonl" if name == "steps" else path
        path.write_text(content if isinstance(content, str) else json.dumps(content))
    return folder


# -------------------------------------------------------------------------------- the final loss


@pytest.mark.parametrize(
    ("losses", "expected"),
    [([], None), ([3.0], 3.0), (range(19), 18.0), (range(20), 18.5), (range(40), 37.5)],
)
def test_the_final_loss_is_the_mean_of_the_last_tenth(losses, expected):
    assert reading.final_loss([{"loss": float(loss)} for loss in losses]) == expected


def test_a_cut_line_is_no_step(tmp_path):
    lines = [json.dumps({"step": n, "loss": float(n)}) for n in range(1, 10)]
    run = reading.read(lay(tmp_path, steps="\n".join([*lines, '{"step": 10, "lo'])))
    assert (len(run.steps), run.loss) == (9, 9.0)
    assert run.problems == ("metrics.jsonl: 1 damaged lines were left out.",)


def test_the_final_loss_of_a_diverged_run_is_no_number(tmp_path):
    lines = '{"step": 1, "loss": Infinity}\n{"step": 2, "loss": NaN}\n'
    assert math.isnan(reading.read(lay(tmp_path, steps=lines)).loss)


# ------------------------------------------------------------------------------- damaged and evil


DEEP = "[" * 100_000
EVIL = [
    "", "{", "[]", "3", "null", '"text"', DEEP, '{"a":' * 100_000, '{"a":' * 90 + "1" + "}" * 90,
    '{"config": "text"}', '{"config": {"source": "text", "style": 3}}', '{"config": []}',
    '{"overrides": "text", "versions": [], "assets": {"source": "text"}, "notes": 3}',
    '{"assets": {"source": {"sha256": ["x"]}}, "chosen": 1, "platform": []}',
    '{"config": {"source": {"path": ["x"], "name": {}}}, "overrides": [1, null, {}]}',
    '{"status": {}, "seconds": "long", "reason": {"a": 1}}', '{"schema": "x"}', '{"schema": 99}',
    '{"key": 3, "device": [], "config": {"a": {"b": [{"c": 1}]}}}', '{"a": ' + "1" * 400 + "}",
    '{"step": Infinity}', '{"step": NaN, "loss": "x"}', '{"step": 1, "loss": ' + "1" * 400 + "}",
    '{"jobs": 3}', '{"jobs": [1, "x", ["a=1"]]}', '{"jobs": [["a=1"]], "keys": 3}',
    '{"jobs": {"../x": {"state": "done"}, "/x": {"state": "done"}, "a": 3, "b": {}}}',
]  # fmt: skip
NAMES = ("run.json", "status.json", "metrics.json", "metrics.jsonl", "jobs.json", "manifest.json",
         ".hydra/overrides.yaml")  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("content", EVIL, ids=lambda text: text[:30])
def test_no_content_of_a_file_raises(name, content, tmp_path):
    run = lay(tmp_path / "0", run=GOOD, status={"status": "done"})
    for folder in (tmp_path, run):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(content)
    found = [*finding.find(tmp_path), reading.read(run), reading.of_job(Job("0", (), run, "key"))]
    assert len(found) >= 3
    for each in found:
        assert each.folder.is_relative_to(tmp_path)
        assert isinstance(each.status, str)
        assert isinstance(each.seconds, int | float | None)
        assert all(isinstance(value, int | float) for value in each.summary.values())
        assert all(isinstance(problem, str) for problem in each.problems)
        assert each.title
        assert each.command


def test_bytes_that_are_no_text_are_a_problem(tmp_path):
    lay(tmp_path, status={"status": "done"})
    (tmp_path / "run.json").write_bytes(b"\xff\xfe{}")
    (tmp_path / "metrics.jsonl").write_bytes(b'\xff\n{"step": 1, "loss": 2}\n')
    run = reading.read(tmp_path)
    assert "run.json cannot be read" in run.problems[0]
    assert run.loss == 2


def test_a_file_that_is_too_large_is_not_loaded(tmp_path, monkeypatch):
    monkeypatch.setattr(untrusted, "LARGEST", 10)
    run = reading.read(lay(tmp_path, run=GOOD, status="{}"))
    assert run.record == {}
    assert "more than" in run.problems[0]


def test_a_damaged_section_is_left_out_and_the_others_stay(tmp_path):
    run = reading.read(lay(tmp_path, run={**GOOD, "versions": ["x"]}, status={"status": "done"}))
    assert run.status == "done"
    assert run.config["source.name"] == "spot"
    assert run.problems == ("run.json was read without its versions, which is damaged.",)


def test_a_file_whose_name_looks_like_an_interpolation_is_taken_as_it_stands():
    assert not untrusted.holds_interpolation({"source": {"path": "${oc.env:HOME}.obj"}})
    assert untrusted.holds_interpolation({"source": {"name": "${oc.env:HOME}.obj"}})


def test_overrides_of_a_run_without_a_record_are_hydras(tmp_path):
    (tmp_path / ".hydra").mkdir()
    (tmp_path / ".hydra" / "overrides.yaml").write_text("- source=torus\n- a: 1\n- field.sigma=5\n")
    assert reading.read(tmp_path).overrides == ["source=torus", "field.sigma=5"]


# ------------------------------------------------------------------------------------ finding runs


def test_a_plan_names_no_folder_outside_of_its_own(tmp_path):
    lay(tmp_path / "secret", run=GOOD, status={"status": "done"})
    outside = {"../secret": {"state": "done"}, str(tmp_path / "secret"): {"state": "done"}}
    lay(tmp_path / "plan", manifest={"jobs": {**outside, "x/a": {"state": "missing"}}})
    assert [job.name for job in jobs.below(tmp_path / "plan")] == ["x/a"]
    assert [run.status for run in finding.find(tmp_path / "plan")] == ["missing"]


def test_another_programs_files_are_no_run(tmp_path):
    lay(tmp_path / "a", run={"scripts": {}})
    lay(tmp_path / ".hidden", run=GOOD)
    lay(tmp_path / "b", run="{")
    assert [run.folder.name for run in finding.find(tmp_path)] == ["b"]


# -------------------------------------------------------------------------------------- the result


def test_a_result_is_read_in_the_files_order(tmp_path):
    torus = shapes.make("torus", detail=300)
    values = np.linspace(-1, 1, len(torus.vertices))
    meshes.save_mesh(torus, torus.vertices, tmp_path / "result.ply", values)
    found = results.read(tmp_path / "result.ply")
    assert np.allclose(found.vertices, torus.vertices, atol=1e-6)
    assert (found.faces == torus.faces).all()
    assert np.allclose(found.displacement, values, atol=1e-6)


HEAD = "ply\nformat ascii 1.0\nelement vertex 3\n"
XYZ = "property float x\nproperty float y\nproperty float z\n"
FACE = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "cannot be read"),
        ("ply\nnonsense", "unterminated header"),
        (HEAD + "end_header\n", "no vertices"),
        (HEAD + XYZ + "end_header\n" + "0 0 0\n" * 3, "no faces"),
        (HEAD + XYZ + FACE + "0 0 0\n" * 3 + "2 0 1\n", "others than triangles"),
        (HEAD + XYZ + FACE + "0 0 0\n" * 3 + "3 0 1 9\n", "refers to vertex 9"),
        (HEAD + XYZ + FACE + "0 0 0\n" * 3 + "3 0 1 -1\n", "refers to vertex -1"),
    ],
)
def test_a_damaged_result_is_one_sentence(content, message, tmp_path):
    path = tmp_path / "result.ply"
    if content is not None:
        path.write_text(content)
    with pytest.raises(UserError, match=message) as refused:
        results.read(path)
    assert str(path) in str(refused.value)


# ---------------------------------------------------------------------------------------- layering


def imported(path):
    """Every module that a file imports, also inside functions."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (each.name for each in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{each.name}" for each in node.names)


@pytest.mark.parametrize(
    ("part", "above"), [("runs", ("experiments", "cli")), ("experiments", ("cli",))]
)
def test_nothing_imports_what_is_built_on_it(part, above):
    files = sorted((PACKAGE / part).rglob("*.py"))
    assert len(files) > 10
    for path in files:
        for name in imported(path):
            assert not name.startswith(tuple(f"styleexp.{each}" for each in above)), path
