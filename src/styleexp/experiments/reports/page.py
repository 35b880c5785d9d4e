"""The page of one run, ``report.html``: self-contained, without network access."""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from styleexp.experiments.ratings import verdict
from styleexp.experiments.reports import charts, glb, html
from styleexp.experiments.reports import shown as shows
from styleexp.runs import provenance, reading

if TYPE_CHECKING:
    from styleexp.experiments.reports.shown import Shape, Shown
    from styleexp.method.base import Result
    from styleexp.runs.reading import Run

NAME = "report.html"
STYLE_PIXELS = 720
"""Longer side of a style picture on the page, in pixels."""
STILL_PIXELS = 1280
MEANINGS = {
    "match": "estimate of how raters rate the match with the style, from 1 to 5",
    "craft": "estimate of how raters rate how clean it is, from 1 to 5",
    "likeness": "how much of the style the surface carries, 0 to 1",
    "order": "how far the style repeats itself, 0 to 1",
    "masked": "share of the surface that style.mask selects; the next are of that part",
    "coverage": "share of the surface that carries at least half of the style",
    "coverage_outer": "the same of the third of the surface that is farthest out",
    "coverage_top": "of the third at the top",
    "coverage_bottom": "of the third at the bottom",
    "coverage_front": "of the third in front",
    "coverage_back": "of the third at the back",
    "bend": "99th percentile of the bend at an edge; large where the surface is crumpled",
    "style_distance": "to the style, by an encoder not used in training; 0: the style, 1: no style",
    "relief_distance": "to the style's relief or a picture's brightness, no network; 0 is equal",
    "relief_rms": "RMS height of the relief, in radii of the source",
    "relief_share": "RMS height relative to the style mesh's",
    "silhouette_iou": "IoU of the silhouettes with the source's; 1 is equal",
    "chamfer": "mean distance to the source's surface, relative to its diagonal",
    "hausdorff": "maximum distance to the source's surface, relative to its diagonal",
    "volume_change": "relative to the source's volume",
    "flipped_faces": "fraction of faces that are flipped",
    "self_intersections": "fraction of faces that intersect another one",
}
"""Short descriptions of the metrics in `styleexp.experiments.metrics`."""
FILES = (
    ("result.glb", "the result, for viewers and engines"),
    ("result.ply", "with the displacement as a vertex attribute"),
    ("result.obj", "with the input file's own vertices"),
    ("result.stl", "for printing, in the source's units"),
    ("result.3mf", "for printing, one unit of the source a millimetre"),
    ("preview.png", "four views of source, style and result"),
    ("turntable.gif", "a turntable of the result"),
    ("direction.png", "which way the pattern was laid"),
    ("run.json", "all inputs of the run"),
    ("metrics.jsonl", "one line per step"),
    ("metrics.json", "metrics of the result"),
    ("check.png", "the result drawn by pyrender"),
)


def write(run: Run, shown: Shown) -> Path:
    """Write a run's page into its folder; return its path."""
    return html.save(run.folder / NAME, build(run, shown))


def write_ended(folder: Path, result: Result, seconds: float) -> Path:
    """Write the page of a run that has finished its last step but not yet updated its status."""
    run = reading.read(folder)
    ended = dataclasses.replace(run, status="done", reason=None, seconds=round(seconds, 1))
    return write(ended, shows.of(result))


def rewrite(folder: Path, tell: Callable[[str], Any] | None = None) -> Path:
    """Write the page of a run, finished or not, from its folder; ``tell`` is called with a sentence
    for everything that couldn't be shown."""
    run = reading.readable(folder, "show")
    shown = shows.read(run)
    if tell is not None:
        for note in shown.missing:
            tell(note)
    return write(run, shown)


def build(run: Run, shown: Shown) -> str:
    """Render the page as HTML."""
    return html.render(
        "run.html",
        ["viewers.js", "run.js"],
        run=run,
        facts=facts(run, shown),
        panels=panels(run, shown),
        blocks={f"glb-{k}": html.packed(content) for k, content in shown.files().items()},
        viewer=html.viewer(),
        style_picture=style_picture(shown.style),
        heat=_heat(shown),
        curves=curves(run),
        notes=run.record.get("notes") or (),
        warnings=[
            *provenance.resumptions(run.record),
            *run.problems,
            *shown.missing,
        ],
        inputs=_inputs(run),
        made_with=provenance.made_with(run.record),
        still=html.picture(run.folder / "preview.png", STILL_PIXELS),
        directions=html.picture(run.folder / "direction.png", STILL_PIXELS),
        meanings=MEANINGS,
        verdict=verdict(run.metrics),
        files=[(name, what) for name, what in FILES if (run.folder / name).is_file()],
        overridden=_given(run),
        plain=html.plain,
    )


def _given(run: Run) -> set[str]:
    """The configuration's keys that the user set: ``style=bubble`` sets ``style.name`` alone."""
    keys = {override.lstrip("+~").split("=")[0] for override in run.overrides}
    return keys | {f"{key}.name" for key in keys}


def style_picture(style: Shape | np.ndarray | None) -> str | None:
    """A style that is a picture, as a data URI; None for a mesh."""
    if not isinstance(style, np.ndarray):
        return None
    from PIL import Image

    pixels = (style * 255).round().astype(np.uint8)
    return html.data_uri(Image.fromarray(pixels), STYLE_PIXELS, "JPEG")


def facts(run: Run, shown: Shown) -> list[tuple[str, str]]:
    """The key numbers of a run."""
    found = [("status", run.status)]
    if asked := [each for each in run.overrides if not each.lstrip("+~").startswith("hydra.")]:
        found.append(("asked for", " ".join(asked)))
    if run.config:
        found.append(("method", str(run.config.get("baseline.name") or "learned")))
    if run.seconds is not None:
        found.append(("time", html.duration(run.seconds)))
    if run.steps:
        pace = statistics.median(s.get("seconds", 0.0) for s in run.steps)
        found.append(("steps", f"{run.steps[-1]['step']}, {pace:.2g} s each"))
        if "loss" in run.summary:
            first = next(step["loss"] for step in run.steps if "loss" in step)
            found.append(("loss", f"{first:.3g} → {run.summary['loss']:.3g}"))
    if run.device:
        precision = run.record.get("encoder_precision")
        found.append(("device", run.device + (f", {precision}" if precision else "")))
    if shown.result is not None:
        rows, faces = len(shown.result.vertices), len(shown.result.faces)
        found.append(("mesh", f"{rows} vertices, {faces} faces"))
    if shown.displacement is not None:
        spread = float(np.sqrt((shown.displacement**2).mean())) / shown.radius
        found.append(("displacement (RMS)", f"{100 * spread:.2g} % of the radius"))
    return found


def panels(run: Run, shown: Shown) -> list[dict[str, str]]:
    """The meshes, the result first: key, title, and alternative text."""
    made = []
    source, style = run.part("source"), run.part("style")
    for key, title, alt in (
        ("result", "Result", f"The source {source} with the local geometry of {style}"),
        ("source", f"Source: {source}", f"The source mesh {source}, before stylisation"),
        ("style", f"Style: {style}", f"The style {style}"),
    ):
        if getattr(shown, key) is not None:
            made.append({"key": key, "title": title, "alt": alt})
    return made


def curves(run: Run) -> list[Any]:
    """Charts of the per-step measurements."""
    at = [step["step"] for step in run.steps]

    def line(key: str, label: str) -> tuple[str, list[float], list[float]]:
        return label, at, [step.get(key, float("nan")) for step in run.steps]

    return [
        charts.line_chart("Loss", "step", [line("loss", "total")]),
        charts.line_chart(
            "Style distance of the views",
            "step",
            [line("loss_global", "global views"), line("loss_local", "local views")],
        ),
        charts.line_chart(
            "RMS displacement, in radii of the source",
            "step",
            [line("rms_displacement", "displacement")],
        ),
    ]


def _heat(shown: Shown) -> dict[str, str] | None:
    """The heat map's legend."""
    if shown.displacement is None or shown.reach == 0:
        return None
    return {
        "gradient": glb.gradient(),
        "reach": f"{shown.reach:.3g}",
        "share": f"{100 * shown.reach / shown.radius:.2g}",
        "outermost": f"{shown.displacement.max():.3g}",
        "innermost": f"{shown.displacement.min():.3g}".replace("-", "−"),
    }


def _inputs(run: Run) -> list[dict[str, str]]:
    """Origin of source and style, with licence and author if known, and of plugins."""
    from styleexp.inputs import assets

    rows = []
    for kind, row in (run.record.get("assets") or {}).items():
        known = assets.ASSETS.get(row.get("name") or "")
        if row.get("sha256") is None:
            origin = "analytic shape of this version, or a plugin's"
        elif known is not None and row["sha256"].startswith(known.sha256):
            origin = f"{known.author}; {known.source}; {known.licence}"
        else:
            origin = "your file"
        rows.append(
            {
                "kind": kind,
                "name": str(run.config.get(f"{kind}.path") or row.get("name") or row.get("path")),
                "sha256": row.get("sha256") or "–",
                "origin": origin,
            }
        )
    for each in run.record.get("plugins") or ():
        package = " ".join(filter(None, [each.get("distribution"), each.get("version")]))
        rows.append(
            {
                "kind": f"{each.get('kind')}, a plugin",
                "name": str(each.get("name")),
                "sha256": each.get("sha256") or "–",
                "origin": ", ".join(
                    filter(None, [package, each.get("file") or each.get("origin")])
                ),
            }
        )
    return rows
