"""The page of a sweep: a grid over the swept axes, a sortable table, and charts per axis."""

from __future__ import annotations

import functools
import itertools
import math
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from styleexp.experiments.reports import charts, comparison, differing, html, page
from styleexp.experiments.reports.comparison import Comparison
from styleexp.experiments.reports.differing import OMITTED, SEED, settings
from styleexp.runs import finding
from styleexp.runs.reading import Run
from styleexp.runs.records import RunFolder
from styleexp.system.errors import UserError

NAME = "report.html"
FIRST = (
    *("loss", "match", "craft", "likeness", "coverage", "style_distance", "silhouette_iou"),
    "flipped_faces",
)
"""Measures whose columns are shown at first."""
SPARSE = 4
"""Cells per run above which a grid isn't shown."""
ABREAST = 5
"""Pictures in a row where there is no grid."""


@dataclass(frozen=True)
class Cell:
    """Runs with the same values on all axes; empty if none was planned."""

    runs: list[Run] = field(default_factory=list)


@dataclass(frozen=True)
class Grid:
    """One sheet of the grid: rows and columns are the first two axes."""

    title: str
    """Values of the remaining axes."""
    rows: list[tuple[str, list[Cell]]]
    columns: list[str]


@dataclass(frozen=True)
class Sweep:
    """Runs below one folder that form a sweep."""

    name: str
    runs: list[Run]
    axes: dict[str, list[str]]
    """Values of each swept key, in job order."""

    def values(self, run: Run) -> tuple[str, ...]:
        """A run's values on the axes."""
        given = settings(run)
        return tuple(given.get(key, OMITTED) for key in self.axes)

    def seed_of(self, run: Run) -> str | None:
        """A run's seed, if seeds are swept."""
        return settings(run).get(SEED) if self.seeds else None

    @property
    def seeds(self) -> bool:
        """Whether runs differ in their seeds."""
        return len({settings(run).get(SEED) for run in self.runs}) > 1

    def label(self, run: Run) -> str:
        """Label that distinguishes a run from the others."""
        values = [f"{k}={v}" for k, v in zip(self.axes, self.values(run), strict=True)]
        seed = self.seed_of(run)
        return ", ".join([*values, *([f"seed {seed}"] if seed else [])]) or run.folder.name

    @property
    def scattered(self) -> bool:
        """Whether a grid over the axes would be nearly empty, as that of a search."""
        return math.prod(map(len, self.axes.values())) > SPARSE * len(self.runs)

    @property
    def row_axis(self) -> str:
        """Key of the grid's rows; empty for a single axis, and for scattered runs."""
        return next(iter(self.axes)) if len(self.axes) > 1 and not self.scattered else ""

    @property
    def column_axis(self) -> str:
        """Key of the grid's columns; empty for scattered runs."""
        if self.scattered:
            return ""
        return list(self.axes)[1] if len(self.axes) > 1 else next(iter(self.axes), "")

    @property
    def grids(self) -> list[Grid]:
        """One sheet per combination of the axes from the third on; for scattered runs one in all,
        the best first."""
        if self.scattered:
            best = sorted(self.runs, key=_rank)
            lines = [best[at : at + ABREAST] for at in range(0, len(best), ABREAST)]
            return [Grid("", [("", [Cell([run]) for run in line]) for line in lines], [])]
        cells: dict[tuple[str, ...], Cell] = {}
        for run in self.runs:
            cells.setdefault(self.values(run), Cell()).runs.append(run)
        keys = list(self.axes)
        rows = self.axes[keys[0]] if len(keys) > 1 else [""]
        columns = self.axes[self.column_axis] if keys else [""]
        sheets = []
        for rest in itertools.product(*(self.axes[key] for key in keys[2:])):

            def place(row: str, column: str, rest: tuple[str, ...] = rest) -> tuple[str, ...]:
                return (row, column, *rest) if len(keys) > 1 else (column,) if keys else ()

            body = [(r, [cells.get(place(r, c), Cell()) for c in columns]) for r in rows]
            if any(cell.runs for _, line in body for cell in line):
                title = ", ".join(f"{k}={v}" for k, v in zip(keys[2:], rest, strict=True))
                sheets.append(Grid(title, body, columns))
        return sheets


def write(folder: Path, run_pages: bool = True) -> Path:
    """Write the page of all runs below ``folder``; return its path.

    Also writes missing pages of finished runs, unless ``run_pages`` is false, and the means over
    pairs and seeds, for each swept key, as ``means-KEY.csv`` and ``.tex``. Raises `UserError` if
    there is no run.
    """
    runs = finding.find(folder)
    if not runs:
        raise UserError(f"there is no run below '{folder}': give the folder of a run or a sweep.")
    if run_pages:
        for run in runs:
            if run.status == "done" and not (run.folder / page.NAME).is_file():
                page.rewrite(run.folder)
    for sweep in split(folder, runs):
        target = RunFolder(folder / sweep.name)
        for each in comparisons(sweep):
            name = f"means-{each.key.replace('/', '_')}"
            target.write(f"{name}.csv", functools.partial(comparison.write_csv, each))
            text = comparison.latex(each)
            target.write(f"{name}.tex", functools.partial(Path.write_text, data=text))
    return html.save(folder / NAME, build(folder, runs))


def build(folder: Path, runs: list[Run]) -> str:
    """Render the page as HTML, with links relative to ``folder``."""
    sweeps = split(folder, runs)
    return html.render(
        "sweep.html",
        ["sweep.js"],
        title=title(folder, sweeps),
        sweeps=sweeps,
        states=_count(runs),
        pictures={run.folder: _picture(run) for run in runs},
        headlines={run.folder: headline(run) for run in runs},
        links={run.folder: _link(run, folder) for run in runs},
        searched={run.folder: searched(run) for run in runs},
        measures={sweep.name: measures(sweep) for sweep in sweeps},
        first=FIRST,
        plots={sweep.name: plots(sweep) for sweep in sweeps},
        comparisons={sweep.name: comparisons(sweep) for sweep in sweeps},
        better=comparison.BETTER,
        caption=comparison.CAPTION,
    )


def title(folder: Path, sweeps: list[Sweep]) -> str:
    """The folder's name, of one that is named by the time also its parent's, and what differs."""
    place = folder.resolve()
    name = place.name
    if finding.DATED.fullmatch(name):
        name = f"{place.parent.name}, {name.replace('_', ' ', 1)}"
    if len(sweeps) != 1:
        return f"{name}: {len(sweeps)} sweeps"
    (sweep,) = sweeps
    if sweep.scattered:
        return f"{name}: {len(sweep.runs)} trials of {', '.join(sweep.axes)}"
    parts = [told] if (told := differing.told(sweep.axes)) else []
    if sweep.seeds:
        parts.append(f"{len({settings(run).get(SEED) for run in sweep.runs})} seeds")
    return f"{name}: {'; '.join(parts)}" if parts else name


def searched(run: Run) -> str:
    """What the page's filter looks in: a run's folder, status, overrides and reason."""
    return " ".join([run.folder.name, run.status, *run.overrides, run.remark or ""]).lower()


def split(folder: Path, runs: list[Run]) -> list[Sweep]:
    """Group runs into sweeps by their parent folder."""
    together: dict[Path, list[Run]] = {}
    for run in runs:
        together.setdefault(run.folder.parent, []).append(run)
    sweeps = []
    for parent, beside in together.items():
        below = parent.relative_to(folder) if parent != folder.parent else Path()
        sweeps.append(Sweep("" if below == Path() else str(below), beside, axes(beside)))
    return sweeps


def axes(runs: list[Run]) -> dict[str, list[str]]:
    """Keys whose values differ between runs, with their values; numbers are sorted."""
    given = [settings(run) for run in runs]
    keys = dict.fromkeys(key for each in given for key in each if key != SEED)
    found = {}
    for key in keys:
        values = list(dict.fromkeys(each.get(key, OMITTED) for each in given))
        if len(values) > 1:
            found[key] = sorted(values, key=float) if all(map(_is_number, values)) else values
    return found


def headline(run: Run) -> tuple[str, float] | None:
    """The most informative metric of a run, shown below its picture."""
    for name in ("match", "style_distance", "loss"):
        if name in run.summary:
            return name, run.summary[name]
    return None


def _rank(run: Run) -> float:
    """Order of the runs of a search, the best first; unfinished ones last."""
    shown = headline(run)
    if shown is None:
        return math.inf
    name, value = shown
    return -value if comparison.BETTER.get(name, -1) > 0 else value


def measures(sweep: Sweep) -> list[str]:
    """Names of all numbers that any run of the sweep has."""
    first = [shown[0] for run in sweep.runs if (shown := headline(run))]
    return list(dict.fromkeys([*first, *(name for run in sweep.runs for name in run.summary)]))


def comparisons(sweep: Sweep) -> list[Comparison]:
    """The means of each swept key's values, for keys with several runs of some value."""
    found = []
    for number, key in enumerate(sweep.axes):
        runs = []
        for value in sweep.axes[key]:
            for run in sweep.runs:
                values = sweep.values(run)
                if values[number] == value:
                    rest = (*values[:number], *values[number + 1 :], sweep.seed_of(run) or "")
                    runs.append((value, rest, run))
        if len(runs) > len(sweep.axes[key]):
            found.append(comparison.compare(key, runs))
    return [each for each in found if each.measures]


def plots(sweep: Sweep) -> list[dict[str, Any]]:
    """One chart per axis and number."""
    made = []
    for name in measures(sweep):
        for number, (key, values) in enumerate(sweep.axes.items()):
            groups = [
                (
                    value,
                    [
                        (sweep.label(run), run.summary[name])
                        for run in sweep.runs
                        if sweep.values(run)[number] == value
                        and run.status == "done"
                        and name in run.summary
                    ],
                )
                for value in values
            ]
            chart = charts.dot_chart(f"{name} by {key}", key, groups)
            if chart:
                made.append({"measure": name, "chart": chart})
    return made


def _picture(run: Run) -> str | None:
    seen = html.views(run.folder, 2) if run.status == "done" else []
    return html.data_uri(seen[0], html.THUMBNAIL) if seen else None


def _link(run: Run, folder: Path) -> str | None:
    """Relative link from the sweep's page to the run's."""
    from urllib.parse import quote

    if not (run.folder / page.NAME).is_file():
        return None
    return quote(Path(os.path.relpath(run.folder / page.NAME, folder)).as_posix())


def _count(runs: list[Run]) -> dict[str, int]:
    states = [run.status for run in runs]
    return {state: states.count(state) for state in dict.fromkeys(states)}


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
