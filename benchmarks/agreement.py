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
import sys
from pathlib import Path

import numpy as np

from styleexp.experiments import ratings as ratings_of
from styleexp.experiments.reports import study_results
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
    "spike": -1,
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
    missing = len(rated) - len(rows)
    print(f"{len(rows)} rated results" + (f", {missing} not measured" if missing else ""))
    fit(rows)
    for question, column in (("match", "mean"), ("craft", "craft_mean")):
        print(f"\nagreement with {question}: development, test (Spearman; pairs {APART} apart)")
        for name, sign in SIGNS.items():
            told = [agreement(half, name, sign, column) for half in halves(rows)]
            print(f"  {name:20s}" + "   ".join(f"{s:5.2f}  {100 * p:5.1f} %" for s, p, _ in told))
        print(f"  pairs of results: {', '.join(str(n) for _, _, n in told)}")
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
    ratings = np.array([float(row[0][column]) for row in rows])
    right = [
        (values[i] - values[j]) * (ratings[i] - ratings[j]) > 0
        for i, j in itertools.combinations(range(len(rows)), 2)
        if abs(ratings[i] - ratings[j]) >= APART
    ]
    return spearman(values, ratings), float(np.mean(right)), len(right)


def fit(rows: Rows) -> None:
    """Print the constants of `metrics.ratings`: least squares on the development half."""
    first = [row for row in halves(rows)[0] if row[1].get("likeness")]
    likeness, iou, bend, match, craft = (
        np.array([float(row[half][name]) for row in first])
        for half, name in (
            (1, "likeness"),
            (1, "silhouette_iou"),
            (1, "bend"),
            (0, "mean"),
            (0, "craft_mean"),
        )
    )
    ones = np.ones(len(first))
    found = np.linalg.lstsq(np.stack([ones, likeness], 1), match, rcond=None)[0]
    print("MATCH =", tuple(round(float(x), 2) for x in found))
    change = np.log(np.maximum(1 - iou, ratings_of.LEAST_CHANGE) / 0.1)
    bent = np.log(np.maximum(bend, ratings_of.LEAST_BEND))
    found = np.linalg.lstsq(np.stack([ones, -change, -bent], 1), craft, rcond=None)[0]
    print("CRAFT =", tuple(round(float(x), 2) for x in found))


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
