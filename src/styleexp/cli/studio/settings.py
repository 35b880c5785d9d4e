"""What the page's controls say, and the same as overrides of a command."""

from __future__ import annotations

import math
import re
import shlex
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from styleexp.system.errors import UserError

DIRECTIONS = ("auto", "up", "flow", "x", "y", "z")
LIMITS = {
    "strength": (-2.0, 2.0),
    "scale": (0.1, 10.0),
    "rotation": (-180.0, 180.0),
    "falloff": (0.0, 2.0),
    "seed": (0, 2**31 - 1),
    "steps": (10, 1000),
}


@dataclass(frozen=True)
class Settings:
    """The state of the controls."""

    source: str = "critter"
    """A name or a file, as on the command line."""
    style: str = "scales"
    strength: float = 1.0
    scale: float = 1.0
    direction: str = "auto"
    rotation: float = 0.0
    """Degrees."""
    mask: str = ""
    """``style.mask``, its terms separated by spaces; empty for the whole surface."""
    falloff: float = 0.05
    """Radii of the source."""
    invert: bool = False
    """Of a picture: dark is high."""
    seed: int = 0
    steps: int = 100
    """Steps of the learning."""
    more: tuple[str, ...] = ()
    """Further overrides, from the command line; the page can't change them."""

    def changed(self, given: dict[str, Any]) -> Settings:
        """A copy with these values. Raises `UserError` for an unknown or an unfit one."""
        known = {each.name: type(getattr(self, each.name)) for each in fields(self)}
        del known["more"]
        values = asdict(self)
        for name, value in given.items():
            if name not in known:
                raise UserError(f"there is no setting '{name}'.")
            values[name] = _fit(name, value, known[name])
        if values["direction"] not in DIRECTIONS and not values["direction"].startswith(
            "attribute:"
        ):
            raise UserError(
                f"direction '{values['direction']}' is not one of {', '.join(DIRECTIONS)} or "
                "attribute:NAME."
            )
        return Settings(**values)

    @property
    def mask_without_strokes(self) -> str:
        """The mask without the brush's strokes, which are places on one mesh."""
        return " ".join(each for each in self.mask.split() if "near:" not in each)

    @property
    def overrides(self) -> list[str]:
        """Overrides of everything but source and style that differs from a command's defaults."""
        plain = Settings()
        found = []
        if self.strength != plain.strength:
            found.append(f"strength={self.strength:g}")
        for name in ("scale", "direction", "rotation", "falloff"):
            value = getattr(self, name)
            if value != getattr(plain, name) and (name != "falloff" or self.mask):
                found.append(f"style.{name}={value if isinstance(value, str) else f'{value:g}'}")
        if terms := self.mask.split():
            listed = "[" + ",".join(terms) + "]"
            found.append(f"style.mask={terms[0] if len(terms) == 1 else listed}")
        if self.invert:
            found.append("style.invert=true")
        if self.seed != plain.seed:
            found.append(f"optim.seed={self.seed}")
        return [*found, *self.more]

    @property
    def learning(self) -> list[str]:
        """All overrides with which learning goes on from the synthesis. Options of the synthesis
        itself (``baseline.``) aren't options of ``method=robust``."""
        given = [each for each in self.overrides if not each.startswith("baseline.")]
        keys = {each.partition("=")[0] for each in given}
        plain = ("method=robust", "field.start=synthesis", "source.refine=auto", "profile=fast")
        more = [each for each in (*plain, f"optim.steps={self.steps}")
                if each.partition("=")[0] not in keys]  # fmt: skip
        return [*given, *more]

    def command(self, learned: bool = False) -> str:
        """The command that makes the same."""
        overrides = self.learning if learned else self.overrides
        return shlex.join(["styleexp", self.source, self.style, *overrides])


def _fit(name: str, value: Any, kind: type) -> Any:
    """The value in its setting's type and within its limits."""
    if kind is str:
        if not isinstance(value, str) or len(value) > 4096 or not value.isprintable():
            raise UserError(f"{name} must be a short text.")
        return value.strip()
    if kind is bool:
        if not isinstance(value, bool):
            raise UserError(f"{name} must be true or false.")
        return value
    least, most = LIMITS[name]
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not number or not math.isfinite(value) or not least <= value <= most:
        raise UserError(f"{name} must be a number from {least:g} to {most:g}.")
    return kind(value)


def safe_name(name: str) -> str:
    """The last part of a file's name as a browser gives it, with nothing that could leave the
    folder it is put in. Raises `UserError` if nothing remains."""
    last = re.split(r"[/\\]", name)[-1]
    kept = "".join(letter for letter in last if letter.isprintable()).strip().lstrip(".~-+=")
    if not kept or len(kept.encode()) > 200 or kept == Path(kept).suffix:
        raise UserError(f"the file's name {name!r} can't be used: rename the file.")
    return kept
