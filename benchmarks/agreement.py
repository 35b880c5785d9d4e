"""Do the metrics agree with raters? The tables of docs/metrics.md, from the data in reports/rated.

    python -m benchmarks.agreement                            # from the committed data, in a second
    python -m benchmarks.agreement --measure outputs/rated    # measure the results again first

Whatever was chosen or fitted was chosen on the development half, whose pairs are `DEVELOPMENT`; the
halves were fixed before anything was rated. A run belongs to the half of its source and style.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import math
import sys
from pathlib import Path

import numpy as np

from styleexp.experiments import ratings
from styleexp.experiments.ratings import LEAST_BEND, LEAST_CHANGE, MOST_DISTANCE
from styleexp.experiments.reports import study_results
from styleexp.experiments.reports.comparison import sign_test
from styleexp.experiments.reports.reliability import mean_interval
from styleexp.experiments.reports.study_results import spearman

DATA = Path(__file__).parents[1] / "reports" / "rated"
DEVELOPMENT = (
    "critter-bubble",
    "human-cracks",
    "bunny-brick",
    "cat-gravel",
    "penguin-buckyball",
    "hand-rail",
    "spot-cube",
)
APART = 1.5
"""Difference of mean ratings from which two results of a half should be ordered alike."""
SIGNS = {
    "match": 1,
    "craft": 1,
    "likeness": 1,
    "coverage": 1,
    "style_distance": -1,
    "relief_distance": -1,
    "silhouette_iou": 1,
    "bend": -1,
    "flipped_faces": -1,
    "self_intersections": -1,
    "chamfer": -1,
    "hausdorff": -1,
}
"""1 where larger is better, -1 where smaller is."""


def main() -> int:
    """Print how each metric agrees with the ratings, on both halves."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--measure", type=Path, metavar="FOLDER", help="with the rated runs")
    folder = parser.parse_args().measure
    if folder is not None:
        measure(folder)
    rated = {row["run"]: row for row in study_results.table(study_results.read([DATA / RATINGS]))}
    with open(DATA / MEASURES, newline="", encoding="utf-8") as file:
        measured = {row["run"]: row for row in csv.DictReader(file)}
    rows = [(rated[run], measured[run]) for run in rated if run in measured]
    for row in measured.values():
        found = numbers(row)
        row["craft"] = ratings.craft(found["silhouette_iou"], found["bend"])
        row["match"] = ratings.match(found) if "relief_distance" in found else ""
    missing = len(rated) - len(rows)
    print(f"{len(rows)} rated results" + (f", {missing} not measured" if missing else ""))
    fit(rows)
    for question, column in (("match", "mean"), ("craft", "craft_mean")):
        print(f"\nagreement with {question}: development, test (Spearman; pairs {APART} apart)")
        for name, sign in SIGNS.items():
            told = [agreement(half, name, sign, column) for half in halves(rows)]
            print(f"  {name:20s}" + "   ".join(f"{s:5.2f}  {100 * p:5.1f} %" for s, p, _ in told))
        print(f"  pairs of results: {', '.join(str(n) for _, _, n in told)}")
    by_kind(rows)
    compared(rows, "synthesis", "displacement_map")
    return 0


RATINGS, MEASURES = "ratings.csv", "measures.csv"

Rows = list[tuple[dict, dict]]


def halves(rows: Rows) -> tuple[Rows, Rows]:
    """Development and test."""
    first = [row for row in rows if row[0]["pair"] in DEVELOPMENT]
    return first, [row for row in rows if row[0]["pair"] not in DEVELOPMENT]


def agreement(rows: Rows, name: str, sign: int, column: str) -> tuple[float, float, int]:
    """Spearman's correlation of a measure with the mean ratings, the share of pairs of results at
    least `APART` apart that it orders as raters did, and their number."""
    rows = [row for row in rows if row[1].get(name)]
    values = sign * np.array([float(row[1][name]) for row in rows])
    rated = np.array([float(row[0][column]) for row in rows])
    return spearman(values, rated), *ordered(values, rated)


def kind_of(run: str) -> str:
    """How a result was made: the sweep's experiment, or how it was altered."""
    return run.removeprefix("altered/").split("/")[0]


def by_kind(rows: Rows) -> None:
    """Print each kind's mean match and craft, as rated and as estimated."""
    print("\nkind: results, match, craft; estimated")
    found: dict[str, list[tuple[float, ...]]] = {}
    for rated, row in rows:
        four = (rated["mean"], rated["craft_mean"], float(row["match"]), float(row["craft"]))
        found.setdefault(kind_of(rated["run"]), []).append(four)
    for kind, numbers in sorted(found.items(), key=lambda each: -np.mean(each[1], axis=0)[0]):
        match, craft, *estimates = np.mean(numbers, axis=0)
        told = ", ".join(f"{x:.1f}" for x in estimates)
        print(f"  {kind:20s}{len(numbers):3d}  {match:.1f}  {craft:.1f}  {told}")


def compared(rows: Rows, one: str, other: str) -> None:
    """Print the mean difference of two kinds on the pairs that both have, its 95 % interval
    (Student's t over the pairs), and the p-value of a permutation of signs."""
    ratings_of = {
        kind: {r["pair"]: r for r, _ in rows if kind_of(r["run"]) == kind} for kind in (one, other)
    }
    pairs = sorted(ratings_of[one].keys() & ratings_of[other].keys())
    print(f"\n{one} minus {other}, {len(pairs)} pairs")
    for question, column in (("match", "mean"), ("craft", "craft_mean")):
        apart = np.array([ratings_of[one][p][column] - ratings_of[other][p][column] for p in pairs])
        mean, low, high = mean_interval(apart)
        print(f"  {question}: {mean:.2f} ({low:.2f} to {high:.2f}), p {sign_test(apart):.3f}")


def fit(rows: Rows) -> None:
    """Print the constants of `experiments.ratings`, least squares on the development half, and how
    estimates agree whose constants come from all pairs but the result's own."""
    pairs = np.array([row[0]["pair"] for row in rows])
    first = np.isin(pairs, DEVELOPMENT)
    for question, column in (("match", "mean"), ("craft", "craft_mean")):
        inputs = np.array([INPUTS[question](numbers(row[1])) for row in rows])
        inputs = np.column_stack([np.ones(len(rows)), inputs])
        rated = np.array([row[0][column] for row in rows])
        constants = np.linalg.lstsq(inputs[first], rated[first], rcond=None)[0]
        print(f"{question.upper()} =", tuple(round(float(x), 2) for x in constants))
        estimates = np.zeros(len(rows))
        for pair in set(pairs):
            rest = pairs != pair
            fitted = np.linalg.lstsq(inputs[rest], rated[rest], rcond=None)[0]
            estimates[~rest] = inputs[~rest] @ fitted
        right, _ = ordered(estimates, rated)
        agree = f"{spearman(estimates, rated):.2f}, {100 * right:.1f} %"
        print(f"  each pair by the constants of all others: {agree}")


INPUTS = {
    "match": lambda f: (ratings.pattern(f), -min(f["style_distance"], MOST_DISTANCE)),
    "craft": lambda f: (
        -math.log(max(1 - f["silhouette_iou"], LEAST_CHANGE) / 0.1),
        -math.log(max(f["bend"], LEAST_BEND)),
    ),
}
"""What `experiments.ratings` weighs."""


def numbers(row: dict[str, str]) -> dict[str, float]:
    """The measures in a row."""
    return {name: float(x) for name, x in row.items() if name != "run" and x}


def ordered(values: np.ndarray, rated: np.ndarray) -> tuple[float, int]:
    """The share of pairs of results at least `APART` apart that are ordered as raters did, and the
    number of such pairs."""
    right = [
        (values[i] - values[j]) * (rated[i] - rated[j]) > 0
        for i, j in itertools.combinations(range(len(values)), 2)
        if abs(rated[i] - rated[j]) >= APART
    ]
    return float(np.mean(right)), len(right)


def measure(folder: Path) -> None:
    """Measure every rated result below a folder, and write the measures after each."""
    from styleexp.experiments.metrics import load_judge
    from styleexp.experiments.metrics import measure as measured
    from styleexp.experiments.metrics.board import finished

    judge, banks, rows = load_judge("vgg16_edges", 32), {}, []
    rated = study_results.table(study_results.read([DATA / RATINGS]))
    for row in sorted(rated, key=lambda row: row["pair"]):
        _, config, source, style, vertices, faces = finished(folder / row["run"])
        found = measured(config, source, style, vertices, faces, judge, banks)
        rows.append({"run": row["run"], **{name: f"{x:.6g}" for name, x in found.items()}})
        print(f"{len(rows)} of {len(rated)}: {row['run']}", flush=True)
        names = dict.fromkeys(name for each in rows for name in each)
        with open(DATA / MEASURES, "w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(names))
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    sys.exit(main())
