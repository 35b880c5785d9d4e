"""The code that a part or this package was made of, by hash: edited code has another one."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from collections.abc import Iterator, Mapping
from functools import cache
from importlib.machinery import EXTENSION_SUFFIXES, SOURCE_SUFFIXES
from pathlib import Path
from typing import Any

from styleexp.inputs import assets

SUFFIXES = (*SOURCE_SUFFIXES, *EXTENSION_SUFFIXES)
ELSEWHERE = ("conf/", "notebooks/")
"""Folders of this package once it is installed; in a checkout they lie beside it."""
GIT_PATIENCE = 10.0
"""Seconds to wait for git."""


@cache
def of_modules(names: frozenset[str]) -> str | None:
    """SHA-256 of the code of loaded modules; None if one has no file, as in a zip archive.

    A module in a package stands for all of the outermost package's Python files and compiled
    modules, because a spec imports the rest of its package only when it is used. A single file has
    its own sha256. Cached, because later changes of a file don't change what was loaded from it.
    """
    found: dict[str, Path] = {}
    for name in names:
        files = _files(name)
        if not files:
            return None
        found |= files
    return of_files(found) if found else None


def file_of(name: str) -> Path | None:
    """The file of a loaded module, if it has one."""
    file = getattr(sys.modules.get(name), "__file__", None)
    return Path(file).absolute() if file and Path(file).is_file() else None


def of_files(files: Mapping[str, Path]) -> str:
    """A file's sha256; of several, the hash of their names, which are the keys, and sha256s."""
    if len(files) == 1:
        return assets.sha256(*files.values())
    lines = [f"{assets.sha256(files[name])}  {name}\n" for name in sorted(files)]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


@cache
def own() -> dict[str, Any]:
    """This package's code, for a run's record: the ``sha256`` of its Python files and, if it runs
    from a git checkout, the ``commit`` and whether files of ``src`` or ``conf`` differ from it
    (``dirty``). These two are None if git can't tell."""
    import styleexp

    package = Path(styleexp.__file__).absolute().parent
    files = {name: path for name, path in _below(package) if not name.startswith(ELSEWHERE)}
    found: dict[str, Any] = {"sha256": of_files(files)}
    root = package.parents[1]
    if (root / ".git").exists() and package == root / "src" / "styleexp":
        changes = _git(root, "status", "--porcelain", "--", "src", "conf")
        found["commit"] = _git(root, "rev-parse", "HEAD")
        found["dirty"] = None if changes is None else bool(changes)
    return found


def _files(name: str) -> dict[str, Path]:
    """The files that a module stands for, see `of_modules`; namespace packages have none."""
    parts = name.split(".")
    for end in range(1, len(parts) + 1):
        outer = ".".join(parts[:end])
        file = file_of(outer)
        if file is None:
            continue
        if not hasattr(sys.modules[outer], "__path__"):
            return {file.name: file}
        return {f"{file.parent.name}/{path}": at for path, at in _below(file.parent)}
    return {}


def _below(package: Path) -> Iterator[tuple[str, Path]]:
    """Yield a package's files of code, with their paths below its folder."""
    for path in package.rglob("*"):
        if path.name.endswith(SUFFIXES) and path.is_file():
            yield path.relative_to(package).as_posix(), path


def _git(root: Path, *words: str) -> str | None:
    """What git says; None if it isn't there, refuses, or takes too long."""
    command = ["git", "--no-optional-locks", "-C", str(root), *words]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=GIT_PATIENCE)
    except (OSError, ValueError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None
