"""Load the files of a run's folder, which may come from a stranger (SECURITY.md).

Every reader of run folders loads records, statuses and lists of jobs here: JSON objects of plain
values, limited in size and depth. A record must not hold interpolations, which could read the
environment, and its sections must have the types that this package writes. Imports nothing heavy.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from styleexp.config.overrides import FILES

LARGEST = 16 << 20
"""Maximum size of a file in bytes; those of a run have some ten thousand."""
DEEPEST = 50
"""Maximum depth of nested values; those of a run have five."""


class Unreadable(ValueError):
    """A file that is damaged, or that holds what it must not; the message lacks the subject."""


def load(path: Path) -> dict[str, Any]:
    """Load a JSON object; empty if there is no such file.

    Raises `Unreadable` for a damaged file, one that holds anything else, and one that exceeds
    `LARGEST` or `DEEPEST`.
    """
    text = _text(path)
    if text is None:
        return {}
    try:
        content = json.loads(text)
    except ValueError as error:
        raise Unreadable(str(error)) from error
    except RecursionError:
        raise Unreadable("it is nested too deeply") from None
    if not isinstance(content, dict):
        raise Unreadable("it is not a JSON object")
    for _, depth in _values(content):
        if depth > DEEPEST:
            raise Unreadable("it is nested too deeply")
    return content


def load_record(path: Path) -> tuple[dict[str, Any], list[str]]:
    """Load a run's ``run.json``, without the sections that have another type than this package
    writes, and one sentence about each of these.

    Raises `Unreadable` like `load`, and for a configuration that holds an interpolation.
    """
    record = load(path)
    if holds_interpolation(record.get("config")):
        raise Unreadable("it holds an interpolation (${...}), but only plain values are allowed")
    damaged = [
        name
        for name, is_valid in SECTIONS.items()
        if record.get(name) is not None and not is_valid(record[name])
    ]
    kept = {name: None if name in damaged else value for name, value in record.items()}
    return kept, [f"{path.name} was read without its {name}, which is damaged." for name in damaged]


def holds_interpolation(config: Any) -> bool:
    """Whether a configuration holds an interpolation (``${...}``) anywhere but in the name of a
    file, which is taken as it stands."""
    return any(isinstance(value, str) and "${" in value for value, _ in _values(config, FILES))


def load_overrides(path: Path) -> list[str]:
    """Load the overrides that Hydra recorded for a job (``.hydra/overrides.yaml``); empty if there
    are none that can be read."""
    import yaml

    try:
        content = yaml.safe_load(_text(path) or "")
    except (Unreadable, ValueError, RecursionError, yaml.YAMLError):  # killed while writing
        return []
    return [each for each in content if isinstance(each, str)] if isinstance(content, list) else []


def is_below(name: str) -> bool:
    """Whether a relative path, joined to a folder, stays below it."""
    return all(
        not path.is_absolute() and not path.drive and ".." not in path.parts and "\0" not in name
        for path in (PurePosixPath(name), PureWindowsPath(name))
    )


def number(value: Any) -> int | float | None:
    """The value if it is a number that a float can hold, else None."""
    if isinstance(value, float):
        return value
    if isinstance(value, bool) or not isinstance(value, int):
        return None
    try:
        float(value)
    except OverflowError:
        return None
    return value


def is_texts(value: Any) -> bool:
    """Whether a value is a list of texts."""
    return isinstance(value, list) and all(isinstance(each, str) for each in value)


def _is_mapping(value: Any) -> bool:
    return isinstance(value, dict)


def _is_assets(value: Any) -> bool:
    return isinstance(value, dict) and all(
        isinstance(asset, dict)
        and all(isinstance(asset.get(key), str | None) for key in ("name", "path", "sha256"))
        for asset in value.values()
    )


def _is_plugins(value: Any) -> bool:
    return isinstance(value, list) and all(
        isinstance(each, dict) and all(isinstance(text, str | None) for text in each.values())
        for each in value
    )


def _is_resumptions(value: Any) -> bool:
    return isinstance(value, list) and all(
        isinstance(each, dict)
        and isinstance(each.get("time"), str)
        and isinstance(each.get("differs"), dict)
        and all(is_texts(pair) and len(pair) == 2 for pair in each["differs"].values())
        for each in value
    )


SECTIONS: dict[str, Callable[[Any], bool]] = {
    "config": _is_mapping,
    "overrides": is_texts,
    "versions": _is_mapping,
    "code": _is_mapping,
    "plugins": _is_plugins,
    "resumed": _is_resumptions,
    "platform": _is_mapping,
    "chosen": _is_mapping,
    "notes": is_texts,
    "assets": _is_assets,
    "weights": _is_assets,
}
"""Checks of a record's sections, each of which may also be missing."""


def _text(path: Path) -> str | None:
    """A file's text; None if there is no such file. Raises `Unreadable`."""
    try:
        if not path.is_file():  # nor a pipe, which would block
            return None
        if (size := path.stat().st_size) > LARGEST:
            raise Unreadable(f"it has {size >> 20} MB, more than {LARGEST >> 20}")
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:  # removed meanwhile
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise Unreadable(str(error)) from error


def _values(tree: Any, aside: tuple[str, ...] = ()) -> Iterator[tuple[Any, int]]:
    """Yield all keys and values of nested containers with their depth, except for the values of
    the keys ``aside``. Doesn't recurse, so that no depth is too great."""
    waiting = [(tree, 0)]
    while waiting:
        value, depth = waiting.pop()
        yield value, depth
        if isinstance(value, dict):
            waiting += [(key, depth + 1) for key in value]
            waiting += [(each, depth + 1) for key, each in value.items() if key not in aside]
        elif isinstance(value, list):
            waiting += [(each, depth + 1) for each in value]
