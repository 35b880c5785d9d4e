"""Which run a folder holds: a run is known by its key, never by where its folder lies.

The key is a hash of what a result follows from. A job of a sweep or a plan takes state and numbers
only from a record with its own key; `not_of` says what else a folder holds.
"""

from __future__ import annotations

import hashlib
import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from styleexp.config import Config

FILES = ("source", "style")
"""Parts of the configuration that may name a file."""


@dataclass(frozen=True)
class Named:
    """What may be a file of a run: `FILES`, or a picture of ``style.mask``."""

    name: str | None
    path: str | None


ABSENT = "not found"
"""In the place of a file's sha256."""


def essence(config: Mapping[str, Any]) -> Any:
    """A run's configuration as plain JSON, without what its result doesn't follow from."""
    aside = ("threads", "debug", "logger", "report")
    kept = {key: value for key, value in config.items() if key not in aside}
    return json.loads(json.dumps(kept, default=str))


def job_key(config: Config) -> str:
    """Hash of what a run's result follows from: its resolved configuration, this version, and the
    content of the files of its source and style."""
    from styleexp import __version__, sources
    from styleexp.errors import UserError

    files = {}
    for kind, part in parts(config).items():
        try:
            path = sources.locate(kind, part.name, part.path)
            files[kind] = sha256(path) if path else None
        except UserError:  # the run will say so
            files[kind] = ABSENT
    return _hash(asdict(config), files, __version__)


def parts(config: Config) -> dict[str, Named]:
    """All of a run that may be a file, by the words for it: ``source``, ``style`` and, as often as
    ``style.mask`` has a picture, ``mask``, ``mask 2`` and so on."""
    from styleexp import masks

    found = {kind: Named(getattr(config, kind).name, getattr(config, kind).path) for kind in FILES}
    for k, path in enumerate(masks.files(config.style.mask), 1):
        found["mask" if k == 1 else f"mask {k}"] = Named(None, path)
    return found


def of(record: Mapping[str, Any]) -> str | None:
    """The key of a recorded run; None where the record, of an earlier version, doesn't tell."""
    if isinstance(told := record.get("key"), str):
        return told
    try:
        files = {kind: record["assets"][kind]["sha256"] for kind in FILES}
        return _hash(record["config"], files, record["versions"]["styleexp"])
    except (KeyError, TypeError, AttributeError):
        return None


def not_of(key: str | None, overrides: Sequence[str], record: Mapping[str, Any]) -> str | None:
    """Why a record is not that of the job with this key; None where it is.

    Without a key, as in sweeps of earlier versions, the job is known by its overrides.
    """
    if key and of(record) is None and "assets" not in record:
        return None  # an earlier version's, which ended before it had read a file or had numbers
    theirs = record.get("overrides")
    theirs = list(map(str, theirs)) if isinstance(theirs, list) else []
    if (of(record) == key) if key else (theirs == list(overrides)):
        return None
    told = shlex.join(["styleexp", *theirs])
    if theirs == list(overrides):
        told = "the same overrides with other files or another version"
    return f"the folder holds another run ({told})"


def _hash(config: Mapping[str, Any], files: Mapping[str, str | None], version: str | None) -> str:
    content = {"config": essence(config), "files": files, "by": version}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def sha256(path: Path) -> str:
    """The sha256 of a file, `ABSENT` where there is none; of a ``.gltf`` with buffers beside it,
    where its geometry lies, that of all their sha256."""
    found = [_of_file(path), *map(_of_file, _buffers(path))]
    return found[0] if len(found) == 1 else hashlib.sha256("".join(found).encode()).hexdigest()


def _buffers(path: Path) -> list[Path]:
    if path.suffix.lower() != ".gltf":
        return []
    from styleexp.meshes import references

    try:
        content = json.loads(path.read_bytes())
        names = [each["uri"] for each in content.get("buffers", []) if "uri" in each]
        found = [references.find(name, path.parent, path.parent)[0] for name in names
                 if not name.startswith("data:")]  # fmt: skip
    except (OSError, ValueError, RecursionError, TypeError, AttributeError):
        return []  # it can't be read as a mesh, either
    return [each for each in found if each is not None]


def _of_file(path: Path) -> str:
    try:
        known = path.stat()
    except OSError:
        return ABSENT
    return _read(path.absolute(), known.st_mtime_ns, known.st_size, known.st_ino)


@lru_cache(maxsize=4096)
def _read(path: Path, *version: int) -> str:
    """The sha256 of a file, read once for each ``version`` of it."""
    from styleexp import assets

    return assets.sha256(path) if path.is_file() else ABSENT
