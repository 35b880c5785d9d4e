"""The ``styleexp`` command: find it, word it, run it, follow what it prints. Needs no Blender."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from .errors import ExtensionError

LEAST_VERSION = (0, 1, 0)
NAME = "styleexp"
STYLES = (
    "bubble", "buckyball", "knit", "lattice", "rail", "scales", "stripe", "terrain", "wave_large",
    "wave_small", "weave", "wool",
)  # fmt: skip
"""Names to suggest: those of styles that need no download."""
DIRECTIONS = ("auto", "up", "flow")
LIMITS = {
    "strength": (-2.0, 2.0),
    "scale": (0.1, 10.0),
    "rotation": (-180.0, 180.0),
    "falloff": (0.0, 2.0),
    "seed": (0, 2**31 - 1),
}
SOURCE, STYLE, RUN, LOG = "source.ply", "style.ply", "run", "log.txt"
"""Files and folder in a job's own folder."""
QUICK = (
    "report=false",
    "metrics.judge=none",
    "preview.resolution=96",
    "preview.turntable_frames=1",
)
"""Without the pages and pictures that nobody opens from Blender; an override replaces each."""
PATIENCE = 5.0
"""Seconds between the asking, the insisting and the killing of a command that is to stop."""


@dataclass(frozen=True)
class Settings:
    """The artist's choices; names, limits and defaults are those of ``styleexp-studio``."""

    style: str
    """A name or a file."""
    strength: float = 1.0
    scale: float = 1.0
    direction: str = "auto"
    rotation: float = 0.0
    """Degrees."""
    mask: str = ""
    """``style.mask``; empty for the whole surface."""
    falloff: float = 0.05
    invert: bool = False
    seed: int = 0
    refine: str = "auto"
    """``source.refine``: auto, none or a number of faces."""
    more: str = ""
    """Further overrides, separated by spaces, quoted as in a shell."""


def overrides(settings: Settings) -> list[str]:
    """The overrides of what differs from the command's defaults, and the further ones."""
    plain = Settings("")
    found = []
    if settings.strength != plain.strength:
        found.append(f"strength={settings.strength:g}")
    for name in ("scale", "direction", "rotation", "falloff"):
        value = getattr(settings, name)
        if value != getattr(plain, name) and (name != "falloff" or settings.mask):
            found.append(f"style.{name}={value if isinstance(value, str) else f'{value:g}'}")
    if settings.mask:
        found.append(f"style.mask={settings.mask}")
    if settings.invert:
        found.append("style.invert=true")
    if settings.seed != plain.seed:
        found.append(f"optim.seed={settings.seed}")
    return [*found, *further(settings.more)]


def further(text: str) -> list[str]:
    """The overrides in a line of text. Raises `ExtensionError` for anything else."""
    try:
        words = shlex.split(text.replace("\\", "\\\\") if os.name == "nt" else text)
    except ValueError:
        raise ExtensionError(f"the overrides '{text}' have a quote without its partner.") from None
    for word in words:
        key, equals, _ = word.partition("=")
        if not equals or not re.fullmatch(r"[+~]{0,2}[A-Za-z_][\w./@:]*", key):
            raise ExtensionError(
                f"'{word}' is not an override: write KEY=VALUE, such as optim.seed=3."
            )
        if key in ("source", "source.path", "style", "style.path", "resume") or key.startswith(
            ("hydra.", "+hydra.", "+experiment", "+search")
        ):
            raise ExtensionError(f"'{word}' can't be given here: the extension sets {key} itself.")
    return words


def words(executable: str, settings: Settings) -> list[str]:
    """The command, to be run in the job's folder."""
    if settings.style.startswith("-"):
        raise ExtensionError(f"'{settings.style}' is not a style: give a name or a file.")
    given = overrides(settings)
    keys = {each.partition("=")[0].lstrip("+") for each in given}
    # Said in any case, because methods differ in what they do by default.
    ours = [*QUICK, f"source.refine={settings.refine}"]
    plain = [each for each in ours if each.partition("=")[0] not in keys]
    return [executable, SOURCE, settings.style, *plain, *given, f"hydra.run.dir={RUN}"]


# --------------------------------------------------------------------------------- the executable


def executable(given: str) -> str:
    """The command's path: as given, or found in a given environment's folder or on ``PATH``.

    Raises `ExtensionError` if there is none, or if it is older than `LEAST_VERSION`.
    """
    if given:
        path = Path(given).expanduser()
        inside = (
            [path / folder / NAME for folder in ("", "bin", "Scripts")] if path.is_dir() else []
        )
        tried = [file for each in inside for file in (each, each.with_suffix(".exe"))]
        found = next((str(file) for file in (*tried, path) if file.is_file()), None)
        where = f"is not at '{given}'"
    else:
        found, where = shutil.which(NAME), "was not found on PATH"
    if found is None:
        raise ExtensionError(
            f"the command {NAME} {where}: install it (pip install {NAME}) and give its path in the "
            "extension's preferences."
        )
    path = Path(found).absolute()
    least = ".".join(map(str, LEAST_VERSION))
    if version(str(path), path.stat().st_mtime_ns) < LEAST_VERSION:
        raise ExtensionError(
            f"'{path}' is older than {least}: upgrade it (pip install --upgrade {NAME})."
        )
    return str(path)


@lru_cache
def version(path: str, changed: int) -> tuple[int, ...]:
    """The version that the executable says it has; asked once for each state of the file.

    Raises `ExtensionError` if it isn't ``styleexp`` or doesn't start.
    """
    try:
        told = subprocess.run(
            [path, "--version"], capture_output=True, text=True, timeout=30,
            stdin=subprocess.DEVNULL, errors="replace",
        ).stdout  # fmt: skip
    except (OSError, subprocess.TimeoutExpired) as error:
        raise ExtensionError(f"'{path}' doesn't start ({error}): install {NAME} anew.") from None
    match = re.match(rf"{NAME} (\d+)\.(\d+)\.(\d+)", told)
    if match is None:
        raise ExtensionError(
            f"'{path}' is not the command {NAME}: give another path in the extension's preferences."
        )
    return tuple(map(int, match.groups()))


# -------------------------------------------------------------------------------------- progress


@dataclass(frozen=True)
class Progress:
    """What the command does now."""

    stage: str
    fraction: float | None = None
    """Of this stage; None if it can't be told."""


def progress(lines: Iterable[str]) -> Progress:
    """The latest progress that these lines of the command's output tell."""
    for line in reversed(list(lines)):
        if match := re.match(r"step (\d+)/(\d+) ", line):
            step, total = map(int, match.groups())
            return Progress(f"step {step} of {total}", step / total)
        match = re.fullmatch(r"([a-z].*?)(?: \.\.\.|: \d+ s)", line)
        if match and not line.startswith(("note:", "warning:", f"{NAME}:")):
            part = re.search(r"round (\d+) of (\d+)$", match[1])
            return Progress(match[1], int(part[1]) / int(part[2]) if part else None)
    return Progress("starting")


def notes(lines: Iterable[str]) -> list[str]:
    """The command's notes on the mesh and the style, without those on the exchange itself."""
    ours = ("only the PLY is complete", "triangulated ", "merged ")
    found = [line.removeprefix("note: ") for line in lines if line.startswith("note: ")]
    return [note for note in found if not any(each in note for each in ours)]


def failure(lines: Iterable[str], log: Path) -> str:
    """One sentence on why the command failed: its own, or its last line and where the rest is."""
    told = [line for line in lines if line.strip()]
    for line in reversed(told):
        if line.startswith(f"{NAME}: "):
            return line.removeprefix(f"{NAME}: ")
    last = told[-1] if told else "nothing was printed"
    return f"{NAME} ended unexpectedly ({last}): see '{log}'."


# --------------------------------------------------------------------------------------- a process


class Process:
    """The running command. Its output goes to ``log.txt`` in its folder, and to `lines`."""

    def __init__(self, command: list[str], folder: Path) -> None:
        self.log = folder / LOG
        self.lines: list[str] = []
        self._asked: list[float] = []
        windows = os.name == "nt"
        try:
            self._process = subprocess.Popen(
                command, cwd=folder, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT, encoding="utf-8", errors="replace",
                env={**os.environ, "PYTHONUTF8": "1"},
                # Windows sends CTRL_BREAK to process groups.
                creationflags=subprocess.CREATE_NEW_PROCESS_GROUP if windows else 0,
            )  # fmt: skip
        except OSError as error:
            raise ExtensionError(f"'{command[0]}' doesn't start: {error.strerror}.") from None
        self._reader = threading.Thread(target=self._read, args=(command,), daemon=True)
        self._reader.start()

    def _read(self, command: list[str]) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as output, open(self.log, "w", encoding="utf-8") as log:
            log.write(shlex.join(command) + "\n")
            for line in output:
                self.lines.append(line.rstrip())
                log.write(line)
                log.flush()

    def poll(self) -> int | None:
        """The exit code once it has ended and all is read, else None. Insists on a stop."""
        if self._asked and self._process.poll() is None:
            self._insist()
        code = self._process.poll()
        if code is not None:
            self._reader.join(1.0)
        return code

    @property
    def stopped(self) -> bool:
        """Whether it was asked to stop."""
        return bool(self._asked)

    def stop(self) -> None:
        """Ask it to stop, as Ctrl-C does; `poll` tells when it has."""
        if not self._asked and self._process.poll() is None:
            windows = os.name == "nt"
            self._process.send_signal(signal.CTRL_BREAK_EVENT if windows else signal.SIGINT)
            self._asked.append(time.monotonic())

    def end(self) -> None:
        """Stop it now, and wait for its end: Blender closes, or the file does."""
        self.stop()
        try:
            self._process.wait(1.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _insist(self) -> None:
        """Terminate, then kill, what doesn't stop: who starts Blender in a shell's background has
        it ignore Ctrl-C, and with it the processes it starts."""
        if time.monotonic() - self._asked[-1] > PATIENCE:
            (self._process.terminate if len(self._asked) == 1 else self._process.kill)()
            self._asked.append(time.monotonic())
