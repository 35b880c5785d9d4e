"""Identify the run in a folder by its key, never by the folder's location.

The key is a hash of everything that determines a result. A job of a sweep or plan reads state and
numbers only from a record with its own key; `not_of` explains a mismatch.
"""

from __future__ import annotations

import hashlib
import json
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from styleexp.config.schema import Config

ABSENT = "not found"
"""Placeholder for the sha256 of a missing file."""
ASIDE = ("threads", "debug", "logger", "report", "formats", "simplify", "keep_checkpoint")
"""Keys that don't affect a result."""


def essence(config: Mapping[str, Any]) -> Any:
    """A run's configuration as plain JSON, without keys that don't affect the result."""
    kept = {key: value for key, value in config.items() if key not in ASIDE}
    return json.loads(json.dumps(kept, default=str))


def job_key(config: Config) -> str:
    """Hash of everything that determines a run's result: its resolved configuration, this package's
    version, the content of its source and style files, and the code of its plugins.

    Runs of built-in parts alone have the keys that they had before the last was part of it.
    """
    from styleexp import __version__

    return _hash(asdict(config), _files(config), __version__, plugin_code(config))


def plugin_code(config: Config) -> dict[str, str | None]:
    """Hash of the code of each plugin that a run's result depends on, by ``kind=name``; the
    plugin's version if its code can't be hashed."""
    from styleexp import plugins

    return _by_name(plugins.used(config))


def edited(config: Config, record: Mapping[str, Any]) -> list[str]:
    """The plugins of a configuration, as ``kind=name``, whose code is not that of a recorded run,
    or for which the record doesn't tell."""
    theirs = record.get("plugins")
    before = _by_name(theirs if isinstance(theirs, list) else ())
    return [name for name, code in plugin_code(config).items() if before.get(name) != code]


def edited_since(config: Config, overrides: Sequence[str], record: Mapping[str, Any]) -> list[str]:
    """Like `edited`, but empty unless the recorded run had the same overrides and is this
    configuration's in all but these plugins and their options, whose defaults an edit may change.
    """
    from styleexp import __version__

    names = edited(config, record)
    kinds = {name.partition("=")[0] for name in names}

    def rest(of: Mapping[str, Any]) -> dict[str, Any]:
        return {key: value for key, value in of.items() if key not in kinds}

    try:
        files = {kind: asset["sha256"] for kind, asset in record["assets"].items()}
        theirs = _hash(rest(record["config"]), files, record["versions"]["styleexp"])
    except (KeyError, TypeError, AttributeError):
        return []
    ours = _hash(rest(asdict(config)), _files(config), __version__)
    return names if theirs == ours and record.get("overrides") == list(overrides) else []


def _by_name(used: Iterable[Mapping[str, Any]]) -> dict[str, str | None]:
    return {
        f"{each.get('kind')}={each.get('name')}": each.get("sha256") or each.get("version")
        for each in used
        if each.get("kind") not in ASIDE
    }


def _files(config: Config) -> dict[str, str | None]:
    from styleexp.config import sources
    from styleexp.system.errors import UserError

    files = {}
    for kind, part in sources.parts(config).items():
        try:
            path = sources.locate(kind, part.name, part.path)
            files[kind] = sha256(path) if path else None
        except UserError:  # the run reports it
            files[kind] = ABSENT
    return files


def of(record: Mapping[str, Any]) -> str | None:
    """Key of a recorded run; None for records of earlier versions that lack it."""
    if isinstance(key := record.get("key"), str):
        return key
    try:
        files = {kind: record["assets"][kind]["sha256"] for kind in ("source", "style")}
        return _hash(record["config"], files, record["versions"]["styleexp"])
    except (KeyError, TypeError, AttributeError):
        return None


def not_of(key: str | None, overrides: Sequence[str], record: Mapping[str, Any]) -> str | None:
    """Why a record doesn't belong to the job with this key; None if it does.

    Without a key, as in sweeps of earlier versions, the job is matched by its overrides.
    """
    if key and of(record) is None and "assets" not in record:
        return None  # of an earlier version, ended before it read files or had numbers
    theirs = record.get("overrides")
    theirs = list(map(str, theirs)) if isinstance(theirs, list) else []
    if (of(record) == key) if key else (theirs == list(overrides)):
        return None
    difference = shlex.join(["styleexp", *theirs])
    if theirs == list(overrides):
        difference = "the same overrides with other files, plugins or another version"
    return f"the folder holds another run ({difference})"


def _hash(
    config: Mapping[str, Any],
    files: Mapping[str, str | None],
    version: str | None,
    code: Mapping[str, str | None] | None = None,
) -> str:
    content = {"config": essence(config), "files": files, "by": version}
    if code:
        content["plugins"] = code
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def sha256(path: Path) -> str:
    """SHA-256 of a file, or `ABSENT`. For a ``.gltf`` with external buffers, which hold the
    geometry, the hash of all their hashes."""
    found = [_of_file(path), *map(_of_file, _buffers(path))]
    return found[0] if len(found) == 1 else hashlib.sha256("".join(found).encode()).hexdigest()


def _buffers(path: Path) -> list[Path]:
    if path.suffix.lower() != ".gltf":
        return []
    from styleexp.inputs.meshes import references

    try:
        content = json.loads(path.read_bytes())
        names = [each["uri"] for each in content.get("buffers", []) if "uri" in each]
        found = [references.find(name, path.parent, path.parent)[0] for name in names
                 if not name.startswith("data:")]  # fmt: skip
    except (OSError, ValueError, RecursionError, TypeError, AttributeError):
        return []  # it can't be read as a mesh either
    return [each for each in found if each is not None]


def _of_file(path: Path) -> str:
    try:
        known = path.stat()
    except OSError:
        return ABSENT
    return _read(path.absolute(), known.st_mtime_ns, known.st_size, known.st_ino)


@lru_cache(maxsize=4096)
def _read(path: Path, *version: int) -> str:
    """SHA-256 of a file, cached per ``version``."""
    from styleexp.inputs import assets

    return assets.sha256(path) if path.is_file() else ABSENT
