"""Draw the README's picture of the board: of each pair its style and two views of the result.

styleexp +experiment=board
python -m benchmarks.board_picture outputs/board/DATE docs/images/synthesis_board.png
"""

from __future__ import annotations

import sys
from pathlib import Path

from PIL import Image, ImageOps

from styleexp.experiments.reports import sheets
from styleexp.runs import finding, reading

SIDE, STYLE, COLUMNS = 165, 70, 4
"""Pixels of a view and of a style, and pairs in a row."""


def drawn(sheet: Image.Image, view: int) -> Image.Image:
    """A pair, from a rater's sheet of the result, whose views have ``view`` pixels."""
    band = sheet.height - 2 * view
    style = sheet.crop((view, band, 2 * view, band + view))
    strip = Image.new("L", (STYLE + 2 * SIDE, SIDE), 255)
    small = ImageOps.contain(style, (STYLE, STYLE), Image.Resampling.LANCZOS)
    strip.paste(small, (0, (SIDE - small.height) // 2))
    for row in range(2):
        at = sheet.crop((2 * view, band + row * view, 3 * view, band + (row + 1) * view))
        strip.paste(at.resize((SIDE, SIDE), Image.Resampling.LANCZOS), (STYLE + row * SIDE, 0))
    return strip


def main(folder: Path, out: Path) -> None:
    """Write the picture of the runs in a folder."""
    runs = [reading.read(at) for at in finding.folders(folder) if (at / "run.json").is_file()]
    runs.sort(key=lambda run: int(run.folder.name))
    pairs = [drawn(sheets.drawn(sheets.Sheet(run, run, "result")), sheets.SIZE) for run in runs]
    rows = -(-len(pairs) // COLUMNS)
    picture = Image.new("L", (COLUMNS * pairs[0].width, rows * SIDE), 255)
    for number, pair in enumerate(pairs):
        place = divmod(number, COLUMNS)
        picture.paste(pair, (place[1] * pair.width, place[0] * SIDE))
    picture.quantize(64).save(out, optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
