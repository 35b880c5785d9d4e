"""The user study's answers: read, checked, and drawn as the paper's Fig. 9.

They come from the study's page (`study`), as one JSON file each, or from `sheets`, as tables.
"""

from __future__ import annotations

import csv
import json
import math
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from styleexp.experiments.reports import sheets
from styleexp.experiments.reports.reliability import krippendorff_alpha, mean_interval
from styleexp.experiments.reports.study import HIGHEST, LOWEST, SCHEMA
from styleexp.runs.records import RunFolder
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from jaxtyping import Float

SCALE = range(1, 6)
QUESTIONS = ("match", "craft")
PERSON, SIMULATED = "person", "simulated"
PAPER = "the paper's 43 raters and its own 16 pairs: all means above 3, most above 4"


@dataclass(frozen=True)
class Item:
    """What was rated."""

    label: str
    """Source and style."""
    run: str
    """The run's folder, below that of the study."""
    trial: sheets.Trial = "result"


@dataclass(frozen=True)
class Answers:
    """One rater's answers."""

    path: Path
    rater: str
    study: str
    who: str
    """``person``, ``simulated``, or what kind of program."""
    items: dict[str, Item]
    ratings: dict[str, dict[str, int]]
    """By question, then by item."""


@dataclass(frozen=True)
class Study:
    """All readable answers."""

    answers: list[Answers]
    left_out: list[str] = field(default_factory=list)
    """One sentence for each file, row or rating that was skipped."""

    @property
    def items(self) -> dict[str, Item]:
        """Everything that could be rated, by id."""
        return self.answers[0].items

    @cached_property
    def results(self) -> dict[str, Item]:
        """The items without the catch trials."""
        return {name: item for name, item in self.items.items() if item.trial == "result"}

    @property
    def questions(self) -> list[str]:
        """Those that anybody answered."""
        return [q for q in QUESTIONS if any(answer.ratings.get(q) for answer in self.answers)]

    def matrix(self, question: str, of: Sequence[str]) -> Float[np.ndarray, "raters items"]:
        """Ratings of these items; NaN if missing."""
        return np.array(
            [[a.ratings.get(question, {}).get(name, math.nan) for name in of] for a in self.answers]
        )

    def who(self) -> dict[str, int]:
        """Number of raters of each kind."""
        kinds = [answer.who for answer in self.answers]
        return {kind: kinds.count(kind) for kind in sorted(set(kinds))}


# ----------------------------------------------------------------------------------------- reading


def read(paths: Sequence[Path], key: Path | None = None) -> Study:
    """Read answer files (JSON) and tables of ratings (CSV).

    ``key`` is the ``key.json`` of the sheets that tables rate; by default the one beside the table.
    Broken files and rows, those of another study, and a rater's second answers are skipped and
    listed. Raises `UserError` if nothing is left.
    """
    answers: list[Answers] = []
    left_out: list[str] = []
    for path in paths:
        try:
            if path.suffix.lower() == ".csv":
                answers += _read_table(path, key or path.parent / sheets.KEY, left_out)
            else:
                answers.append(_read_page(path))
        except (OSError, ValueError, KeyError, TypeError, AttributeError, csv.Error) as error:
            reason = f"it has no {error}" if isinstance(error, KeyError) else str(error)
            left_out.append(f"'{path}' was left out: it holds no answers of a study ({reason}).")
    if not answers:
        raise UserError(" ".join(["no file with answers could be read.", *left_out]))
    study = statistics.mode(answer.study for answer in answers)
    kept: dict[str, Answers] = {}
    for answer in answers:
        if answer.study != study:
            left_out.append(f"'{answer.path}' was left out: it belongs to another study.")
        elif answer.rater in kept:
            first = kept[answer.rater].path
            left_out.append(f"'{answer.path}' was left out: '{first}' is of the same participant.")
        else:
            kept[answer.rater] = answer
    return Study(list(kept.values()), left_out)


def _read_page(path: Path) -> Answers:
    content = json.loads(path.read_text(encoding="utf-8"))
    if content["schema"] != SCHEMA:
        raise ValueError(f"its schema is not {SCHEMA}")
    items = {
        str(pair["id"]): Item(str(pair["label"]), str(pair["id"])) for pair in content["pairs"]
    }
    ratings = dict(content["ratings"])
    for pair, rating in ratings.items():
        if pair not in items:
            raise ValueError(f"it rates the unknown pair '{pair}'")
        if type(rating) is not int or rating not in SCALE:
            raise ValueError(f"its rating {rating!r} is not a number from 1 to 5")
    if not ratings:
        raise ValueError("it has no rating")
    if type(content["simulated"]) is not bool:
        raise ValueError("it doesn't say whether it is simulated")
    who = SIMULATED if content["simulated"] else PERSON
    rater, study = str(content["participant"]), str(content["study"])
    return Answers(path, rater, study, who, items, {"match": ratings})


def _read_table(path: Path, key: Path, left_out: list[str]) -> list[Answers]:
    """The answers of each rater in a table with the columns rater, who, sheet, match, craft."""
    if not key.is_file():
        raise UserError(
            f"there is no '{key}', which says what the sheets in '{path}' show: give it with --key."
        )
    content = json.loads(key.read_text(encoding="utf-8"))
    if content["schema"] != sheets.SCHEMA:
        raise ValueError(f"the schema of '{key}' is not {sheets.SCHEMA}")
    items = {
        str(name): Item(str(shown["label"]), str(shown["run"]), shown["trial"])
        for name, shown in content["sheets"].items()
    }
    raters: dict[str, Answers] = {}
    with open(path, newline="", encoding="utf-8-sig") as file:
        rows = csv.DictReader(file)
        if missing := {"rater", "sheet", "match"} - set(rows.fieldnames or ()):
            raise ValueError(f"it has no column {sorted(missing)[0]}")
        for number, row in enumerate(rows, start=2):
            name, rater = (row["sheet"] or "").strip(), (row["rater"] or "").strip()
            who = (row.get("who") or "").strip() or "unstated"
            given = {q: (row.get(q) or "").strip() for q in QUESTIONS}
            if not any(given.values()):
                continue
            where = f"line {number} of '{path}' was left out"
            if not rater or name not in items:
                fault = f"there is no sheet '{name}'" if rater else "it names no rater"
                left_out.append(f"{where}: {fault}.")
                continue
            of = raters.setdefault(
                rater, Answers(path, rater, str(content["study"]), who, items, {})
            )
            for question, text in given.items():
                ratings = of.ratings.setdefault(question, {})
                if text and text not in map(str, SCALE):
                    left_out.append(f"{where}: its {question} '{text}' is not 1, 2, 3, 4 or 5.")
                elif text and name in ratings:
                    left_out.append(f"{where}: '{rater}' has rated sheet {name} before.")
                elif text:
                    ratings[name] = int(text)
    return list(raters.values())


# ---------------------------------------------------------------------------------------- analysis


def analyse(study: Study, folder: Path) -> list[Path]:
    """Write ``fig9.png``, ``fig9.csv``, ``ratings.csv`` and ``study.json``; return their paths."""
    target = RunFolder(folder)
    folder.mkdir(parents=True, exist_ok=True)
    rows, found = table(study), summary(study)
    target.write_json("study.json", found)
    return [
        target.write("fig9.png", lambda path: draw(rows, found, path)),
        target.write("fig9.csv", lambda path: _write_csv(path, rows)),
        target.write("ratings.csv", lambda path: _write_csv(path, list(_ratings(study)))),
        target.path / "study.json",
    ]


def table(study: Study) -> list[dict[str, Any]]:
    """One row per result: number of ratings, mean, bounds of the 95 % confidence interval.

    The columns ``n``, ``mean``, ``low``, ``high`` are of the match; if the raters were asked, those
    with ``craft_`` in front are of the craft.
    """
    rows = []
    for name, item in study.results.items():
        row: dict[str, Any] = {"pair": item.label, "run": item.run}
        for question in study.questions:
            column = study.matrix(question, [name])[:, 0]
            given = column[~np.isnan(column)]
            mean, low, high = mean_interval(given) if len(given) else (math.nan,) * 3
            before = "" if question == "match" else f"{question}_"
            values = {"n": len(given), "mean": mean, "low": low, "high": high}
            row |= {before + key: value for key, value in values.items()}
        rows.append(row)
    return rows


def summary(study: Study) -> dict[str, Any]:
    """Summary statistics of the study."""
    means = [row["mean"] for row in table(study) if row["n"]]
    return {
        "participants": len(study.answers),
        "who": study.who(),
        "simulated_participants": study.who().get(SIMULATED, 0),
        "pairs": len(study.results),
        "mean": statistics.fmean(means),
        "pairs_above_3": sum(mean > 3 for mean in means),
        "pairs_above_4": sum(mean > 4 for mean in means),
        "krippendorff_alpha_ordinal": _alpha(study, "match", "ordinal"),
        "krippendorff_alpha_interval": _alpha(study, "match", "interval"),
        **(
            {
                "craft_mean": float(np.nanmean(study.matrix("craft", list(study.results)))),
                "craft_krippendorff_alpha_ordinal": _alpha(study, "craft", "ordinal"),
            }
            if "craft" in study.questions
            else {}
        ),
        "raters": [_rater(study, at) for at in range(len(study.answers))],
        "confidence_interval": "95 %, Student's t over the participants, for each pair by itself",
        "paper": PAPER,
        "left_out": study.left_out,
    }


def _alpha(study: Study, question: str, level: Any) -> float | None:
    return _or_none(krippendorff_alpha(study.matrix(question, list(study.results)), level))


def _rater(study: Study, at: int) -> dict[str, Any]:
    """One rater beside the others: how many ratings, their mean, the mean distance and Spearman's
    correlation with the mean of the others, and the mean match of each kind of catch trial."""
    answer = study.answers[at]
    found: dict[str, Any] = {"rater": answer.rater, "who": answer.who}
    names = list(study.results)
    for question in study.questions:
        ratings = study.matrix(question, names)
        own, others = ratings[at], np.delete(ratings, at, axis=0)
        shared = ~np.isnan(own) & ~np.isnan(others).all(axis=0)
        found[question] = {
            "n": int((~np.isnan(own)).sum()),
            "mean": _or_none(float(np.nanmean(own)) if (~np.isnan(own)).any() else math.nan),
        }
        if shared.any():
            rest = np.nanmean(others[:, shared], axis=0)
            found[question]["distance_from_others"] = float(np.abs(own[shared] - rest).mean())
            found[question]["correlation_with_others"] = _or_none(spearman(own[shared], rest))
    for trial in ("source", "other style"):
        rated = [
            answer.ratings.get("match", {}).get(name)
            for name, item in study.items.items()
            if item.trial == trial
        ]
        given = [rating for rating in rated if rating is not None]
        if given:
            found[f"catch_{trial.replace(' ', '_')}"] = statistics.fmean(given)
    return found


def spearman(a: Float[np.ndarray, " n"], b: Float[np.ndarray, " n"]) -> float:
    """Spearman's rank correlation, ties sharing their mean rank; NaN if one is constant."""
    from scipy.stats import rankdata

    ranks = np.stack([rankdata(a), rankdata(b)])
    if (np.ptp(ranks, axis=1) == 0).any():
        return math.nan
    return float(np.corrcoef(ranks)[0, 1])


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
    if not_people := {who: n for who, n in found["who"].items() if who != PERSON}:
        if simulated := not_people.pop(SIMULATED, 0):
            title += (
                f"\nSIMULATED: {simulated} of {found['participants']} "
                "participants are a program, not people"
            )
        if not_people:
            told = ", ".join(f"{number} {who}" for who, number in not_people.items())
            title += f"\nNOT PEOPLE: {told}"
    people = set(found["who"]) <= {PERSON}
    axes.set_title(title, fontsize=9, color=None if people else "#a3262b")
    figure.savefig(path, dpi=130)


def _ratings(study: Study) -> Iterator[dict[str, Any]]:
    """Every rating, catch trials included."""
    for answer in study.answers:
        for name, item in study.items.items():
            given = {q: answer.ratings.get(q, {}).get(name) for q in study.questions}
            if any(rating is not None for rating in given.values()):
                yield {
                    "participant": answer.rater,
                    "who": answer.who,
                    "pair": item.label,
                    "run": item.run,
                    "trial": item.trial,
                    "rating": given.pop("match", None),
                    **given,
                }


def _or_none(value: float) -> float | None:
    return None if math.isnan(value) else value


def _write_csv(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
