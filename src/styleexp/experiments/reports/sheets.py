"""Neutral pictures for raters, without names or numbers: source, style and result side by side.

A rater, a person or a program, sees nothing but these. Among the results are catch trials, whose
answer is known: the source itself, and a result next to another style. `study_results` reads the
ratings.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from styleexp.experiments.reports import shown as shows
from styleexp.experiments.reports.study import CRAFT, HIGHEST, LOWEST, QUESTION
from styleexp.runs import finding
from styleexp.runs.previews import render_views
from styleexp.runs.records import RunFolder
from styleexp.system.errors import UserError
from styleexp.system.progress import doing

if TYPE_CHECKING:
    from styleexp.experiments.reports.shown import Shape, Shown
    from styleexp.runs.reading import Run

SCHEMA = "styleexp-sheets-1"
VIEWS = ((15.0, 35.0), (20.0, 215.0))
"""(elevation, azimuth) in degrees: from the front left, and from behind on the right."""
QUARTER = 90.0
"""Turn of the views of a result beside another style, in degrees, so that it isn't recognised from
its own sheet."""
SIZE = 480
"""Side of each view, in pixels."""
RESULTS_PER_CATCH = 12
"""Results for each catch trial of either kind."""
KEY, TEMPLATE, QUESTIONS = "key.json", "ratings.csv", "questions.txt"

Trial: TypeAlias = Literal["result", "source", "other style"]


@dataclass(frozen=True)
class Sheet:
    """One picture to be rated: a run's result, and the run whose style is shown beside it."""

    run: Run
    style: Run
    trial: Trial = "result"


def write(folder: Path, out: Path, seed: int = 0) -> Path:
    """Write a picture of every finished run below ``folder``, and catch trials, in random order.

    ``out/sheets`` is what raters get: the numbered pictures, and the questions. ``out/key.json``
    says what each shows, ``out/ratings.csv`` is an empty table to fill in. Returns the key's path.
    Raises `UserError` if ``out`` already has sheets, or a run can't be shown completely.
    """
    runs = [run for run in finding.find(folder) if run.status == "done"]
    if not runs:
        raise UserError(f"there is no finished run below '{folder}' to be rated.")
    if (out / KEY).exists() or (out / "sheets").exists():
        raise UserError(
            f"'{out}' already has sheets, whose ratings would be lost: give a new folder."
        )
    sheets = ordered(runs, np.random.default_rng(seed))
    below = out / "sheets"
    below.mkdir(parents=True)
    key: dict[str, Any] = {}
    for number, sheet in enumerate(sheets, start=1):
        doing(f"drawing sheet {number} of {len(sheets)}")
        name = f"{number:03d}"
        drawn(sheet).save(below / f"{name}.png")
        run = sheet.run.folder.relative_to(folder).as_posix()
        label = f"{sheet.run.part('source')}-{sheet.style.part('style')}"
        key[name] = {"run": run, "label": label, "trial": sheet.trial}
    (below / QUESTIONS).write_text(questions(len(sheets)), encoding="utf-8")
    rows = ["rater,who,sheet,match,craft", *(f",,{name},," for name in key)]
    (out / TEMPLATE).write_text("\n".join(rows) + "\n", encoding="utf-8")
    identity = hashlib.sha256(repr(sorted(key.items())).encode()).hexdigest()[:12]
    content = {"schema": SCHEMA, "study": identity, "seed": seed, "sheets": key}
    RunFolder(out).write_json(KEY, content)
    return out / KEY


def ordered(runs: list[Run], rng: np.random.Generator) -> list[Sheet]:
    """A sheet for each run and the catch trials, in random order.

    A catch trial with another style shows a run of the same source if there is one, else any other
    run, beside a style that isn't its own.
    """
    sheets = [Sheet(run, run) for run in runs]
    catches = -(-len(runs) // RESULTS_PER_CATCH)
    for at in rng.choice(len(runs), min(catches, len(runs)), replace=False):
        sheets.append(Sheet(runs[at], runs[at], "source"))
    for at in rng.permutation(len(runs))[:catches]:
        run = runs[at]
        others = [other for other in runs if other.part("style") != run.part("style")]
        same = [other for other in others if other.part("source") == run.part("source")]
        if candidates := same or others:
            style = candidates[int(rng.integers(len(candidates)))]
            sheets.append(Sheet(run, style, "other style"))
    return [sheets[at] for at in rng.permutation(len(sheets))]


def drawn(sheet: Sheet) -> Image.Image:
    """Three columns (source, style, result) of two views each; a picture style is shown once."""
    own, beside = _read(sheet.run), _read(sheet.style)
    assert own.source is not None
    assert own.result is not None
    result = own.source if sheet.trial == "source" else own.result
    turn = QUARTER if sheet.trial == "other style" else 0.0
    frame = np.concatenate([own.source.vertices, own.result.vertices])
    columns = [
        ("source", _views(own.source, frame, turn)),
        ("style", _style(beside.style)),
        ("result", _views(result, frame, turn)),
    ]
    band = 30
    picture = Image.new("L", (len(columns) * SIZE, band + len(VIEWS) * SIZE), 255)
    draw = ImageDraw.Draw(picture)
    font = ImageFont.load_default(size=20)
    for column, (label, images) in enumerate(columns):
        draw.text((column * SIZE + 8, 4), label, fill=20, font=font)
        for row, image in enumerate(images):
            left = column * SIZE + (SIZE - image.width) // 2
            picture.paste(image, (left, band + row * SIZE + (SIZE - image.height) // 2))
    return picture


def questions(count: int) -> str:
    """What raters are asked, in words."""
    return f"""\
There are {count} pictures, 001.png to {count:03d}.png. Each has three columns: a source, a style (a
mesh, or a picture), and a result, which is meant to be the source's shape with the style's surface
pattern on it. The upper and the lower row are two views, from the front and from behind.

Rate each picture by itself, with two whole numbers from 1 to 5:

match   {QUESTION}
        1 = {LOWEST}, 5 = {HIGHEST}
craft   {CRAFT}
        1 = badly damaged, 5 = flawless

Write a table with the columns rater,who,sheet,match,craft, a row for each picture: rater is a name
of your choice, who is "person" or what kind of program you are, sheet is the picture's number,
such as 001.
"""


def _read(run: Run) -> Shown:
    shown = shows.read(run)
    if shown.missing:
        raise UserError(
            f"the run '{run.folder}' can't be rated: {shown.missing[0]} Repair it, or give a "
            "folder without it."
        )
    return shown


def _views(shape: Shape, frame: np.ndarray, turn: float = 0.0) -> list[Image.Image]:
    elevations = [elevation for elevation, _ in VIEWS]
    azimuths = [azimuth + turn for _, azimuth in VIEWS]
    pictures = render_views(shape.vertices, shape.faces, elevations, azimuths, SIZE, frame=frame)
    return [Image.fromarray(picture) for picture in pictures]


def _style(style: Shape | np.ndarray | None) -> list[Image.Image]:
    if isinstance(style, np.ndarray):
        picture = Image.fromarray((style * 255).round().astype(np.uint8)).convert("L")
        picture.thumbnail((SIZE - 20, SIZE - 20))
        return [picture]
    assert style is not None
    return _views(style, style.vertices)
