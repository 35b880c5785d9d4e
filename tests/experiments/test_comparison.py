"""Means, intervals and tests of settings, against textbooks' values and by simulation."""

import csv
import json
import math

import numpy as np
import pytest

from styleexp.experiments.reports import comparison, sweep_page
from styleexp.experiments.reports.comparison import compare, holm, sign_test


def test_sign_test_is_exact():
    # All of five differences positive: 2 of 32 sign changes are as extreme.
    assert sign_test(np.array([1.0, 2.0, 0.5, 3.0, 1.0])) == pytest.approx(2 / 32)
    # Fisher's data on Darwin's maize (Box, 1980): 863 of 32768 one-sided, so 1726 two-sided. It has
    # 15 pairs, one more than are tried exactly.
    darwin = np.array([49, -67, 8, 16, 6, 23, 28, 41, 14, 29, 56, 24, 75, 60, -48.0])
    assert sign_test(darwin) == pytest.approx(1726 / 32768, abs=0.006)
    assert sign_test(np.zeros(4)) == sign_test(np.array([])) == 1.0


def test_sign_test_rejects_as_rarely_as_it_says():
    rng = np.random.default_rng(0)
    rejected = [sign_test(rng.normal(size=8)) < 0.05 for _ in range(1000)]
    assert 0.02 < np.mean(rejected) < 0.07


def test_holm():
    # Smallest times 3, next times 2, never below the one before.
    assert holm([0.04, 0.01, 0.03]) == pytest.approx([0.06, 0.03, 0.06])
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    assert holm([]) == []


def run_folder(folder, overrides, status="done", **metrics):
    folder.mkdir(parents=True)
    (folder / "run.json").write_text(json.dumps({"schema": 1, "overrides": overrides}))
    told = {"status": status, "seconds": 10.0, "reason": "no memory"}
    (folder / "status.json").write_text(json.dumps(told))
    (folder / "metrics.json").write_text(json.dumps(metrics))


@pytest.fixture
def sweep(tmp_path):
    """Two methods on two pairs and two seeds; one run failed after a bad measure."""
    values = {"a": (0.2, 0.4, 0.3, 0.5), "b": (0.3, 0.6, 0.4, 9.0)}
    for method, distances in values.items():
        for number, distance in enumerate(distances):
            pair, seed = ("spot", "fish")[number // 2], number % 2
            status = "failed" if distance == 9.0 else "done"
            run_folder(
                tmp_path / f"{method}{number}",
                [f"method={method}", f"+pair={pair}", f"optim.seed={seed}"],
                status,
                style_distance=distance,
            )
    return tmp_path


def found(folder):
    runs = sweep_page.finding.find(folder)
    return sweep_page.comparisons(sweep_page.split(folder, runs)[0])


def test_pairs_are_the_same_in_all_else_and_failed_runs_stay_out(sweep):
    by_method, by_pair = found(sweep)
    assert (by_method.key, by_pair.key) == ("method", "pair")
    first, second = by_method.rows
    assert (first.value, first.done, first.unfinished) == ("a", 4, 0)
    assert (second.done, second.unfinished) == (3, 1)
    mean = second.means["style_distance"]
    assert mean.mean == pytest.approx(1.3 / 3)
    # t(0.975, 2) = 4.303, the textbooks' value
    spread = np.std([0.3, 0.6, 0.4], ddof=1)
    assert mean.reach == pytest.approx(4.303 * spread / math.sqrt(3), rel=1e-3)
    assert mean.pairs == 3
    assert mean.difference == pytest.approx((0.1 + 0.2 + 0.1) / 3)
    assert mean.p == pytest.approx(2 / 8)
    assert by_method.best("style_distance") == {"a"}


def test_tables_beside_the_page(sweep):
    page = sweep_page.write(sweep, run_pages=False).read_text()
    assert "Means by method" in page
    assert "1 unfinished" in page
    rows = list(csv.DictReader((sweep / "means-method.csv").open()))
    row = next(r for r in rows if r["method"] == "b" and r["measure"] == "style_distance")
    assert (row["n"], row["unfinished"], row["pairs"]) == ("3", "1", "3")
    text = (sweep / "means-method.tex").read_text()
    assert r"style\\ distance $\downarrow$" in text
    assert r"$\mathbf{0.35 \pm 0.21}$" in text
    assert r"b & 3 of 4 & $0.43 \pm 0.38$" in text
    assert text.count("{") == text.count("}")


@pytest.mark.parametrize(
    ("printed", "best", "bold"),
    [
        ({"a": r"0.994 \pm 0.011", "b": r"0.996 \pm 0.014", "c": r"0.996 \pm 0.012"}, "b", "bc"),
        ({"a": r"0.5 \pm 0.1", "b": r"0.6 \pm 0.1"}, "b", "b"),
        ({"a": r"0.6 \pm 0.1", "b": r"0.6 \pm 0.2"}, "b", ""),
        ({"a": "0.6", "b": r"0.6 \pm 0.2", "c": "0.7"}, "", ""),
    ],
)
def test_means_that_are_printed_alike_are_bold_together(printed, best, bold):
    assert comparison._alike(printed, set(best)) == set(bold)


def test_a_chart_leaves_failed_runs_out(sweep):
    runs = sweep_page.finding.find(sweep)
    charts = sweep_page.plots(sweep_page.split(sweep, runs)[0])
    chart = next(c["chart"] for c in charts if c["measure"] == "style_distance")
    assert "9" not in {label.strip() for label in str(chart).split(": ")[1:]}
    assert "9.0" not in str(chart)
    assert "0.6" in str(chart)


def test_one_run_has_no_interval_and_no_rival():
    assert comparison.compare("method", []).rows == []
    assert compare("method", []).best("match") == set()


@pytest.mark.parametrize(
    ("mean", "reach", "cell"),
    [
        (0.98765, 0.0123, r"0.988 \pm 0.012"),
        (-36.92, 30.1, r"-37 \pm 30"),
        (0.5, math.nan, "0.5"),
        (1.23456e-7, 2e-9, r"(1.235 \pm 0.020)\times 10^{-7}"),
        (0.5, 1e-9, r"0.5 \pm 1\times 10^{-9}"),
        (1234.6, 321.0, r"1235 \pm 321"),
        (4.6e7, 2e6, r"(4.60 \pm 0.20)\times 10^{7}"),
        (0.0, 0.0, r"0 \pm 0"),
    ],
)
def test_numbers_of_a_table_for_a_paper(mean, reach, cell):
    assert comparison._cell(mean, reach) == cell


def test_text_of_a_table_for_a_paper():
    assert comparison.escaped("a_b & 5 % <~^\\|") == (
        r"a\_b \& 5 \% \textless{}\textasciitilde{}\textasciicircum{}\textbackslash{}\textbar{}"
    )
