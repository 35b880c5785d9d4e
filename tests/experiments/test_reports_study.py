"""The user study's numbers, against published values, and its reading of files."""

import csv
import json
import math

import numpy as np
import pytest

from styleexp.experiments.reports import study_results
from styleexp.experiments.reports.reliability import krippendorff_alpha, mean_interval
from styleexp.system.errors import UserError

NAN = math.nan

# K. Krippendorff, "Computing Krippendorff's Alpha-Reliability" (2011), section C: four observers,
# twelve units, values missing.
PUBLISHED = np.array(
    [
        [1, 2, 3, 3, 2, 1, 4, 1, 2, NAN, NAN, NAN],
        [1, 2, 3, 3, 2, 2, 4, 1, 2, 5, NAN, 3],
        [NAN, 3, 3, 3, 2, 3, 4, 2, 2, 5, 1, NAN],
        [1, 2, 3, 3, 2, 4, 4, 1, 2, 5, 1, NAN],
    ]
)


@pytest.mark.parametrize(
    ("level", "alpha"), [("nominal", 0.743), ("ordinal", 0.815), ("interval", 0.849)]
)
def test_alpha_is_the_published_one(level, alpha):
    assert krippendorff_alpha(PUBLISHED, level) == pytest.approx(alpha, abs=5e-4)


@pytest.mark.parametrize("level", ["nominal", "ordinal", "interval"])
def test_alpha_at_its_ends(level):
    agreed = np.tile([1.0, 2.0, 5.0, 3.0], (6, 1))
    assert krippendorff_alpha(agreed, level) == pytest.approx(1)
    chance = np.random.default_rng(0).integers(1, 6, (40, 200)).astype(float)
    assert abs(krippendorff_alpha(chance, level)) < 0.01
    opposed = np.array([[1.0, 5.0], [5.0, 1.0]])
    assert krippendorff_alpha(opposed, level) < 0
    for undefined in (np.full((3, 4), 2.0), np.array([[1.0, NAN], [NAN, 2.0]])):
        assert math.isnan(krippendorff_alpha(undefined, level))


def test_interval_covers_the_true_mean_as_often_as_it_says():
    rng = np.random.default_rng(1)
    hits = 0
    for _ in range(2000):
        _, low, high = mean_interval(rng.normal(3.0, 1.0, 8))
        hits += low <= 3.0 <= high
    assert 0.935 < hits / 2000 < 0.965
    assert mean_interval(np.array([4.0]))[0] == 4.0
    assert math.isnan(mean_interval(np.array([4.0]))[1])


def answers(participant, ratings, **changed):
    content = {
        "schema": "styleexp-study-1",
        "study": "abc",
        "participant": participant,
        "simulated": False,
        "pairs": [{"id": "0", "label": "bunny-bubble"}, {"id": "1", "label": "spot-stripe"}],
        "ratings": ratings,
    }
    return json.dumps(content | changed)


def write(folder, **texts):
    paths = []
    for name, text in texts.items():
        paths.append(folder / f"{name}.json")
        paths[-1].write_text(text)
    return paths


def test_files_that_cannot_count_are_named_and_left_out(tmp_path):
    paths = write(
        tmp_path,
        good=answers("a", {"0": 5, "1": 4}),
        half=answers("b", {"0": 3}),
        cut=answers("c", {"0": 5})[:60],
        six=answers("d", {"0": 6}),
        true=answers("e", {"0": True}),
        stranger=answers("f", {"7": 3}),
        other=answers("g", {"0": 3}, study="xyz"),
        twice=answers("a", {"0": 1, "1": 1}),
        empty=answers("h", {}),
        list="[1, 2]",
        unlabelled=json.dumps({"schema": "styleexp-study-1"}),
    )
    study = study_results.read([*paths, tmp_path / "gone.json"])
    assert [each.rater for each in study.answers] == ["a", "b"]
    named = {told.split("'")[1].split("/")[-1] for told in study.left_out}
    assert named == {path.name for path in paths[2:]} | {"gone.json"}
    assert all(told.endswith(".") for told in study.left_out)
    assert study.matrix("match", ["0", "1"])[0].tolist() == [5, 4]
    assert math.isnan(study.matrix("match", ["1"])[1, 0])
    with pytest.raises(UserError, match="no file with answers"):
        study_results.read(paths[2:3])


def test_analysis_writes_the_figure_and_its_numbers(tmp_path):
    pytest.importorskip("matplotlib", reason="matplotlib is not installed (extra report)")
    paths = write(
        tmp_path,
        a=answers("a", {"0": 5, "1": 2}),
        b=answers("b", {"0": 4, "1": 3}, simulated=True),
        c=answers("c", {"0": 5}),
    )
    out = tmp_path / "out"
    written = study_results.analyse(study_results.read(paths), out)
    assert {path.name for path in written} == {"fig9.png", "fig9.csv", "ratings.csv", "study.json"}
    rows = list(csv.DictReader((out / "fig9.csv").open()))
    assert [(row["pair"], row["n"]) for row in rows] == [
        ("bunny-bubble", "3"),
        ("spot-stripe", "2"),
    ]
    assert float(rows[0]["mean"]) == pytest.approx(14 / 3)
    # t(0.975, 2) = 4.303, the textbooks' value
    reach = 4.303 * math.sqrt(1 / 3) / math.sqrt(3)
    assert float(rows[0]["high"]) - float(rows[0]["mean"]) == pytest.approx(reach, rel=1e-3)
    found = json.loads((out / "study.json").read_text())
    assert found["participants"] == 3
    assert found["simulated_participants"] == 1
    assert found["pairs_above_4"] == 1
    assert len(list(csv.DictReader((out / "ratings.csv").open()))) == 5


def test_figure_says_that_its_participants_are_simulated(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib", reason="matplotlib is not installed (extra report)")
    from matplotlib.axes import Axes

    titles = []
    original = Axes.set_title
    monkeypatch.setattr(
        Axes, "set_title", lambda self, text, **more: titles.append(text) or original(self, text)
    )
    for name, simulated in (("people", False), ("dice", True)):
        paths = write(tmp_path, **{name: answers(name, {"0": 3, "1": 4}, simulated=simulated)})
        study_results.analyse(study_results.read(paths), tmp_path / name)
    assert "SIMULATED" not in titles[0]
    assert "SIMULATED: 1 of 1" in titles[1]
