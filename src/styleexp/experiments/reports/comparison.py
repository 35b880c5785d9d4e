"""Means over runs with intervals, and settings compared on the same pairs and seeds.

Only finished runs count; how many didn't finish is told beside each mean.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from styleexp.experiments.reports.reliability import mean_interval
from styleexp.runs.reading import Run

if TYPE_CHECKING:
    from jaxtyping import Float

BETTER = {
    "match": 1,
    "craft": 1,
    "coverage": 1,
    "style_distance": -1,
    "relief_distance": -1,
    "silhouette_iou": 1,
    "flipped_faces": -1,
    "self_intersections": -1,
    "seconds": -1,
}
"""Measures shown in tables: 1 if larger is better, -1 if smaller is."""
EXACT = 14
"""Number of differences up to which all sign changes are tried; above, 20,000 random ones."""
MOST_DIGITS = 5
"""Most digits after the point in a LaTeX table."""
PLAIN = range(-3, 5)
"""Powers of ten that a LaTeX table shows without an exponent."""
INTERVAL = "Mean and 95 % confidence interval (Student's t) over n finished runs."
CAPTION = (
    f"{INTERVAL} p: two-sided sign-flip permutation test of the mean difference from the first "
    "row, on the same pairs and seeds, Holm-corrected over the column's rows. Seeds of one pair "
    "aren't independent, so p is too small and the interval too narrow where few pairs have many "
    "seeds."
)


@dataclass(frozen=True)
class Mean:
    """A measure of one setting."""

    n: int
    mean: float
    reach: float
    """Half the 95 % confidence interval; NaN for a single run."""
    pairs: int = 0
    """Number of runs of the first setting that differ in nothing else."""
    difference: float = math.nan
    """Mean difference from the first setting on these."""
    p: float = math.nan
    """Corrected p-value of the difference; NaN for the first setting."""


@dataclass(frozen=True)
class Row:
    """One value of the compared key."""

    value: str
    done: int
    unfinished: int
    means: dict[str, Mean]


@dataclass(frozen=True)
class Comparison:
    """The values of one swept key, compared."""

    key: str
    measures: list[str]
    rows: list[Row]

    def best(self, measure: str) -> set[str]:
        """The values with the best mean; none if all means are equal."""
        means = {row.value: row.means[measure].mean for row in self.rows if measure in row.means}
        if len(set(means.values())) < 2:
            return set()
        most = max if BETTER[measure] > 0 else min
        return {value for value, mean in means.items() if mean == most(means.values())}


def compare(key: str, runs: Sequence[tuple[str, tuple[str, ...], Run]]) -> Comparison:
    """Compare the values of ``key``.

    ``runs`` are (value of the key, everything else that tells runs apart, run); two runs with equal
    rest are a pair. The first value is what the others are compared with.
    """
    values = list(dict.fromkeys(value for value, _, _ in runs))
    numbers = {
        name: {
            value: {
                rest: x
                for v, rest, run in runs
                if v == value and (x := number(run, name)) is not None
            }
            for value in values
        }
        for name in BETTER
    }
    measures = [name for name in BETTER if any(numbers[name].values())]
    means: dict[str, dict[str, Mean]] = {value: {} for value in values}
    for name in measures:
        first = numbers[name][values[0]]
        found = {}
        for value in values:
            own = numbers[name][value]
            if own:
                given = np.array(list(own.values()))
                mean, low, _ = mean_interval(given)
                shared = np.array([own[rest] - first[rest] for rest in own if rest in first])
                found[value] = (len(given), mean, mean - low, shared)
        later = [value for value in found if value != values[0]]
        corrected = dict(
            zip(later, holm([sign_test(found[value][3]) for value in later]), strict=True)
        )
        for value, (n, mean, reach, shared) in found.items():
            if value == values[0] or not len(shared):
                means[value][name] = Mean(n, mean, reach)
            else:
                apart = float(shared.mean())
                means[value][name] = Mean(n, mean, reach, len(shared), apart, corrected[value])
    rows = []
    for value in values:
        states = [run.status for v, _, run in runs if v == value]
        done = states.count("done")
        rows.append(Row(value, done, len(states) - done, means[value]))
    return Comparison(key, measures, rows)


def number(run: Run, name: str) -> float | None:
    """A finished run's measure; None if it has none."""
    if run.status != "done":
        return None
    value = run.seconds if name == "seconds" else run.metrics.get(name)
    return None if value is None or not math.isfinite(value) else float(value)


def sign_test(differences: Float[np.ndarray, " n"]) -> float:
    """Two-sided p-value of a mean difference by changing signs (Fisher's permutation test).

    1 without differences. With n differences it is at least 2 / 2^n.
    """
    n = len(differences)
    if n == 0 or not np.any(differences):
        return 1.0
    if n <= EXACT:
        signs = np.array(list(product((1.0, -1.0), repeat=n)))
    else:
        signs = np.random.default_rng(0).choice((1.0, -1.0), (20_000, n))
        signs[0] = 1.0  # the observed one, so that p is never 0
    extreme = np.abs(signs @ differences) >= abs(differences.sum()) * (1 - 1e-12)
    return float(extreme.mean())


def holm(values: Sequence[float]) -> list[float]:
    """Holm's step-down correction of p-values for multiple tests."""
    order = np.argsort(values)
    corrected, least = np.ones(len(values)), 0.0
    for rank, at in enumerate(order):
        least = max(least, min(1.0, (len(values) - rank) * values[at]))
        corrected[at] = least
    return corrected.tolist()


# ------------------------------------------------------------------------------------------ tables


def write_csv(comparison: Comparison, path: Path) -> None:
    """One row per value and measure."""
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        head = ("measure", "n", "mean", "low", "high", "pairs", "difference", "p")
        writer.writerow((comparison.key, "done", "unfinished", *head))
        for row in comparison.rows:
            for name, m in row.means.items():
                interval = (m.mean - m.reach, m.mean + m.reach)
                numbers = (m.mean, *interval, m.pairs, m.difference, m.p)
                told = ("" if math.isnan(x) else f"{x:.6g}" for x in numbers)
                writer.writerow((row.value, row.done, row.unfinished, name, m.n, *told))


def latex(comparison: Comparison) -> str:
    """A table for booktabs: a row per value, the best mean of each measure in bold, with those that
    are printed alike. Measures with the same mean in all of several rows are only named in a
    comment."""
    arrows = {1: r"$\uparrow$", -1: r"$\downarrow$"}
    head = [escaped(comparison.key), "$n$"]
    shown = [name for name in comparison.measures if not _is_same(comparison, name)]
    head += [_head(name, arrows[BETTER[name]]) for name in shown]
    lines = ["% \\usepackage{booktabs}", f"% {INTERVAL}"]
    if same := [name for name in comparison.measures if name not in shown]:
        lines.append(f"% The same in all rows: {', '.join(same)}.")
    lines += [rf"\begin{{tabular}}{{@{{}}lr{'r' * len(shown)}@{{}}}}", r"\toprule"]
    lines += [" & ".join(head) + r" \\", r"\midrule"]
    printed = {
        name: {
            row.value: _cell(row.means[name].mean, row.means[name].reach)
            for row in comparison.rows
            if name in row.means
        }
        for name in shown
    }
    bold = {name: _alike(printed[name], comparison.best(name)) for name in shown}
    for row in comparison.rows:
        total = row.done + row.unfinished
        cells = [
            escaped(row.value),
            str(row.done) if row.done == total else f"{row.done} of {total}",
        ]
        for name in shown:
            cell = printed[name].get(row.value)
            text = rf"\mathbf{{{cell}}}" if row.value in bold[name] else cell
            cells.append("--" if cell is None else f"${text}$")
        lines.append(" & ".join(cells) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


def _alike(printed: Mapping[str, str], best: set[str]) -> set[str]:
    """The values whose means are printed as one of the best; none if all are."""
    means = {value: cell.partition(r" \pm")[0] for value, cell in printed.items()}
    found = {value for value, mean in means.items() if mean in {means[each] for each in best}}
    return found if len(found) < len(means) else set()


def _is_same(comparison: Comparison, measure: str) -> bool:
    means = [row.means[measure].mean for row in comparison.rows if measure in row.means]
    return 1 < len(means) == len(comparison.rows) and len(set(means)) == 1


def _head(name: str, arrow: str) -> str:
    """A measure's name on up to two lines, to keep its column narrow."""
    first, _, rest = name.partition("_")
    if not rest:
        return f"{escaped(first)} {arrow}"
    words = escaped(rest.replace("_", " ").replace("iou", "IoU"))
    return rf"\begin{{tabular}}[b]{{@{{}}r@{{}}}}{escaped(first)}\\ {words} {arrow}\end{{tabular}}"


def _cell(mean: float, reach: float) -> str:
    """A mean and half its interval in math mode, to two significant digits of the latter."""
    if math.isnan(reach):
        return _number(mean)
    if reach == 0:
        return rf"{_number(mean)} \pm 0"
    power = math.floor(math.log10(max(abs(mean), reach)))
    power = 0 if power in PLAIN else power
    digits = max(0, 1 - math.floor(math.log10(reach)) + power)
    if digits > MOST_DIGITS:
        return rf"{_number(mean)} \pm {_number(reach)}"
    text = rf"{mean / 10.0**power:.{digits}f} \pm {reach / 10.0**power:.{digits}f}"
    return rf"({text})\times 10^{{{power}}}" if power else text


def _number(value: float) -> str:
    """A number with three digits in math mode."""
    text, _, exponent = f"{value:.3g}".partition("e")
    return rf"{text}\times 10^{{{int(exponent)}}}" if exponent else text


def escaped(text: str) -> str:
    """Text with LaTeX's special characters escaped."""
    special = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
               "<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}"}  # fmt: skip
    return "".join(special.get(c, rf"\{c}" if c in "&%$#_{}" else c) for c in text)
