"""A run's page while it goes: ``report.html`` shows what the run is doing, its progress, source,
style and the mesh as it is now, and reloads itself, until the finished run's page replaces it.

A thread rewrites the page, so that it changes also during a long computation. Pictures are drawn
between two steps, as seldom as `SHARE` requires.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING

from styleexp.experiments.progress import print_paths
from styleexp.runs import reading
from styleexp.system import atomic, progress

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np

    from styleexp.method.base import Result, Step
    from styleexp.method.subject import Subject
    from styleexp.runs.reading import Run
    from styleexp.runs.records import RunFolder

FIRST = 1.5
"""Seconds until there is a page, and the terminal names it: most mistakes are found sooner."""
EVERY = 2.0
"""Seconds between two writings, in a run's first minutes."""
PACE = 0.01
"""And later: this share of the time that the run has taken."""
SHARE = 0.02
"""Largest share of the time for drawing between steps."""
SEVERAL = 4.0
"""Least seconds between two pictures."""
HEARTBEAT = 60.0
"""Seconds after which an unchanged page is written again, so that a reader sees that the run is
alive."""
PIXELS = 400
VIEWS = ((15.0, 35.0), (20.0, 215.0))
"""(elevation, azimuth) in degrees: front and back."""


class Live:
    """What the page shows, and the thread that writes it; nothing of it if it isn't ``wanted``."""

    def __init__(self, folder: RunFolder, wanted: bool) -> None:
        self._folder, self.wanted = folder, wanted
        self._begun = time.monotonic()
        self._started = time.time()
        self._pictures: dict[str, list[str]] = {}
        self._steps: list[tuple[int, float]] = []
        self._total = 0
        self._drawn, self._cost = 0.0, 0.0
        self._run: Run | None = None
        self._told, self._last = "", 0.0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._keep_writing, daemon=True)
        if wanted:
            self._thread.start()

    @property
    def path(self) -> Path:
        """The page's file."""
        from styleexp.experiments.reports.page import NAME

        return self._folder.path / NAME

    def prepared(self, subject: Subject) -> None:
        """Show the source and the style."""
        if not self.wanted:
            return
        from styleexp.experiments.reports.page import style_picture
        from styleexp.inputs import meshes

        style = subject.style
        self._draw("source", subject.frame.apply(subject.source.vertices), subject.source.faces)
        if style.mesh is not None:
            points = meshes.normalisation(style.mesh.vertices).apply(style.mesh.vertices)
            self._draw("style", points, style.mesh.faces)
        elif (picture := style_picture(style.picture)) is not None:
            self._pictures["style"] = [picture]

    def step(self, step: Step, total: int, result: Callable[[], Result]) -> None:
        """Note a step, and draw the mesh as it is now, if it is time to."""
        self._steps.append((step.step, step.loss))
        self._total = total
        now = time.monotonic()
        if self.wanted and now - self._drawn > max(SEVERAL, self._cost / SHARE):
            self.result(result())
            self._drawn = time.monotonic()
            self._cost = self._drawn - now

    def result(self, result: Result) -> None:
        """Show this result."""
        if self.wanted:
            self._draw("result", result.subject.frame.apply(result.vertices), result.faces)

    def replaced(self) -> None:
        """Stop writing: the finished run's own page takes this one's place."""
        self.wanted = False
        self._stop()

    def end(self) -> None:
        """Stop writing; say how the run ended, if it didn't finish."""
        self._stop()
        if self.wanted and self._folder.begun:
            self._run = None  # its status has changed
            with suppress(OSError):
                self._write(EVERY)

    def _stop(self) -> None:
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()

    def _draw(self, kind: str, vertices: np.ndarray, faces: np.ndarray) -> None:
        from PIL import Image

        from styleexp.experiments.reports import html
        from styleexp.runs import previews

        views = VIEWS if kind == "result" else VIEWS[:1]
        elevations, azimuths = map(list, zip(*views, strict=True))
        drawn = previews.render_views(vertices, faces, elevations, azimuths, PIXELS)
        self._pictures[kind] = [html.data_uri(Image.fromarray(each), PIXELS) for each in drawn]

    def _keep_writing(self) -> None:
        wait, told = FIRST, False
        while not self._ended.wait(wait):
            wait = max(EVERY, PACE * (time.monotonic() - self._begun))
            if self._folder.begun:
                with suppress(OSError):  # the run itself meets and tells it
                    self._write(wait)
                    if not told:
                        print("watch it on this page, which reloads itself:", flush=True)
                        print_paths([self.path])
                        told = True

    def _write(self, wait: float) -> None:
        from styleexp.experiments.reports import charts, html

        if self._run is None:
            self._run = reading.read(self._folder.path)
        steps = list(self._steps)
        text = html.render(
            "live.html",
            ["live.js"],
            run=self._run,
            goes=not self._ended.is_set(),
            stage=progress.stage(),
            step=steps[-1] if steps else None,
            total=self._total,
            started=round(self._started),
            wait=round(wait, 1),
            pictures={kind: self._pictures.get(kind) for kind in ("source", "style", "result")},
            curve=charts.line_chart(
                "Loss", "step", [("loss", [n for n, _ in steps], [loss for _, loss in steps])]
            ),
        )
        now = time.monotonic()
        if text != self._told or now - self._last > HEARTBEAT:
            self._told, self._last = text, now
            stamped = text.replace('data-written="0"', f'data-written="{time.time():.0f}"', 1)
            atomic.write(self.path, atomic.text(stamped))
