"""Several runs side by side, without a browser: what differs, and which vertices are compared."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from styleexp.cli.report import main
from styleexp.experiments.reports import compare_page, differing
from styleexp.experiments.reports.shown import Shape, Shown
from styleexp.inputs import shapes
from styleexp.inputs.meshes import save_mesh
from styleexp.runs import reading

EVIL = '<img src=x onerror="alert(1)">'


def write_run(folder, overrides, config, seconds=3.0, versions=None, **metrics):
    folder.mkdir(parents=True)
    record = {"schema": 1, "overrides": overrides, "config": config, "versions": versions or {}}
    (folder / "run.json").write_text(json.dumps(record))
    (folder / "status.json").write_text(json.dumps({"status": "done", "seconds": seconds}))
    (folder / "metrics.json").write_text(json.dumps(metrics))
    sphere = shapes.make("sphere", detail=300)
    strength = config.get("strength", 1.0)
    moved = sphere.vertices * (1 + 0.1 * strength)
    save_mesh(sphere, moved, folder / "result.ply", 0.1 * strength + 0 * moved[:, 0])


@pytest.fixture
def pair(tmp_path):
    part = {"source": {"name": "sphere"}, "style": {"name": "bubble"}, "field": {"sigma": 2.0}}
    for name, strength, order in (("a", 1.0, 3.0), ("b", 0.5, 2.5)):
        given = ["source=sphere", "style=bubble", f"strength={strength:g}", "field.sigma=2"]
        write_run(tmp_path / name, given, part | {"strength": strength}, order=order,
                  match=strength, bend=0.2)  # fmt: skip
    return tmp_path


def test_the_page_tells_what_differs_and_nothing_else(pair, capsys):
    assert main([str(pair / "a"), str(pair / "b")]) == 0
    path = pair / "compare-a-b.html"
    assert capsys.readouterr().out.strip() == str(path)
    text = path.read_text()
    assert "<title>sphere in the style of bubble: strength 1.0, 0.5</title>" in text
    rows = text.split("<h2")[1]
    assert "strength" in rows
    assert "field.sigma" not in rows
    assert "match ↑" in text
    assert "<strong>1</strong>" in text
    assert "(-0.5)" in text
    assert "Equal: bend, seconds." in text
    assert 'id="glb-result-1"' in text
    assert text.count('id="glb-source') == 1  # the same for both


def test_a_wicked_override_is_only_text(tmp_path):
    for name in ("a", "b"):
        write_run(tmp_path / name, [f"style={name}{EVIL}"], {})
    text = compare_page.write([tmp_path / "a", tmp_path / "b"]).read_text()
    assert EVIL not in text
    assert "&lt;img" in text


def test_measures_know_the_best_and_the_change(pair):
    runs = [reading.read(pair / name) for name in ("a", "b")]
    found, equal = compare_page.measures(runs)
    by_name = {each.name: each for each in found}
    assert [each.name for each in found] == ["match", "order"]
    assert by_name["match"].best == 1.0
    assert by_name["order"].best is None  # neither way is known to be better
    assert by_name["order"].change(1) == -0.5
    assert equal == ["bend", "seconds"]


def test_displacements_are_compared_in_radii_and_only_vertex_by_vertex():
    faces = np.array([[0, 1, 2]])
    shape = Shape(np.eye(3), faces)

    def seen(values, radius=1.0, of=shape):
        return Shown(result=of, displacement=np.array(values, float), radius=radius)

    first = seen([0, 0.1, 0.2])
    others = [
        seen([0, 0.4, 0.4], radius=2.0),
        seen([0, 0, 0, 0], of=Shape(np.eye(4)[:, :3], faces)),
        seen([0, 0, 0], of=Shape(np.eye(3), faces[:, ::-1])),
        Shown(),
    ]
    apart = compare_page.displacements_apart([first, *others])
    assert np.allclose(apart.values[1], [0, 0.1, 0])
    assert [value is None for value in apart.values] == [True, False, True, True, True]
    assert [reason.split()[0] for reason in apart.reasons] == ["C", "D", "E"]
    assert "4 vertices and A 3" in apart.reasons[0]
    assert 0 < apart.reach <= 0.1
    assert compare_page.displacements_apart([first, first]).reach == 0


def test_titles_say_what_differs():
    def run(source="cube", style="dots", config=None, **given):
        flat = {"source.name": source, "style.name": style, **(config or {})}
        told = [f"{key}={value}" for key, value in given.items()]
        return SimpleNamespace(overrides=told, config=flat, record={}, title=f"{source}, {style}",
                               part={"source": source, "style": style}.get)  # fmt: skip

    def title(*runs):
        return compare_page.title(runs)

    assert title(run(a="1"), run(a="2")) == "cube, dots: a 1, 2"
    assert title(run(a="1"), run()) == "cube, dots: a 1, not given"
    number = {"config": {"a": 1.0}}
    other = {"config": {"a": 2.0}}
    assert title(run(a="1", **number), run(a="1.0", b="x", **number)) == (
        "cube, dots: b not given, x"
    )
    assert title(run(**number), run(**other)) == "cube, dots: a 1.0, 2.0"
    assert title(run(), run()) == "cube, dots: the same configuration, inputs and versions"
    assert (
        title(run(style="a", seed="1"), run(style="b", seed="2")) == "cube: style a, b; seed 1, 2"
    )
    many = {key: ["1", "2"] for key in "abcde"}
    assert differing.told(many) == "a 1, 2; b 1, 2; c 1, 2; 2 more keys"


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["a", "nowhere"], "there is no folder 'nowhere'"),
        (["a", "."], "'.' is not a run's folder"),
        (["a", "b", "a"], "'a' is given twice"),
        (["a", "--out", "x.html"], "--out is for the page of several runs"),
        (["a", "b", "--notebooks"], "--notebooks takes a single folder"),
    ],
)
def test_it_refuses_with_one_sentence(arguments, told, pair, monkeypatch, capsys):
    monkeypatch.chdir(pair)
    assert main(arguments) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert told in lines[0]
    assert not list(pair.glob("*.html"))
