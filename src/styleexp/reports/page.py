"""The page of one run, ``report.html``: one file, without a network."""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from styleexp.reports import charts, folders, glb, html
from styleexp.reports import shown as shows

if TYPE_CHECKING:
    from styleexp.reports.folders import Run
    from styleexp.reports.shown import Shown
    from styleexp.stylize import Result

NAME = "report.html"
STYLE_PIXELS = 720
"""A style picture's longer side on the page."""
STILL_PIXELS = 1280
MEANINGS = {
    "style_distance": "to the style, by an encoder that was not trained with; 0 the style, 1 none",
    "relief_distance": "to the style's relief or a picture's brightness, no network; 0 is equal",
    "relief_rms": "root mean square height of the relief, in radii of the source",
    "relief_share": "that height over the style mesh's own",
    "silhouette_iou": "overlap of the silhouettes with the source's; 1 is equal",
    "chamfer": "mean distance to the source's surface, over its diagonal",
    "hausdorff": "largest distance to the source's surface, over its diagonal",
    "volume_change": "of the source's volume",
    "flipped_faces": "share of the faces that point the other way now",
    "self_intersections": "share of the faces that cut another one",
    "spike": "farthest displacements over the root mean square; large where few stick out",
}
"""What the metrics of `styleexp.metrics` mean, in short."""
FILES = (
    ("result.glb", "the result, for viewers and engines"),
    ("result.ply", "with the displacement as a vertex attribute"),
    ("result.obj", "in the input's own rows"),
    ("preview.png", "four views of source, style and result"),
    ("turntable.gif", "the result turning"),
    ("run.json", "everything that went in"),
    ("metrics.jsonl", "a line a step"),
    ("metrics.json", "what was measured on the result"),
    ("check.png", "the result as pyrender draws it"),
)


def write(run: Run, shown: Shown) -> Path:
    """Write a run's page into its folder; returns its path."""
    return html.save(run.folder / NAME, build(run, shown))


def write_ended(folder: Path, result: Result, seconds: float) -> Path:
    """The page of a run whose last step is done and whose status is about to say so."""
    run = folders.read(folder)
    status = {"status": "done", "seconds": round(seconds, 1)}
    return write(dataclasses.replace(run, status=status), shows.of(result))


def rewrite(folder: Path, tell: Callable[[str], Any] | None = None) -> Path:
    """The page of a run, finished or not, from what its folder holds; ``tell`` takes a sentence for
    each thing that could not be shown."""
    run = folders.readable(folder, "show")
    shown = shows.read(run)
    if tell is not None:
        for told in shown.missing:
            tell(told)
    return write(run, shown)


def build(run: Run, shown: Shown) -> str:
    """The page's text."""
    style_picture = None
    if isinstance(shown.style, np.ndarray):
        from PIL import Image

        pixels = (shown.style * 255).round().astype(np.uint8)
        style_picture = html.data_uri(Image.fromarray(pixels), STYLE_PIXELS, "JPEG")
    return html.render(
        "run.html",
        ["viewers.js", "run.js"],
        run=run,
        facts=facts(run, shown),
        panels=panels(run, shown),
        blocks={f"glb-{k}": html.packed(content) for k, content in shown.files().items()},
        viewer=html.viewer(),
        style_picture=style_picture,
        heat=_heat(shown),
        curves=curves(run),
        warnings=[*run.record.get("notes", ()), *run.problems, *shown.missing],
        assets=_assets(run),
        still=html.picture(run.folder / "preview.png", STILL_PIXELS),
        meanings=MEANINGS,
        files=[(name, what) for name, what in FILES if (run.folder / name).is_file()],
        overridden={override.lstrip("+~").split("=")[0] for override in run.overrides},
        plain=html.plain,
    )


def facts(run: Run, shown: Shown) -> list[tuple[str, str]]:
    """The few numbers that a reader wants first."""
    found = [("status", run.state)]
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
    if run.record.get("device"):
        precision = run.record.get("encoder_precision")
        found.append(("device", run.record["device"] + (f", {precision}" if precision else "")))
    if shown.result is not None:
        rows, faces = len(shown.result.vertices), len(shown.result.faces)
        found.append(("mesh", f"{rows} vertices, {faces} faces"))
    if shown.displacement is not None:
        spread = float(np.sqrt((shown.displacement**2).mean())) / shown.radius
        found.append(("displacement (RMS)", f"{100 * spread:.2g} % of the radius"))
    return found


def panels(run: Run, shown: Shown) -> list[dict[str, str]]:
    """The meshes side by side: key, title, and what a reader who can't see them should know."""
    made = []
    source, style = run.part("source"), run.part("style")
    for key, title, alt in (
        ("source", f"Source: {source}", f"The source mesh {source}, before stylisation"),
        ("style", f"Style: {style}", f"The style {style}"),
        ("result", "Result", f"The source {source} with the local geometry of {style}"),
    ):
        if getattr(shown, key) is not None:
            made.append({"key": key, "title": title, "alt": alt})
    return made


def curves(run: Run) -> list[Any]:
    """Charts of what was measured in each step."""
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
    stops = (glb.diverging(np.linspace(-1, 1, 9)) * 255).round().astype(int).tolist()
    return {
        "gradient": ", ".join(f"rgb({r} {g} {b})" for r, g, b in stops),
        "reach": f"{shown.reach:.3g}",
        "share": f"{100 * shown.reach / shown.radius:.2g}",
        "outermost": f"{shown.displacement.max():.3g}",
        "innermost": f"{shown.displacement.min():.3g}".replace("-", "−"),
    }


def _assets(run: Run) -> list[dict[str, str]]:
    """Where source and style came from, with licence and author where they are known."""
    from styleexp import assets

    rows = []
    for kind, row in (run.record.get("assets") or {}).items():
        known = assets.ASSETS.get(row.get("name") or "")
        if row.get("sha256") is None:
            origin = "analytic shape of this version, or a plugin's"
        elif known is not None and row["sha256"].startswith(known.sha256):
            origin = f"{known.author}; {known.source}; {known.licence}"
        else:
            origin = "a file of yours"
        rows.append(
            {
                "kind": kind,
                "name": str(run.config.get(f"{kind}.path") or row.get("name") or row.get("path")),
                "sha256": row.get("sha256") or "–",
                "origin": origin,
            }
        )
    return rows
