"""The page of several runs side by side: what differs of their configurations and metrics, and
their results in linked 3D views. Self-contained, without network access."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np

from styleexp.experiments.reports import comparison, differing, glb, html, page
from styleexp.experiments.reports import shown as shows
from styleexp.runs import finding, provenance, reading
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from jaxtyping import Float

    from styleexp.experiments.reports.shown import Shape, Shown
    from styleexp.runs.reading import Run

LETTERS = "ABCDEFGHIJKL"
"""What the runs are called on the page; there may be as many."""
STILL_PIXELS = 320
NAME_LENGTH = 80
"""Maximum number of characters of the page's file name, without its suffix."""
PARTS = ("source", "style")
UNIMPORTANT = ("threads", "debug", "report", "preview")
"""Keys that don't affect a result: the last in a title."""


@dataclass(frozen=True)
class Column:
    """One run on the page."""

    letter: str
    label: str
    """What tells it from the others."""
    run: Run
    shown: Shown
    link: str | None
    """Link to its own page."""
    still: str | None


@dataclass(frozen=True)
class Measure:
    """One metric of all runs."""

    name: str
    better: int
    """1 if larger is better, -1 if smaller is, 0 if neither is known."""
    values: list[float | None]

    @property
    def best(self) -> float | None:
        """The best value, if one is known to be."""
        known = [value for value in self.values if value is not None and value == value]
        if not self.better or len(known) < 2:
            return None
        return max(known) if self.better > 0 else min(known)

    def change(self, index: int) -> float | None:
        """A value's difference from the first; None if there is none."""
        first, value = self.values[0], self.values[index]
        return None if index == 0 or first is None or value is None else value - first


@dataclass(frozen=True)
class Apart:
    """How the results' displacements differ from the first result's, in radii of the source."""

    values: list[Float[np.ndarray, " vertices"] | None]
    """Of each run; None for the first, and where they can't be compared."""
    reasons: list[str]
    """One sentence for each that can't."""

    @property
    def reach(self) -> float:
        """Difference at which the colours end."""
        found = [np.abs(each) for each in self.values if each is not None]
        return float(np.percentile(np.concatenate(found), shows.WITHIN)) if found else 0.0


def write(folders: Sequence[Path], out: Path | None = None) -> Path:
    """Write the page of the runs in ``folders``, the first of which the others are compared with;
    return its path (default: named after them, in the folder that they have in common).

    Raises `UserError` for a folder that isn't a run's, one that is given twice, and too many.
    """
    if len(folders) > len(LETTERS):
        raise UserError(
            f"{len(folders)} runs are too many for one page: give up to {len(LETTERS)}."
        )
    places = [folder.resolve() for folder in folders]
    for folder, place in zip(folders, places, strict=True):
        if not finding.is_run(folder):
            raise UserError(
                f"'{folder}' is not a run's folder: several folders are compared, so each has to "
                "be of a single run; give a sweep's folder alone."
            )
        if places.count(place) > 1:
            raise UserError(f"'{folder}' is given twice: give different runs.")
    runs = [reading.readable(folder, "show") for folder in folders]
    target = out or _place(places)
    return html.save(target, build(runs, target))


def build(runs: Sequence[Run], target: Path) -> str:
    """Render the page as HTML, with links relative to ``target``."""
    columns = _columns(runs, target)
    apart = displacements_apart([each.shown for each in columns])
    panels, blocks = _meshes(columns, apart)
    measured, equal = measures(runs)
    assets = [run.record.get("assets") or {} for run in runs]
    return html.render(
        "compare.html",
        ["viewers.js", "run.js"],
        title=title(runs),
        columns=columns,
        configuration=differing.of([run.config for run in runs]),
        inputs=differing.of(
            [{kind: a.get("sha256") for kind, a in each.items() if a.get("sha256")}
             for each in assets]
        ),
        versions=differing.of([provenance.made_with(run.record) for run in runs]),
        measured=measured,
        equal=equal,
        meanings=page.MEANINGS,
        panels=panels,
        blocks=blocks,
        viewer=html.viewer(),
        heat=_legend(columns, apart),
        reasons=apart.reasons,
        plain=html.plain,
    )  # fmt: skip


def title(runs: Sequence[Run]) -> str:
    """What the runs have in common and what differs."""
    parts = {kind: {run.part(kind) for run in runs} for kind in PARTS}
    if all(len(names) == 1 for names in parts.values()):
        common = runs[0].title
    else:
        same = [names.pop() for names in parts.values() if len(names) == 1]
        common = same[0] if same else f"{len(runs)} runs"
    return f"{common}: {differing.told(keys_apart(runs)) or _otherwise(runs)}"


def keys_apart(runs: Sequence[Run]) -> dict[str, list[str]]:
    """The keys that tell the runs apart, with each run's value: those that were given if some
    differ, else those of the configuration."""
    given = differing.of_overrides(runs)
    if not given:
        rows = differing.of([run.config for run in runs])
        given = {key: [html.plain(value) for value in row] for key, row in rows.items()}
    named = {f"{kind}{end}" for kind in PARTS for end in ("", ".name", ".path")} | {"pair"}
    parts = {kind: [run.part(kind) for run in runs] for kind in PARTS}
    found = {kind: names for kind, names in parts.items() if len(set(names)) > 1}
    found |= {key: values for key, values in given.items() if key not in named} or (
        {} if found else given
    )
    return dict(sorted(found.items(), key=lambda pair: pair[0].split(".")[0] in UNIMPORTANT))


def measures(runs: Sequence[Run]) -> tuple[list[Measure], list[str]]:
    """The metrics that differ between the runs, those first that are known to be better one way;
    and the names of those that are equal."""
    tables = [run.summary for run in runs]
    for table, run in zip(tables, runs, strict=True):
        if run.seconds is not None:
            table["seconds"] = run.seconds
    found = differing.of(tables)
    equal = [
        name for name in dict.fromkeys(n for each in tables for n in each) if name not in found
    ]
    made = [Measure(name, comparison.BETTER.get(name, 0), row) for name, row in found.items()]
    known = list(comparison.BETTER)
    made.sort(key=lambda each: known.index(each.name) if each.better else len(known))
    return made, equal


def displacements_apart(shown: Sequence[Shown]) -> Apart:
    """Compare displacements vertex by vertex with the first run's."""
    values, reasons = list[Any]([None]), []
    for letter, each in zip(LETTERS[1:], shown[1:], strict=False):
        found = _apart(shown[0], each)
        values.append(None if isinstance(found, str) else found)
        if isinstance(found, str):
            reasons.append(f"{letter} {found}.")
    return Apart(values, reasons)


def _apart(first: Shown, other: Shown) -> Float[np.ndarray, " vertices"] | str:
    """The difference of two runs' displacements, in radii of their sources, or why there is
    none."""
    if first.result is None or other.result is None:
        return "or A has no result"
    if first.displacement is None or other.displacement is None:
        return "or A has no displacements"
    counts = len(other.result.vertices), len(first.result.vertices)
    if counts[0] != counts[1]:
        return f"has {counts[0]} vertices and A {counts[1]}, so no vertex of one is another's"
    if not np.array_equal(first.result.faces, other.result.faces):
        return "has other faces than A, so no vertex of one is another's"
    return other.displacement / other.radius - first.displacement / first.radius


def _columns(runs: Sequence[Run], target: Path) -> list[Column]:
    keys = keys_apart(runs)
    columns = []
    for number, run in enumerate(runs):
        told = [differing.setting(key, values[number]) for key, values in keys.items()]
        label = ", ".join(told[: differing.MOST_KEYS]) or run.folder.name
        own = run.folder / page.NAME
        link = os.path.relpath(own.resolve(), target.resolve().parent) if own.is_file() else None
        seen = html.views(run.folder, 2)
        columns.append(
            Column(
                LETTERS[number],
                label,
                run,
                shows.read(run),
                quote(Path(link).as_posix()) if link else None,
                html.data_uri(seen[0], STILL_PIXELS) if seen else None,
            )
        )
    return columns


def _meshes(columns: Sequence[Column], apart: Apart) -> tuple[list[dict[str, Any]], dict[str, str]]:
    """The panels, sources and styles that are equal only once, and the data blocks."""
    panels: list[dict[str, Any]] = []
    blocks: dict[str, str] = {}
    for kind in PARTS:
        for owners in _alike([getattr(each.shown, kind) for each in columns]):
            first = columns[owners[0]]
            of = (
                ""
                if len(owners) == len(columns)
                else " of " + ", ".join(LETTERS[k] for k in owners)
            )
            name = first.run.part(kind)
            panel = {"key": f"{kind}-{owners[0]}", "kind": kind, "alt": f"The {kind} {name}",
                     "title": f"{kind.capitalize()}{of}: {name}", "picture": None}  # fmt: skip
            content = first.shown.files().get(kind)
            if content is None:
                panel["picture"] = page.style_picture(getattr(first.shown, kind))
            else:
                blocks[f"glb-{panel['key']}"] = html.packed(content)
            panels.append(panel)
    for number, each in enumerate(columns):
        if each.shown.result is None:
            continue
        difference = apart.values[number]
        values = None if difference is None else np.clip(difference / (apart.reach or 1.0), -1, 1)
        content = replace(each.shown, displacement=None).files(heat=values)["result"]
        key = f"result-{number}"
        blocks[f"glb-{key}"] = html.packed(content)
        text = f"{each.letter}: {each.label}"
        panels.append(
            {"key": key, "kind": "result", "title": text, "alt": f"Result {text}", "picture": None}
        )
    return panels, blocks


def _alike(shapes: Sequence[Shape | np.ndarray | None]) -> list[list[int]]:
    """The indices of equal shapes, together; None is left out."""
    groups: list[list[int]] = []
    for number, shape in enumerate(shapes):
        if shape is None:
            continue
        for group in groups:
            if _equal(shapes[group[0]], shape):
                group.append(number)
                break
        else:
            groups.append([number])
    return groups


def _equal(first: Any, second: Any) -> bool:
    if isinstance(first, np.ndarray) or isinstance(second, np.ndarray):
        return type(first) is type(second) and np.array_equal(first, second)
    return np.array_equal(first.vertices, second.vertices) and np.array_equal(
        first.faces, second.faces
    )


def _legend(columns: Sequence[Column], apart: Apart) -> dict[str, Any] | None:
    """The legend of the differences; None if there are none to colour."""
    if apart.reach == 0:
        return None
    told = [
        f"{each.letter}: RMS {float(np.sqrt((values**2).mean())):.3g}, "
        f"from {values.min():.3g} to {values.max():.3g}".replace("-", "−")
        for each, values in zip(columns, apart.values, strict=True)
        if values is not None
    ]
    return {"gradient": glb.gradient(), "reach": f"{apart.reach:.3g}", "told": told}


def _otherwise(runs: Sequence[Run]) -> str:
    """What differs of runs with equal configurations."""
    sums = [
        {kind: a.get("sha256") for kind, a in (run.record.get("assets") or {}).items()}
        for run in runs
    ]
    if changed := differing.of(sums):
        return f"other files of the same name ({', '.join(changed)})"
    versions = differing.of([provenance.made_with(run.record) for run in runs])
    rows = {key: [str(value) for value in row] for key, row in versions.items()}
    return differing.told(rows) or "the same configuration, inputs and versions"


def _place(folders: Sequence[Path]) -> Path:
    """A file named after the runs, in the folder that they have in common."""
    common = Path(os.path.commonpath([folder.parent for folder in folders]))
    names = ["-".join(folder.relative_to(common).parts) for folder in folders]
    stem = re.sub(r"[^\w.+-]+", "-", "compare-" + "-".join(names))[:NAME_LENGTH].strip("-.")
    return common / f"{stem}.html"
