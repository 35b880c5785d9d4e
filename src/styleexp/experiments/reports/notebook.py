"""Shared code of the notebooks in ``reports/``: tables of runs, figures, the paper's claims.

Only reads collected tables and saved files; nothing here trains or renders.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from styleexp.experiments.reports import comparison, differing, html, page, sweep_page
from styleexp.experiments.reports.collect import collect
from styleexp.runs import finding, results
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    import pandas
    from IPython.display import HTML
    from IPython.display import Image as Shown
    from matplotlib.figure import Figure

    from styleexp.runs.reading import Run

VERDICTS = {True: "yes", False: "no", None: "can't be told"}
RANDOM = "vgg19_random"
"""Encoder with random weights, whose results are meaningless."""


def runs(folder: str | Path, *experiments: str) -> pandas.DataFrame:
    """The collected runs of these experiments (default: all) below ``folder``, in order.

    Adds to the columns of `collect`: ``path``, ``pair`` (source-style), ``seed``, and ``axis.*``,
    the overrides that not all runs share. Raises `UserError` if there is no such run.
    """
    folder = Path(folder)
    found = {run.folder: run for run in finding.find(folder)}
    kept = {
        path: run for path, run in found.items() if not experiments or belongs(run, experiments)
    }
    if not kept:
        wanted = " or ".join(experiments) or "any experiment"
        raise UserError(f"there is no run of {wanted} below '{folder}'.")
    axes = sweep_page.axes(list(kept.values()))
    frame = collect(folder)
    frame["path"] = [folder / run for run in frame["run"]]
    frame = frame.set_index("path", drop=False).reindex(list(kept))
    frame["path"] = list(kept)
    frame["status"] = [run.status for run in kept.values()]
    frame["pair"] = [f"{run.part('source')}-{run.part('style')}" for run in kept.values()]
    given = [differing.settings(run) for run in kept.values()]
    frame["seed"] = [each.get(differing.SEED, "0") for each in given]
    for key in axes:
        frame[f"axis.{key}"] = [each.get(key, differing.OMITTED) for each in given]
    return frame.reset_index(drop=True).dropna(axis=1, how="all")


def belongs(run: Run, experiments: Sequence[str]) -> bool:
    """Whether a run belongs to one of the experiments, by its overrides or its folder."""
    named = differing.settings(run).get("experiment")
    return named in experiments or any(part in experiments for part in run.folder.parts)


def caution(frame: pandas.DataFrame) -> str:
    """Caveats about these runs, as Markdown; may be empty."""
    notes = []
    not_done = frame[frame["status"] != "done"]
    if len(not_done):
        counts = ", ".join(f"{n} {state}" for state, n in not_done["status"].value_counts().items())
        notes.append(f"{len(not_done)} of {len(frame)} runs are not finished: {counts}.")
    learned = frame
    if "config.baseline.name" in frame:
        learned = frame[frame["config.baseline.name"].isna()]
    encoders = learned.get("config.encoder.name")
    if encoders is not None and (encoders == RANDOM).any():
        notes.append("The encoder has random weights: nothing here says anything about style.")
    steps = learned.get("config.optim.steps")
    if steps is not None and steps.dropna().max() < 100:
        notes.append(f"The runs have {steps.dropna().max():g} steps, the paper's 1000.")
    if "seed" in frame and frame["seed"].nunique() == 1:
        notes.append("There is only one seed: differences may be due to chance.")
    return "\n".join(f"- **{each}**" for each in notes)


def pictures(frame: pandas.DataFrame, columns: str, rows: str = "pair") -> Shown:
    """Arrange the results by two columns of the table, as in the paper's figure, from saved files.

    Each row starts with its source. Cells of unfinished runs show their status.
    """
    from matplotlib.figure import Figure

    across, down = _order(frame[columns]), _order(frame[rows])
    figure = Figure(figsize=(1.9 * (len(across) + 1), 2.05 * len(down) + 0.2), layout="constrained")
    axes = figure.subplots(len(down), len(across) + 1, squeeze=False)
    for axis in axes.ravel():
        axis.set_axis_off()
    for y, row in enumerate(down):
        line = frame[frame[rows] == row]
        for x, column in enumerate(across):
            axis, cell = axes[y, x + 1], line[line[columns] == column]
            if y == 0:
                axis.set_title(str(column), fontsize=9)
            if cell.empty:
                continue
            first = cell.iloc[0]
            seen = html.views(Path(first["path"]), 2)
            if first["status"] != "done" or not seen:
                axis.text(0.5, 0.5, first["status"], ha="center", color="#a3262b")
                axis.set(xlim=(0, 1), ylim=(0, 1))
                continue
            axis.imshow(seen[0], cmap="gray", vmin=0, vmax=255)
        _show_row_head(axes[y, 0], line, str(row))
    return _picture(figure)


def _show_row_head(axis: Any, line: pandas.DataFrame, label: str) -> None:
    """Show the row's label, its source from a preview, and its style if it has only one."""
    rows = (0, 1) if line["pair"].nunique() == 1 else (0,)
    axis.set_title(f"{label}\n({'source, style' if len(rows) == 2 else 'source'})", fontsize=9)
    for path in line["path"]:
        seen = [html.views(Path(path), row) for row in rows]
        if all(seen):
            pair = np.concatenate([np.asarray(row[0]) for row in seen], axis=1)
            axis.imshow(pair, cmap="gray", vmin=0, vmax=255)
            return


def triples(frame: pandas.DataFrame, across: int = 2) -> Shown:
    """Show source, style and result of every run, ``across`` runs per row. Cells of unfinished runs
    show their status."""
    from matplotlib.figure import Figure

    down = math.ceil(len(frame) / across)
    figure = Figure(figsize=(4.6 * across, 1.8 * down), layout="constrained")
    axes = figure.subplots(down, across, squeeze=False).ravel()
    for axis in axes:
        axis.set_axis_off()
    for axis, (_, run) in zip(axes, frame.iterrows(), strict=False):
        axis.set_title(f"{run['pair']} (source, style, result)", fontsize=9)
        seen = [html.views(Path(run["path"]), row) for row in (0, 1, 2)]
        if run["status"] != "done" or not all(seen):
            axis.text(0.5, 0.5, run["status"], ha="center", color="#a3262b")
            continue
        line = np.concatenate([np.asarray(row[0]) for row in seen], axis=1)
        axis.imshow(line, cmap="gray", vmin=0, vmax=255)
    return _picture(figure)


def bars(frame: pandas.DataFrame, by: str, metrics: Sequence[str]) -> Shown:
    """Draw a small chart per metric: a dot per run, a line for the mean."""
    from matplotlib.figure import Figure

    kept = [m for m in metrics if f"metric.{m}" in frame or m in frame]
    if not kept:
        raise UserError(f"none of {', '.join(metrics)} was measured: see 'styleexp-metrics run'.")
    figure = Figure(figsize=(3.4 * len(kept), 3.0), layout="constrained")
    for axis, name in zip(figure.subplots(1, len(kept), squeeze=False)[0], kept, strict=True):
        column = f"metric.{name}" if f"metric.{name}" in frame else name
        groups = _order(frame[by])
        for place, group in enumerate(groups):
            values = frame.loc[frame[by] == group, column].dropna().to_numpy(dtype=float)
            axis.plot([place] * len(values), values, "o", color="#1f5fa8", alpha=0.7)
            if len(values):
                axis.hlines(values.mean(), place - 0.3, place + 0.3, color="#1d2230")
        axis.set_xticks(range(len(groups)), groups, rotation=30, ha="right")
        axis.set_title(name, fontsize=10)
        axis.grid(axis="y", color="#d9d7d0")
    return _picture(figure)


def _picture(figure: Figure) -> Shown:
    """Convert a figure for display in a notebook, with any backend."""
    import io

    from IPython.display import Image

    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=110)
    return Image(out.getvalue())


def mean(frame: pandas.DataFrame, metric: str, **where: Any) -> float:
    """Mean of a metric over the matching finished runs; NaN if none was measured.

    ``where`` filters by column, with ``__`` for a dot: ``axis__layers="low"``.
    """
    column = f"metric.{metric}" if f"metric.{metric}" in frame else metric
    if column not in frame:
        return math.nan
    kept = frame[frame["status"] == "done"]
    for key, value in where.items():
        key = key.replace("__", ".")
        if key not in kept:
            return math.nan
        kept = kept[kept[key] == value]
    return float(kept[column].astype(float).mean())


def slope(path: str | Path) -> float:
    """RMS slope of the displacement along the result's edges: how steep and, relative to the
    height, how fine the relief is. NaN without a result."""
    from styleexp.inputs.meshes import edges_of

    file = Path(path) / results.NAME
    if not file.is_file():
        return math.nan
    result = results.read(file)
    if result.displacement is None:
        return math.nan
    a, b = edges_of(result.faces).T
    length = np.linalg.norm(result.vertices[a] - result.vertices[b], axis=1)
    steep = np.abs(result.displacement[a] - result.displacement[b])[length > 0] / length[length > 0]
    return float(np.sqrt(np.square(steep).mean()))


@dataclass(frozen=True)
class Claim:
    """A claim of the paper, with the corresponding result of the runs."""

    paper: str
    ours: str
    holds: bool | None
    """None if undecidable."""


def smaller(paper: str, first: tuple[str, float], second: tuple[str, float], what: str) -> Claim:
    """The claim that the first number is smaller than the second; undecidable unless both are
    known."""
    ours = f"{what}: {first[0]} {first[1]:.3g}, {second[0]} {second[1]:.3g}"
    if math.isnan(first[1]) or math.isnan(second[1]):
        return Claim(paper, f"{ours} (nan: not measured)", None)
    return Claim(paper, ours, first[1] < second[1])


def claims(*each: Claim) -> HTML:
    """Display claims as a table."""
    import pandas
    from IPython.display import HTML

    rows = [(c.paper, c.ours, VERDICTS[c.holds]) for c in each]
    frame = pandas.DataFrame(rows, columns=["the paper says", "we see", "does it hold"])
    with pandas.option_context("display.max_colwidth", None):  # else pandas truncates sentences
        return HTML(frame.to_html(index=False, border=0))


def table(frame: pandas.DataFrame, metrics: Sequence[str] = ()) -> pandas.DataFrame:
    """The runs' axes and numbers for display: those of ``metrics`` that exist, or all."""
    # Implied by ``pair``; and the experiment that started a run shared by several.
    redundant = ("axis.pair", "axis.source", "axis.style", "axis.experiment")
    axes = [c for c in frame if str(c).startswith("axis.") and c not in redundant]
    measured = [f"metric.{m}" for m in metrics] or [c for c in frame if c.startswith("metric.")]
    wanted = ["pair", *axes, "seed", "status", "seconds", "loss", *measured]
    shown = frame[[column for column in wanted if column in frame]]
    return shown.rename(columns=lambda name: name.split(".", 1)[-1] if "." in name else name)


def show(frame: pandas.DataFrame) -> HTML:
    """Format a table for a page: four digits, dashes for missing values, meanings of the
    columns."""
    from IPython.display import HTML

    def cell(value: float) -> str:
        return "–" if math.isnan(value) else f"{value:.4g}"

    made = frame.to_html(index=False, border=0, classes="numbers", float_format=cell, na_rep="–")
    known = {"seconds": "of the whole run", "loss": OWN_LOSS, **page.MEANINGS}
    items = [f"<dt>{name}</dt><dd>{known[name]}</dd>" for name in frame if name in known]
    legend = f"<dl class='meanings'>{''.join(items)}</dl>" if items else ""
    return HTML(f"<div style='overflow-x:auto'>{made}</div>{legend}")


OWN_LOSS = "of the run's last steps; other layers or weights have another scale"


def save(frame: pandas.DataFrame, folder: str | Path | None, name: str) -> None:
    """Write a table as ``name.csv`` and ``name.tex`` (booktabs), if a folder is given."""
    if folder is None:
        return
    from styleexp.runs.records import RunFolder

    target = RunFolder(Path(folder))
    target.path.mkdir(parents=True, exist_ok=True)
    target.write(f"{name}.csv", lambda path: frame.to_csv(path, index=False))
    target.write(f"{name}.tex", lambda path: path.write_text(latex(frame), encoding="utf-8"))


def latex(frame: pandas.DataFrame) -> str:
    """A LaTeX table with booktabs; text is escaped, numbers have four digits."""

    def cell(value: Any) -> str:
        if isinstance(value, float | np.floating):
            return "--" if math.isnan(value) else f"{value:.4g}"
        return comparison.escaped(str(value))

    kinds = ["r" if frame[column].dtype.kind in "fi" else "l" for column in frame]
    lines = [r"\begin{tabular}{" + "".join(kinds) + "}", r"\toprule"]
    lines.append(" & ".join(cell(column) for column in frame) + r" \\")
    lines.append(r"\midrule")
    for row in frame.itertuples(index=False):
        lines.append(" & ".join(cell(value) for value in row) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


def _order(column: pandas.Series) -> list[Any]:
    values = list(dict.fromkeys(column))
    try:
        return sorted(values, key=float)
    except (TypeError, ValueError):
        return values
