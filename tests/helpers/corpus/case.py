"""A row of the corpus: one file, and what has to come of it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from tests.helpers.corpus.writers import Content

WORKS, REPAIRED, REFUSED = "works", "repaired", "refused"


@dataclass(frozen=True)
class Case:
    """One file, and what has to come of it."""

    name: str
    """The file's name, with folders where it lies in some."""
    what: str
    content: Content
    outcome: str
    says: str = ""
    """Part of the repair's note or of the refusal."""
    faces: int | None = None
    """Of the result, where it works."""
    vertices: int | None = None
    beside: dict[str, Content] = field(default_factory=dict)
    """Files that it refers to, or should not be able to."""
    links: dict[str, str] = field(default_factory=dict)
    """Symbolic links beside it, and where they lead."""
    style: bool = False
    """Taken as the style, not as the source."""
    group: str = ""

    def write(self, folder: Path) -> Path:
        """Make the files in an empty folder of their own; returns the one to load."""
        home = folder / "home"
        for name, content in {self.name: self.content, **self.beside}.items():
            path = home / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content() if callable(content) else content)
        for name, target in self.links.items():
            path = home / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.symlink_to(target)
        return home / self.name


def works(name: str, what: str, content: Content, **more) -> Case:
    """A file that is taken as it is."""
    return Case(name, what, content, WORKS, **more)


def repaired(name: str, what: str, content: Content, says: str = "", **more) -> Case:
    """A file that is taken with a repair, which the user is told."""
    return Case(name, what, content, REPAIRED, says, **more)


def refused(name: str, what: str, content: Content, says: str = "", **more) -> Case:
    """A file that ends the run with one sentence."""
    return Case(name, what, content, REFUSED, says, **more)


def group(name: str, *cases: Case) -> tuple[Case, ...]:
    """Cases that docs/robustness.md lists under one heading."""
    return tuple(replace(case, group=name) for case in cases)
