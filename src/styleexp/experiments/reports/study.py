"""The user study's page (Sec. 4.4): every pair is shown on a turntable and rated from 1 to 5.

It is a single file without a server: answers stay in the participant's browser until saved to a
file, which `styleexp.experiments.reports.study_results` reads.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from styleexp.experiments.reports import html
from styleexp.experiments.reports import shown as shows
from styleexp.experiments.reports.page import STYLE_PIXELS
from styleexp.runs import finding
from styleexp.runs.reading import Run
from styleexp.system.errors import UserError

NAME = "study.html"
SCHEMA = "styleexp-study-1"
QUESTION = "How well does the result match the target style?"
"""Based on the paper: "rate how well the style transfer results matched the target style"."""
CRAFT = "How clean is it: no mush, no torn or broken parts, the source's shape kept?"
"""The second question, of sheets alone; not in the paper."""
LOWEST, HIGHEST = "not a match", "perfect"
"""Labels of ratings 1 and 5, from the paper."""


def write(folder: Path, seed: int = 0, title: str = "Rating of stylised meshes") -> Path:
    """Write ``study.html`` with every finished run below ``folder``; return its path.

    ``seed`` affects the order in which each participant sees the pairs. Raises `UserError` if there
    is no pair, or if one of them can't be shown completely, since participants couldn't judge it.
    """
    runs = [run for run in finding.find(folder) if run.status == "done"]
    if not runs:
        raise UserError(f"there is no finished run below '{folder}' to be rated.")
    blocks: dict[str, str] = {}
    pairs = [_pair(run, folder, blocks) for run in runs]
    study = {
        "schema": SCHEMA,
        "study": _identity([(pair["id"], pair["result"]["block"]) for pair in pairs]),
        "title": title,
        "seed": seed,
        "pairs": _distinct(pairs),
    }
    text = html.render(
        "study.html",
        ["viewers.js", "study.js"],
        study=study,
        question=QUESTION,
        lowest=LOWEST,
        highest=HIGHEST,
        blocks=blocks,
        viewer=html.viewer(),
    )
    return html.save(folder / NAME, text)


def _pair(run: Run, folder: Path, blocks: dict[str, str]) -> dict[str, Any]:
    """A pair's names and the keys of its data blocks, which are added to ``blocks`` once."""
    shown = shows.read(run)
    if shown.missing:
        raise UserError(
            f"the run '{run.folder}' can't be rated: {shown.missing[0]} Repair it, or give a "
            "folder without it."
        )
    below = run.folder.relative_to(folder).as_posix()
    pair: dict[str, Any] = {"id": below, "label": f"{run.part('source')}-{run.part('style')}"}
    for kind, content in shown.files(bare=True).items():
        pair[kind] = {"block": _identity(content)}
        blocks.setdefault(f"glb-{pair[kind]['block']}", html.packed(content))
    if isinstance(shown.style, np.ndarray):
        from PIL import Image

        pixels = Image.fromarray((shown.style * 255).round().astype(np.uint8))
        pair["style"] = {"picture": html.data_uri(pixels, STYLE_PIXELS, "JPEG")}
    return pair


def _distinct(pairs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Add folder names to pairs with the same source and style."""
    labels = [pair["label"] for pair in pairs]
    return [
        pair | {"label": f"{pair['label']} ({pair['id']})"}
        if labels.count(pair["label"]) > 1
        else pair
        for pair in pairs
    ]


def _identity(content: object) -> str:
    raw = content if isinstance(content, bytes) else repr(content).encode()
    return hashlib.sha256(raw).hexdigest()[:12]
