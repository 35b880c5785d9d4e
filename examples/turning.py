"""The README's picture: source and style, and the result turning.

python examples/turning.py RUN_FOLDER OUT.webp
"""

import sys
from pathlib import Path

from PIL import Image

from styleexp.experiments.reports import shown
from styleexp.experiments.reports.shown import Shape
from styleexp.runs import reading
from styleexp.runs.previews import render_views

FRAMES, SIZE = 36, 480


def turning(run: Path) -> list[Image.Image]:
    """One turn of the result; source and style, half as large, keep still beside it."""
    found = shown.read(reading.read(run))

    def views(shape: Shape, azimuths: list[float], size: int) -> list[Image.Image]:
        elevations = [18.0] * len(azimuths)
        pictures = render_views(shape.vertices, shape.faces, elevations, azimuths, size)
        return [Image.fromarray(each) for each in pictures]

    assert isinstance(found.source, Shape)
    assert isinstance(found.style, Shape)
    assert isinstance(found.result, Shape)
    still = [views(shape, [35.0], SIZE // 2)[0] for shape in (found.source, found.style)]
    frames = []
    for result in views(found.result, [35 + 360 * k / FRAMES for k in range(FRAMES)], SIZE):
        frame = Image.new("L", (SIZE * 3 // 2, SIZE), 255)
        for row, picture in enumerate(still):
            frame.paste(picture, (0, row * SIZE // 2))
        frame.paste(result, (SIZE // 2, 0))
        frames.append(frame)
    return frames


if __name__ == "__main__":
    first, *rest = turning(Path(sys.argv[1]))
    first.save(sys.argv[2], save_all=True, append_images=rest, duration=90, loop=0, quality=70)
