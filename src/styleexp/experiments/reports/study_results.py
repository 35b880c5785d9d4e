"""The user study's answers: read, checked, and drawn as the paper's Fig. 9."""

from __future__ import annotations

import csv
import json
import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from styleexp.experiments.reports.reliability import krippendorff_alpha, mean_interval
from styleexp.experiments.reports.study import HIGHEST, LOWEST, SCHEMA
from styleexp.runs.records import RunFolder
from styleexp.system.errors import UserError

SCALE = range(1, 6)
PAPER = "the paper's 43 raters and its own 16 pairs: all means above 3, most above 4"


@dataclass(frozen=True)
class Answers:
    """One participant's file."""

    path: Path
    participant: str
    study: str
    simulated: bool
    pairs: dict[str, str]
    """Label of each pair by its id."""
    ratings: dict[str, int]


@dataclass(frozen=True)
class Study:
    """All readable answers."""

    answers: list[Answers]
    left_out: list[str]
    """One sentence for each skipped file."""

    @property
    def pairs(self) -> dict[str, str]:
        """Label of each pair by its id."""
        return self.answers[0].pairs

    @property
    def matrix(self) -> np.ndarray:
        """Ratings (participants, pairs); NaN if missing."""
        return np.array(
            [[answer.ratings.get(pair, math.nan) for pair in self.pairs] for answer in self.answers]
        )

    @property
    def simulated(self) -> int:
        """Number of simulated participants."""
        return sum(answer.simulated for answer in self.answers)


def read(paths: Sequence[Path]) -> Study:
    """Read answer files, skipping broken ones, those of another study, and duplicates of a
    participant. Raises `UserError` if none is left."""
    answers: list[Answers] = []
    left_out: list[str] = []
    for path in paths:
        try:
            answers.append(_read(path))
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            reason = f"it has no {error}" if isinstance(error, KeyError) else str(error)
            left_out.append(f"'{path}' was left out: it holds no answers of a study ({reason}).")
    if not answers:
        raise UserError(" ".join(["no file with answers could be read.", *left_out]))
    study = statistics.mode(answer.study for answer in answers)
    kept: dict[str, Answers] = {}
    for answer in answers:
        if answer.study != study:
            left_out.append(f"'{answer.path}' was left out: it belongs to another study.")
        elif answer.participant in kept:
            first = kept[answer.participant].path
            left_out.append(f"'{answer.path}' was left out: '{first}' is of the same participant.")
        else:
            kept[answer.participant] = answer
    return Study(list(kept.values()), left_out)


def _read(path: Path) -> Answers:
    content = json.loads(path.read_text(encoding="utf-8"))
    if content["schema"] != SCHEMA:
        raise ValueError(f"its schema is not {SCHEMA}")
    pairs = {str(pair["id"]): str(pair["label"]) for pair in content["pairs"]}
    ratings = dict(content["ratings"])
    for pair, rating in ratings.items():
        if pair not in pairs:
            raise ValueError(f"it rates the unknown pair '{pair}'")
        if type(rating) is not int or rating not in SCALE:
            raise ValueError(f"its rating {rating!r} is not a number from 1 to 5")
    if not ratings:
        raise ValueError("it has no rating")
    if type(content["simulated"]) is not bool:
        raise ValueError("it doesn't say whether it is simulated")
    return Answers(
        path,
        str(content["participant"]),
        str(content["study"]),
        content["simulated"],
        pairs,
        ratings,
    )


def analyse(study: Study, folder: Path) -> list[Path]:
    """Write ``fig9.png``, ``fig9.csv``, ``ratings.csv`` and ``study.json``; return their paths."""
    target = RunFolder(folder)
    folder.mkdir(parents=True, exist_ok=True)
    rows, found = table(study), summary(study)
    target.write_json("study.json", found)
    ratings = [
        {"participant": a.participant, "simulated": a.simulated, "pair": label, "rating": rating}
        for a in study.answers
        for pair, label in study.pairs.items()
        if (rating := a.ratings.get(pair)) is not None
    ]
    return [
        target.write("fig9.png", lambda path: draw(rows, found, path)),
        target.write("fig9.csv", lambda path: _write_csv(path, rows)),
        target.write("ratings.csv", lambda path: _write_csv(path, ratings)),
        target.path / "study.json",
    ]


def table(study: Study) -> list[dict[str, Any]]:
    """One row per pair: number of ratings, mean, bounds of the 95 % confidence interval."""
    rows = []
    for label, column in zip(study.pairs.values(), study.matrix.T, strict=True):
        given = column[~np.isnan(column)]
        mean, low, high = mean_interval(given) if len(given) else (math.nan,) * 3
        rows.append({"pair": label, "n": len(given), "mean": mean, "low": low, "high": high})
    return rows


def summary(study: Study) -> dict[str, Any]:
    """Summary statistics of the study."""
    means = [row["mean"] for row in table(study) if row["n"]]
    return {
        "participants": len(study.answers),
        "simulated_participants": study.simulated,
        "pairs": len(study.pairs),
        "mean": statistics.fmean(means),
        "pairs_above_3": sum(mean > 3 for mean in means),
        "pairs_above_4": sum(mean > 4 for mean in means),
        "krippendorff_alpha_ordinal": _or_none(krippendorff_alpha(study.matrix, "ordinal")),
        "krippendorff_alpha_interval": _or_none(krippendorff_alpha(study.matrix, "interval")),
        "confidence_interval": "95 %, Student's t over the participants, for each pair by itself",
        "paper": PAPER,
        "left_out": study.left_out,
    }


def draw(rows: Sequence[dict[str, Any]], found: dict[str, Any], path: Path) -> None:
    """Draw Fig. 9: a bar per pair, from 1 to its mean rating, with the confidence interval."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise UserError("Fig. 9 needs matplotlib: pip install 'styleexp[report]'.") from None
    figure = Figure(figsize=(max(5.0, 2.2 + 0.55 * len(rows)), 4.8), layout="constrained")
    axes = figure.add_subplot()
    means = np.array([row["mean"] for row in rows])
    reach = np.array([row["high"] - row["mean"] for row in rows])
    at = np.arange(len(rows))
    axes.bar(at, means - 1, bottom=1, color="#7aa6d6", width=0.7)
    sure = ~np.isnan(reach)
    axes.errorbar(at[sure], means[sure], reach[sure], fmt="none", ecolor="#1d2230", capsize=4)
    axes.set_xticks(at, [row["pair"] for row in rows], rotation=45, ha="right")
    axes.set_ylim(1, 5)
    axes.set_yticks(SCALE, [f"1\n{LOWEST}", "2", "3", "4", f"5\n{HIGHEST}"])
    axes.grid(axis="y", color="#d9d7d0")
    axes.set_axisbelow(True)
    axes.set_ylabel("mean rating")
    alpha = found["krippendorff_alpha_ordinal"]
    agreement = "undefined" if alpha is None else f"{round(alpha, 2) + 0.0:.2f}"
    title = (
        f"{found['participants']} participants, bars: mean, whiskers: 95 % confidence (t)\n"
        f"Krippendorff's alpha (ordinal): {agreement}"
    )
    if found["simulated_participants"]:
        title += (
            f"\nSIMULATED: {found['simulated_participants']} of {found['participants']} "
            "participants are a program, not people"
        )
    axes.set_title(title, fontsize=9, color="#a3262b" if found["simulated_participants"] else None)
    figure.savefig(path, dpi=130)


def _or_none(value: float) -> float | None:
    return None if math.isnan(value) else value


def _write_csv(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
