"""A sweep's contact sheet, laid out like the paper's figures: source, style, settings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from styleexp.experiments.sweeps.settings import setting, varying
from styleexp.runs import reading
from styleexp.runs.jobs import Job
from styleexp.runs.reading import Run
from styleexp.runs.records import RunFolder

if TYPE_CHECKING:
    from PIL import Image

    from styleexp.config.schema import Config

COLUMNS = 6
"""Maximum number of pictures per line, for many settings."""
PAIRS = 2
"""Source-style pairs per line, if each has one result."""
MOST = 240
"""Maximum number of jobs per sheet; with 512-pixel pictures, larger sheets don't open in a
browser."""


@dataclass(frozen=True)
class Shown:
    """A job's properties that the layout depends on."""

    source: str
    style: str
    setting: str


@dataclass(frozen=True)
class Cell:
    """One picture of the sheet."""

    kind: str
    """``source``, ``style`` or ``result``."""
    job: int
    caption: str


Line = list[Cell | None]


def layout(shown: Sequence[Shown]) -> list[Line]:
    """Lay out the sheet's lines.

    Varying settings: source, style, and one column per setting (Figs. 7, 8). All pairs of some
    sources and styles: a grid with styles on top and sources on the left (Figs. 2, 3). Other pairs:
    source, style, result (Fig. 9).
    """
    pairs: dict[tuple[str, str], list[int]] = {}
    for index, each in enumerate(shown):
        pairs.setdefault((each.source, each.style), []).append(index)
    sources = list(dict.fromkeys(each.source for each in shown))
    styles = list(dict.fromkeys(each.style for each in shown))
    if any(each.setting for each in shown) or len(pairs) < len(shown):
        return [line for jobs in pairs.values() for line in _settings(shown, jobs)]
    if len(shown) > 1 and len(pairs) == len(sources) * len(styles):
        return _grid(shown, pairs, sources, styles)
    cells = [
        cell
        for jobs in pairs.values()
        for cell in (*_given(shown, jobs[0]), *_results(shown, jobs))
    ]
    return [list(cells[at : at + 3 * PAIRS]) for at in range(0, len(cells), 3 * PAIRS)]


def _settings(shown: Sequence[Shown], jobs: Sequence[int]) -> list[Line]:
    results, width = _results(shown, jobs), COLUMNS - 2
    lines: list[Line] = []
    for at in range(0, len(results), width):
        before: Line = [None, None] if at else _given(shown, jobs[0])
        lines.append([*before, *results[at : at + width]])
    return lines


def _grid(
    shown: Sequence[Shown],
    pairs: dict[tuple[str, str], list[int]],
    sources: Sequence[str],
    styles: Sequence[str],
) -> list[Line]:
    first: Line = [None]
    first += [Cell("style", pairs[sources[0], style][0], style) for style in styles]
    lines = [first]
    for source in sources:
        jobs = [pairs[source, style][0] for style in styles]
        line: Line = [Cell("source", jobs[0], source)]
        lines.append(
            [*line, *(Cell("result", job, f"{source}, {shown[job].style}") for job in jobs)]
        )
    return lines


def _given(shown: Sequence[Shown], job: int) -> Line:
    return [
        Cell("source", job, f"source: {shown[job].source}"),
        Cell("style", job, f"style: {shown[job].style}"),
    ]


def _results(shown: Sequence[Shown], jobs: Sequence[int]) -> list[Cell]:
    return [Cell("result", job, shown[job].setting or "result") for job in jobs]


# ------------------------------------------------------------------------------------ pictures


def write_figure(jobs: Sequence[Job], folder: RunFolder) -> None:
    """Draw ``figure.png`` of the first `MOST` jobs; a job without a result shows its status
    instead."""
    settings = varying([job.overrides for job in jobs])
    runs = [reading.of_job(job) for job in jobs[:MOST]]
    configs = [_config(job, run) for job, run in zip(jobs[:MOST], runs, strict=True)]
    shown = [
        Shown(_name(config.source), _name(config.style), setting(overrides))
        for config, overrides in zip(configs, settings[:MOST], strict=True)
    ]
    if not jobs:
        return
    size = max(config.preview.resolution for config in configs)
    drawn: dict[Any, Image.Image | str] = {}

    def picture(cell: Cell) -> Image.Image | str:
        config, run = configs[cell.job], runs[cell.job]
        key: tuple[Any, ...] = (cell.kind, cell.job)
        if cell.kind != "result":
            asset = repr((run.record.get("assets") or {}).get(cell.kind))
            key = (cell.kind, repr(getattr(config, cell.kind)), asset)
        if key not in drawn:
            drawn[key] = _picture(cell.kind, config, run, size)
        return drawn[key]

    lines = [
        [(cell.caption, picture(cell)) if cell else None for cell in line] for line in layout(shown)
    ]
    folder.write("figure.png", lambda path: _sheet(lines, size).save(path))


def _config(job: Job, run: Run) -> Config:
    """A job's configuration, from its run's record or, if it never started, from its overrides."""
    from styleexp.config import compose

    if run.config:
        return compose.recorded(run.record["config"])
    return compose.compose([*job.overrides, "hydra.mode=RUN"])


def _name(part: Any) -> str:
    name = Path(part.path).stem if part.path else str(part.name)
    return name if getattr(part, "scale", 1.0) == 1.0 else f"{name}, scale {part.scale:g}"


def _picture(kind: str, config: Config, run: Run, size: int) -> Image.Image | str:
    """A picture no larger than ``size``, or a text if there is none."""
    import copy

    import numpy as np
    from PIL import Image

    from styleexp.config import sources
    from styleexp.inputs import meshes
    from styleexp.runs import origins, results
    from styleexp.system.errors import UserError

    try:
        if kind != "result":
            part = copy.copy(getattr(config, kind))
            if run.record.get("assets"):
                path = origins.find(run.record, config, kind, run.folder)
                part.path = str(path or "") or part.path
            content: Any = None
            if kind == "source":
                content = sources.load_source(part)
            else:
                style = sources.load_style(part)
                content = style.picture if style.mesh is None else style.mesh
        else:
            if run.status != "done":
                return "another run" if run.status == "other" else run.status
            content = meshes.load_mesh(run.folder / results.NAME)
    except UserError as error:
        return "not found" if kind != "result" else str(error).split(":")[0]
    if isinstance(content, meshes.Mesh):
        return _view(content, size)
    picture = Image.fromarray((content * 255).round().astype(np.uint8)).convert("L")
    picture.thumbnail((size, size))
    return picture


def _view(mesh: Any, size: int) -> Image.Image:
    from PIL import Image

    from styleexp.inputs import meshes
    from styleexp.runs import previews

    _, elevation, azimuth = previews.VIEWS[0]
    vertices = meshes.normalisation(mesh.vertices).apply(mesh.vertices)
    view = previews.render_views(vertices, mesh.faces, [elevation], [azimuth], size)
    return Image.fromarray(view[0])


def _sheet(lines: list[list[tuple[str, Image.Image | str] | None]], size: int) -> Image.Image:
    """Captioned pictures in lines; captions longer than their picture are truncated."""
    from PIL import Image, ImageDraw, ImageFont

    band = max(16, size // 12)
    font = ImageFont.load_default(size=band * 0.62)
    columns = max(len(line) for line in lines)
    sheet = Image.new("L", (columns * size, len(lines) * (size + band)), 255)
    draw = ImageDraw.Draw(sheet)
    for row, line in enumerate(lines):
        top = row * (size + band)
        for column, cell in enumerate(line):
            if cell is None:
                continue
            caption, picture = cell
            left = column * size
            while len(caption) > 1 and draw.textlength(caption, font) > size - band * 0.4:
                caption = caption.rstrip("…")[:-1] + "…"
            draw.text((left + size / 2, top + band / 2), caption, fill=20, font=font, anchor="mm")
            if isinstance(picture, str):
                centre = (left + size / 2, top + band + size / 2)
                draw.text(centre, picture, fill=90, font=font, anchor="mm")
            else:
                corner = (left + (size - picture.width) // 2, top + band)
                sheet.paste(picture, (corner[0], corner[1] + (size - picture.height) // 2))
    return sheet
