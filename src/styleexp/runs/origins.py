"""The input files of a run: where they were, and whether they are unchanged.

Everything that reopens a run (``resume=``, metrics, maps, pages, figures) finds its files through
this module, from any working folder. A file is matched by its content, not by its name.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from styleexp.config import sources
from styleexp.inputs import assets
from styleexp.runs import identity
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from styleexp.config.schema import Config
    from styleexp.inputs.meshes import Mesh
    from styleexp.runs.reading import Run


def describe(config: Config) -> dict[str, dict[str, str | None]]:
    """Name, absolute path and sha256 of the source, the style and the mask's images, keyed as in
    `sources.parts`, for the run's record. Analytic shapes have no file; the package version
    defines them. Raises `UserError` for a missing file."""
    found = {}
    for kind, part in sources.parts(config).items():
        path = sources.locate(kind, part.name, part.path)
        digest = identity.sha256(path) if path else None
        if digest == identity.ABSENT:
            raise UserError(f"the {kind} '{path}' does not exist.")
        found[kind] = {
            "name": part.name,
            "path": str(path.absolute()) if path else None,
            "sha256": digest,
        }
    return found


def noted(config: Config, encoders: Iterable[str | None]) -> dict[str, Any]:
    """``assets``, see `describe`, and the ``weights`` of these encoders, as far as available, for
    the record of a run that is about to start."""
    record: dict[str, Any] = {"weights": {}}
    with suppress(UserError, OSError):  # the run itself reports it
        record["assets"] = describe(config)
    for name in sorted(set(assets.names("weights")) & {each for each in encoders if each}):
        # Their content is checked against the published hash whenever they are read.
        if path := assets.locate(name, "weights"):
            record["weights"][name] = {
                "path": str(path.absolute()),
                "sha256": identity.sha256(path),
            }
    return record


def restored(
    record: Mapping[str, Any],
    folder: Path,
    purpose: str,
    tell: Callable[[str], Any] | None = None,
) -> Config:
    """The configuration in a run's record, with the exact files that the run used.

    ``tell`` receives notes for the user; by default they are printed to standard error. Raises
    `UserError` for a file that has changed or is missing, and the errors of `compose.recorded`.
    """
    from styleexp.config import compose
    from styleexp.method import masks

    config = compose.recorded(record.get("config"))
    pictures = []
    for kind in sources.parts(config):
        try:
            path = find(record, config, kind, folder, tell)
        except UserError as error:
            raise UserError(f"cannot {purpose} '{folder}': {error}") from None
        if path is not None and kind in sources.FILES:
            getattr(config, kind).path = str(path)
        elif path is not None:
            pictures.append(str(path))
    config.style.mask = masks.with_files(config.style.mask, pictures)
    return config


def find(
    record: Mapping[str, Any],
    config: Config,
    kind: str,
    folder: Path,
    tell: Callable[[str], Any] | None = None,
) -> Path | None:
    """The file that the run in ``folder`` used as source or style; None if it used none.

    Raises `UserError`, whose message lacks the subject, for a file that has changed or is missing.
    """
    part = sources.parts(config)[kind]
    used = (record.get("assets") or {}).get(kind) or {}
    digest = used.get("sha256")
    if digest is None:
        path = sources.locate(kind, part.name, part.path)
        if path is None:
            return None
        raise UserError(f"its record has no sha256 of its {kind} '{path}': start the run again.")
    named = Path(str(used.get("path") or part.path or part.name))
    there = False
    for path in _candidates(named, kind, part, folder):
        if not path.is_file():
            continue
        if identity.sha256(path) == digest:
            if path != named:
                (tell or _tell)(
                    f"note: the {kind} of '{folder}' was '{named}'; using '{path}', which has the "
                    "same sha256."
                )
            return path
        there = there or path == named or not named.is_absolute()
    where = "" if named.is_absolute() else f" (looked for in '{Path.cwd()}')"
    what = "has changed since the run began" if there else "is missing"
    raise UserError(f"its {kind} '{named}' {what}{where}: restore it, or start the run again.")


def source(run: Run) -> Mesh:
    """The mesh that a run was made from, as its file has it: neither remeshed nor refined.

    Raises `UserError` if it is missing or has changed.
    """
    from styleexp.config import compose

    config = compose.recorded(run.record.get("config"))
    try:
        if path := find(run.record, config, "source", run.folder):
            config.source.path = str(path)
    except UserError as error:
        raise UserError(f"'{run.folder}' can't be used: {error}") from None
    config.source.remesh = None
    return sources.load_source(config.source)


def _candidates(named: Path, kind: str, part: Any, folder: Path) -> Iterator[Path]:
    """Candidate locations of a run's file: its recorded path; the same relative path from the run's
    folder or the current one (for records without absolute paths, and folders moved together); or
    wherever its name resolves to."""
    if named.is_absolute():
        yield named
    typed = Path(part.path) if part.path else named
    if not typed.is_absolute():
        for base in (Path.cwd(), *folder.absolute().parents):
            yield base / typed
    if not part.path:
        with suppress(UserError):
            if path := sources.locate(kind, part.name, None):
                yield path.absolute()


def _tell(note: str) -> None:
    print(note, file=sys.stderr)
