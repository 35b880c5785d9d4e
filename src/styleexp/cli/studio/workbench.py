"""What is on the bench: a source, a style, and the result that a thread makes of them.

The thread always works on the newest settings. It gives up what newer ones make useless between
two rounds of the synthesis, and shows what it has on the way: first a draft on fewer vertices from
a small bank of patches, then the whole synthesis, as the command would make it. A change of the
strength or the mask alone needs no synthesis.
"""

from __future__ import annotations

import io
import threading
import time
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from styleexp.api import configured
from styleexp.cli.studio.kept import Kept
from styleexp.cli.studio.settings import Settings, safe_name
from styleexp.config import build, sources
from styleexp.experiments.reports import glb
from styleexp.inputs import meshes
from styleexp.inputs.style import Style
from styleexp.method.base import Result, Scene
from styleexp.method.synthesis import method as synthesis
from styleexp.system import atomic, process, progress
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from styleexp.method.subject import Subject

DRAFT = ("baseline.bank=1500", "source.refine=24000")
"""A first look in a fraction of the time: few patches to choose from, about 12,000 vertices."""
NEWS = 1.0
"""Seconds after which the state of something that is being made is told, at most."""
OFTEN = 1.5
"""Seconds between two looks at the same synthesis or learning, at least."""
FORMATS = ("glb", "obj", "ply", "stl", "3mf", "maps")
LARGEST = 256 << 20
"""Bytes that a file given to the page may have."""


class _Superseded(Exception):
    """Newer settings make the present work useless."""


@dataclass(frozen=True)
class Look:
    """A mesh to show: ``version`` changes whenever it does."""

    version: int
    content: bytes


@dataclass(frozen=True)
class Made:
    """The newest result, and what it was made by."""

    result: Result
    settings: Settings
    finished: bool
    """Whether it is what the command makes, not a draft."""
    learned: int = 0
    """Steps of learning that it has had."""


class Workbench:
    """A source, a style, settings, and a thread that makes the result. All methods may be called
    from any thread."""

    def __init__(self, settings: Settings, folder: Path):
        self.folder = folder
        """Everything that the studio writes is below it."""
        self._lock = threading.Condition()
        self._settings = settings
        self._serial = 0
        self._version = 0
        self._looks: dict[str, Look] = {}
        self._facts: dict[str, Any] = {}
        self._stage, self._error = "starting", ""
        self._notes: list[str] = []
        self._made: Made | None = None
        self._learn, self._stop, self._closed = False, False, False
        self._kept = Kept()
        self._inputs: tuple[meshes.Mesh | None, Style | None] = (None, None)
        self._thread = threading.Thread(target=self._work, daemon=True, name="workbench")

    def start(self) -> None:
        """Begin to work."""
        self._thread.start()

    # ------------------------------------------------------------------------------- for the page

    @property
    def settings(self) -> Settings:
        """The newest settings."""
        return self._settings

    def change(self, given: dict[str, Any]) -> None:
        """Take new settings; the result follows. Raises `UserError` for unfit ones."""
        with self._lock:
            if given.get("source", self._settings.source) != self._settings.source:
                given = {"mask": self._settings.mask_without_strokes, **given}
            self._settings = self._settings.changed(given)
            self._serial += 1
            self._learn, self._stop = False, True
            self._tell("waiting")

    def learn(self) -> None:
        """Go on from the synthesis by learning, as soon as it is finished."""
        with self._lock:
            self._learn, self._stop = True, False
            self._serial += 1
            self._tell("waiting")

    def stop(self) -> None:
        """End the learning; its result stays."""
        with self._lock:
            self._learn, self._stop = False, True
            self._lock.notify_all()

    def close(self) -> None:
        """Answer everyone who waits."""
        with self._lock:
            self._closed = True
            self._lock.notify_all()

    def state(self, since: int, wait: float) -> dict[str, Any]:
        """Everything that the page shows, once it differs from the version ``since``, or after
        ``wait`` seconds."""
        with self._lock:
            busy = self._stage not in ("done", "failed")
            self._lock.wait_for(
                lambda: self._version != since or self._closed, NEWS if busy else wait
            )
            made = self._made
            return {
                "version": self._version,
                "settings": self._settings.__dict__,
                "stage": self._stage,
                "detail": progress.stage() if busy else "",
                "error": self._error,
                "notes": self._notes,
                "looks": {name: look.version for name, look in self._looks.items()},
                "finished": made is not None and made.finished and made.settings == self._settings,
                "learned": made.learned if made is not None else 0,
                "command": self._settings.command(made is not None and made.learned > 0),
                **self._facts,
            }

    def look(self, name: str) -> Look | None:
        """A mesh (GLB) or picture (PNG): ``source``, ``style`` or ``result``."""
        return self._looks.get(name)

    def receive(self, kind: str, name: str, content: bytes) -> None:
        """Take a file that was dropped on the page: a mesh or picture becomes the source or style;
        others (materials, textures, buffers) lie beside the mesh, which is dropped last."""
        if kind not in ("source", "style", "beside"):
            raise UserError(f"there is no place '{kind}'.")
        if len(content) > LARGEST:
            raise UserError(too_large(f"'{name}'"))
        path = self.folder / "files" / safe_name(name)
        if kind != "beside" and path.suffix.lower() not in sources.SUFFIXES:
            raise UserError(
                f"'{path.name}' can't be read: drop a mesh (OBJ, PLY, STL, OFF, GLB, glTF) or, as "
                "the style, a picture."
            )
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        if kind != "beside":
            self._kept.clear()
            with self._lock:
                self._made = None  # it may be of another file of this name
            self.change({kind: str(path)})

    def save(self, formats: list[str], size: int = 2048) -> list[Path]:
        """Write the finished result; return the files. Raises `UserError` if there is none yet."""
        with self._lock:
            made = self._made
        if made is None or not made.finished or made.settings != self._settings:
            raise UserError("the result isn't finished yet: wait for it, then save.")
        if unknown := set(formats) - set(FORMATS):
            raise UserError(f"'{unknown.pop()}' is none of {', '.join(FORMATS)}.")
        stem = "-".join(Path(part).stem for part in (made.settings.source, made.settings.style))
        low = maps = None
        if "maps" in formats:  # before anything is written: it may be impossible
            from styleexp.runs import bake

            result = made.result
            detail = meshes.from_arrays(result.vertices, result.faces)
            low, maps, notes = bake.baked(self._kept.source(made.settings)[0], detail, size)
            with self._lock:
                self._notes = [*self._notes, *notes, *bake.warnings(low.mesh, maps)]
                self._tell()
        target = _fresh(self.folder / stem)
        written = []
        if low is not None and maps is not None:
            target.mkdir(parents=True)
            told = bake.write(maps, target, "png")
            written += [target / part["file"] for part in told.values() if isinstance(part, dict)]
            written.append(target / f"{stem}_low.glb")
            atomic.write(written[-1], atomic.data(bake.glb(low, maps)))
        for kind in (each for each in formats if each != "maps"):
            made.result.save(target / f"{stem}.{kind}")
            written.append(target / f"{stem}.{kind}")
        command = made.settings.command(made.learned > 0)
        (target / "command.txt").write_text(command + "\n", encoding="utf-8")
        return [*written, target / "command.txt"]

    # -------------------------------------------------------------------------------- the thread

    def _tell(self, stage: str | None = None, **facts: Any) -> None:
        """Change what the page sees; the lock is held."""
        if stage is not None:
            self._stage = stage
        self._facts |= facts
        self._version += 1
        self._lock.notify_all()

    def _work(self) -> None:
        serial = -1
        while True:
            with self._lock:
                while self._serial == serial:
                    self._lock.wait()
                serial, settings, learns = self._serial, self._settings, self._learn
                self._stop, self._error, self._notes = False, "", []
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    self._make(settings, serial, learns)
            except _Superseded:
                continue
            except UserError as error:
                self._failed(serial, str(error))
            except Exception as error:  # the page must outlive it
                traceback.print_exc()
                self._failed(serial, f"{type(error).__name__}: {error}")

    def _failed(self, serial: int, message: str) -> None:
        with self._lock:
            if serial == self._serial:
                self._error = message
                self._tell("failed")

    def _check(self, serial: int) -> None:
        if serial != self._serial:
            raise _Superseded

    def _make(self, settings: Settings, serial: int, learns: bool) -> None:
        """Everything that the newest settings ask for."""
        known = self._kept.heights_for(settings, ())
        own = {each.partition("=")[0] for each in settings.more}
        draft = tuple(each for each in DRAFT if each.partition("=")[0] not in own)
        passes: list[tuple[str, ...]] = [draft, ()] if draft and known is None else [()]
        if not learns or self._made is None or self._made.settings != settings:
            for more in passes:
                self._synthesise(settings, serial, more)
        if learns:
            self._learn_from(settings, serial)
        with self._lock:
            self._check(serial)
            self._tell("done")

    def _synthesise(self, settings: Settings, serial: int, more: tuple[str, ...]) -> None:
        draft = bool(more)
        name = "a draft" if draft else "the relief"
        with (
            self._at(serial, f"preparing {name}"),
            self._kept.given(settings, more) as (config, load),
        ):
            method = build.method_of(config(more))
            assert isinstance(method, synthesis.Synthesis)
            subject = self._kept.subject(settings, more, config, load)
            self._show_inputs(serial, subject, settings)
            if subject.smooth:
                self._show(serial, method.finish(Scene(subject), None), settings, not draft)
                return
            begun = self._kept.begun(settings, more, subject)
            height, last = self._kept.heights_for(settings, more), 0.0
            if height is None:
                ahead = synthesis.directions(subject, begun)
                rounds = synthesis.heights(subject, begun, ahead, method.config)
                for height in rounds:
                    self._check(serial)
                    if time.monotonic() - last > OFTEN:
                        result = method.laid(subject, begun, height)
                        self._show(serial, result, settings, False)
                        last = time.monotonic()
                    with self._lock:
                        self._tell(f"synthesising {name}")
                assert height is not None
                self._kept.keep_heights(settings, more, height)
            self._check(serial)
            self._show(serial, method.laid(subject, begun, height), settings, not draft)

    def _learn_from(self, settings: Settings, serial: int) -> None:
        """Steps of the learned method on top, until they are done or the user stops them."""
        with self._at(serial, "preparing for learning"), self._kept.given(settings):
            config, _ = configured(settings.source, settings.style, settings.learning)
            method, scene = build.prepare(config)
            state = method.start(scene)
            assert state is not None
            last = time.monotonic()
            for step in method.optimise(scene, state):
                self._check(serial)
                ends = self._stop or step.step == settings.steps
                if ends or time.monotonic() - last > OFTEN:
                    result = method.finish(scene, state)
                    self._show(serial, result, settings, ends, step.step)
                    last = time.monotonic()
                with self._lock:
                    self._tell(f"learning, step {step.step} of {settings.steps}", loss=step.loss)
                if ends:
                    return

    @contextmanager
    def _at(self, serial: int, stage: str) -> Iterator[None]:
        self._check(serial)
        progress.doing("")
        with self._lock:
            self._tell(stage)
        with process.undisturbed(0, self._settings.seed):
            yield

    def _show_inputs(self, serial: int, subject: Subject, settings: Settings) -> None:
        """Source and style as they are, once for each."""
        self._check(serial)
        mesh, read = self._kept.source(settings)
        style = subject.style
        facts: dict[str, Any] = {
            "source": {
                "name": Path(settings.source).name,
                "vertices": len(mesh.vertices),
                "faces": len(mesh.faces),
                "uv": mesh.carrier is not None and mesh.carrier.uv is not None,
                "attributes": sorted(mesh.carrier.attributes) if mesh.carrier else [],
            },
            "style": {
                "name": Path(settings.style).name,
                "picture": style.mesh is None,
            },
        }
        if self._inputs[0] is mesh and self._inputs[1] is read:
            return
        self._inputs = (mesh, read)
        shown = {"source": _bare(mesh)}
        shown["style"] = _bare(style.mesh) if style.mesh is not None else _png(style)
        with self._lock:
            self._check(serial)
            for name, content in shown.items():
                self._looks[name] = Look(self._version + 1, content)
            self._tell(**facts)

    def _show(
        self, serial: int, result: Result, settings: Settings, finished: bool, learned: int = 0
    ) -> None:
        # That of the source as it was, so that a draft, the result and the source don't jump.
        assert self._inputs[0] is not None
        frame = meshes.normalisation(self._inputs[0].vertices)
        points = frame.apply(result.vertices)
        mask = result.subject.mask
        shades = None if mask is None else mask.cpu().numpy() - 1  # blue where it is 0
        content = glb.glb(points, result.faces, float(np.abs(points).max()), shades, bare=True)
        with self._lock:
            self._check(serial)
            self._made = Made(result, settings, finished, learned)
            self._looks["result"] = Look(self._version + 1, content)
            self._notes = list(result.subject.notes)
            self._tell(
                result={
                    "vertices": len(result.vertices),
                    "faces": len(result.faces),
                    "unchanged": result.subject.smooth,
                    "masked": mask is not None,
                    # Shown positions, times scale, plus center, are those of the source's file.
                    "center": frame.center.tolist(),
                    "scale": frame.scale,
                }
            )


def too_large(what: str) -> str:
    """The sentence about a file above `LARGEST`."""
    return f"{what} is larger than {LARGEST >> 20} MB: give it on the command line."


def _fresh(folder: Path) -> Path:
    """The folder, or with a number if there is one."""
    found, number = folder, 1
    while found.exists():
        number += 1
        found = folder.with_name(f"{folder.name}-{number}")
    return found


def _bare(mesh: meshes.Mesh) -> bytes:
    points = meshes.normalisation(mesh.vertices).apply(mesh.vertices)
    return glb.glb(points, mesh.faces, float(np.abs(points).max()), bare=True)


def _png(style: Style) -> bytes:
    from PIL import Image

    assert style.picture is not None
    picture = Image.fromarray((style.picture * 255).round().clip(0, 255).astype(np.uint8))
    picture.thumbnail((512, 512))
    out = io.BytesIO()
    picture.save(out, "PNG")
    return out.getvalue()
