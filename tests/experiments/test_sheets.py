"""Sheets for raters show what they should and nothing else; tables of ratings are read in full."""

import csv
import json
import math

import numpy as np
import pytest
from PIL import Image

from styleexp.cli.report import main
from styleexp.experiments.reports import sheets, study_results
from styleexp.inputs import meshes, shapes
from styleexp.runs import finding
from styleexp.system.errors import UserError


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Finished runs of two styles on one coarse source."""
    from styleexp.config.compose import compose
    from styleexp.experiments.execute import run

    folder = tmp_path_factory.mktemp("runs")
    for name, detail in (("torus", 2000), ("bubble", 5000), ("stripe", 5000)):
        mesh = shapes.make(name, detail)
        meshes.save_mesh(mesh, mesh.vertices, folder / f"{name}.ply")
    for style in ("bubble", "stripe"):
        overrides = [
            f"source.path={folder / 'torus.ply'}",
            f"style.path={folder / style}.ply",
            "method=displacement_map",
            "metrics.judge=none",
            "preview.resolution=48",
            "preview.turntable_frames=1",
            "report=false",
        ]
        out = folder / "board" / f"torus_{style}"
        out.mkdir(parents=True)
        assert run(compose(overrides), out, overrides) == 0
    return folder / "board"


@pytest.fixture(scope="module")
def out(runs, tmp_path_factory):
    out = tmp_path_factory.mktemp("study") / "out"
    assert main(["study", str(runs), "--sheets", str(out), "--seed", "3"]) == 0
    return out


def test_sheets_of_all_runs_and_of_both_catch_trials(out):
    key = json.loads((out / "key.json").read_text())["sheets"]
    trials = sorted(shown["trial"] for shown in key.values())
    assert trials == ["other style", "result", "result", "source"]
    pictures = sorted(path.name for path in (out / "sheets").glob("*.png"))
    assert pictures == [f"{name}.png" for name in sorted(key)]
    rows = list(csv.DictReader((out / "ratings.csv").open()))
    assert [row["sheet"] for row in rows] == sorted(key)
    # Raters get this folder: neither text nor the pictures' metadata names anything.
    told = (out / "sheets" / "questions.txt").read_text()
    metadata = "".join(str(Image.open(path).info) for path in (out / "sheets").glob("*.png"))
    for word in ("torus", "bubble", "stripe", "displacement", "catch", "seed"):
        assert word not in told + metadata


def columns(out, key, trial):
    """Source, style and result of the first sheet of that kind."""
    name = next(name for name, shown in key.items() if shown["trial"] == trial)
    picture = np.asarray(Image.open(out / "sheets" / f"{name}.png"), dtype=float)
    below = picture[30:]  # the labels
    return key[name], [below[:, at * sheets.SIZE : (at + 1) * sheets.SIZE] for at in range(3)]


def test_catch_trials_show_what_the_key_says(out):
    key = json.loads((out / "key.json").read_text())["sheets"]
    _, (source, _, result) = columns(out, key, "source")
    assert np.array_equal(source, result)
    _, (source, _, result) = columns(out, key, "result")
    assert np.abs(source - result).mean() > 0.5
    # The style of another run, beside a result that some other sheet shows with its own: from other
    # sides there, or raters recognise it.
    shown, (_, style, result) = columns(out, key, "other style")
    own = next(n for n, s in key.items() if s["run"] == shown["run"] and s["trial"] == "result")
    picture = np.asarray(Image.open(out / "sheets" / f"{own}.png"), dtype=float)[30:]
    assert np.abs(picture[:, 2 * sheets.SIZE :] - result).mean() > 0.5
    assert np.abs(picture[:, sheets.SIZE : 2 * sheets.SIZE] - style).mean() > 0.5


def test_order_depends_on_the_seed_alone(runs):
    found = [run for run in finding.find(runs) if run.status == "done"] * 8
    orders = [sheets.ordered(found, np.random.default_rng(seed)) for seed in (1, 1, 2)]
    assert orders[0] == orders[1] != orders[2]


def test_sheets_are_never_overwritten(out, runs, capsys):
    assert main(["study", str(runs), "--sheets", str(out)]) == 2
    assert "already has sheets" in capsys.readouterr().err


# ------------------------------------------------------------------------------ tables of ratings


def key_of(folder, **shown):
    items = {
        name: {"run": f"runs/{name}", "label": f"pair {name}", "trial": trial}
        for name, trial in shown.items()
    }
    content = {"schema": sheets.SCHEMA, "study": "abc", "seed": 0, "sheets": items}
    (folder / "key.json").write_text(json.dumps(content))


def table_of(folder, *rows, name="ratings.csv"):
    path = folder / name
    path.write_text("\n".join(["rater,who,sheet,match,craft", *rows]) + "\n")
    return path


def test_two_questions_and_catch_trials(tmp_path):
    pytest.importorskip("matplotlib", reason="matplotlib is not installed (extra report)")
    key_of(tmp_path, a="result", b="result", c="source", d="other style")
    path = table_of(
        tmp_path,
        *("ann,person,a,5,4", "ann,person,b,2,3", "ann,person,c,1,5", "ann,person,d,2,5"),
        *("bot,model,a,4,4", "bot,model,b,3,1", "bot,model,c,4,5", "bot,model,d,1,5"),
    )
    assert main(["study", "--analyse", str(path), "--out", str(tmp_path / "out")]) == 0
    rows = list(csv.DictReader((tmp_path / "out/fig9.csv").open()))
    assert [(row["run"], row["mean"], row["craft_mean"]) for row in rows] == [
        ("runs/a", "4.5", "4.0"),
        ("runs/b", "2.5", "2.0"),
    ]
    found = json.loads((tmp_path / "out/study.json").read_text())
    assert found["who"] == {"model": 1, "person": 1}
    assert found["mean"] == 3.5
    assert found["craft_mean"] == 3.0
    ann, bot = found["raters"]
    assert (ann["catch_source"], ann["catch_other_style"]) == (1, 2)
    assert bot["catch_source"] == 4
    assert ann["match"] == {
        "n": 2,
        "mean": 3.5,
        "distance_from_others": 1.0,
        "correlation_with_others": pytest.approx(1),
    }
    assert len(list(csv.DictReader((tmp_path / "out/ratings.csv").open()))) == 8


def test_rows_that_cannot_count_are_named(tmp_path):
    key_of(tmp_path, a="result", b="result")
    path = table_of(
        tmp_path,
        "ann,person,a,5,",
        "ann,person,a,4,3",  # a second match; the craft is new
        "ann,person,b,6,2",
        "ann,person,z,3,3",
        ",person,b,3,3",
        "ann,person,b,,",  # not rated
    )
    study = study_results.read([path])
    assert study.answers[0].ratings == {"match": {"a": 5}, "craft": {"a": 3, "b": 2}}
    faults = [told.split(": ", 1)[1] for told in study.left_out]
    assert faults == [
        "'ann' has rated sheet a before.",
        "its match '6' is not 1, 2, 3, 4 or 5.",
        "there is no sheet 'z'.",
        "it names no rater.",
    ]
    assert math.isnan(study.matrix("match", ["b"])[0, 0])


def test_tables_without_a_key_are_refused(tmp_path):
    with pytest.raises(UserError, match="give it with --key"):
        study_results.read([table_of(tmp_path, "ann,person,a,5,5")])


def test_figure_says_that_its_raters_are_not_people(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib", reason="matplotlib is not installed (extra report)")
    from matplotlib.axes import Axes

    titles = []
    original = Axes.set_title
    monkeypatch.setattr(
        Axes, "set_title", lambda self, text, **more: titles.append(text) or original(self, text)
    )
    key_of(tmp_path, a="result")
    path = table_of(tmp_path, "x,vision-language model,a,5,5", "y,vision-language model,a,4,5")
    study_results.analyse(study_results.read([path]), tmp_path)
    assert "NOT PEOPLE: 2 vision-language model" in titles[0]


def test_spearman_is_the_textbooks():
    # Ranks 1 2.5 2.5 4 against 1 3 2 4: Pearson's correlation of these.
    assert study_results.spearman(np.array([1, 2, 2, 5]), np.array([0, 9, 3, 11])) == pytest.approx(
        0.9487, abs=1e-4
    )
    assert math.isnan(study_results.spearman(np.ones(3), np.arange(3.0)))
