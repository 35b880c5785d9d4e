"""Convert overrides as typed by users to Hydra's grammar.

Hydra's grammar gives a meaning to spaces, brackets, quotes, commas, ``=``, ``$`` and most
non-English letters, all of which may occur in file names. So the values of keys that name files are
quoted here, and a word without ``=`` is the source or the style.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from styleexp.system.errors import UserError

FILES = ("path", "weights", "dir", "folder", "file")
"""Last components of keys whose values are files or folders, including those of plugins."""
PARTS = ("source", "style")
"""Keys that take a name or a file; words without ``=`` are assigned to them in this order."""
FUNCTION = re.compile(r"(choice|glob|interval|range|shuffle|sort|tag)\(.*\)", re.DOTALL)
"""Hydra functions that expand to several values."""
PLAIN = re.compile(r"(\.{0,2}/)?[A-Za-z_][\w./-]*", re.ASCII)
"""Text that Hydra parses literally, unless it is a constant."""
CONSTANTS = ("null", "true", "false", "nan", "inf")


def understood(words: Sequence[str], multirun: bool = False) -> list[str]:
    """Convert command-line words to Hydra overrides.

    Up to two words without ``=`` are the source and the style, as names or files. ``source=`` and
    ``style=`` also accept either. With ``multirun`` a comma separates values, unless the whole
    value is an existing file. Values already quoted for Hydra are left alone.

    Raises `UserError` for a third such word, a part given twice, names and files mixed in one
    sweep, and a name that isn't valid UTF-8.
    """
    for word in words:
        _check_text(word)
    overrides = [word for word in words if _is_override(word)]
    free = [word for word in words if not _is_override(word)]
    if len(free) > len(PARTS):
        raise UserError(
            f"'{free[2]}' is one word too many: two words without '=' are the source and the "
            f"style, here '{free[0]}' and '{free[1]}'; everything else is KEY=VALUE."
        )
    for part, word in zip(PARTS, free, strict=False):
        twice = [o for o in overrides if re.match(rf"{part}(\.path|\.name)?=", o)]
        if twice:
            raise UserError(f"the {part} is given twice, as '{word}' and as '{twice[0]}'.")
    given = [f"{part}={word}" for part, word in zip(PARTS, free, strict=False)]
    return [_quoted(each, multirun) for each in [*given, *overrides]]


def is_file(part: str, value: str) -> bool:
    """Whether the value of ``source`` or ``style`` is a file, not a name: it isn't a known name,
    and has a suffix or a folder, or exists."""
    if _known(part, value):
        return False
    path = Path(value)
    return path.suffix != "" or os.sep in value or exists(value)


def exists(name: str) -> bool:
    """Whether the file or folder exists, with ``~`` expanded."""
    try:
        return bool(name) and os.path.exists(expanded(name))
    except ValueError:  # it contains a null byte
        return False


def expanded(name: str) -> str:
    """Expand a leading ``~`` to the home folder, unless a file of that literal name exists."""
    return os.path.expanduser(name) if name[:1] == "~" and not os.path.exists(name) else name


def quote(value: str) -> str:
    """Quote a text so that Hydra, and then OmegaConf, read it literally."""
    if PLAIN.fullmatch(value) and value.lower() not in CONSTANTS:
        return value
    escaped = re.sub(r"(\\*)'", r"\1\1\\'", literal(value))
    closed = re.sub(r"(\\+)$", r"\1\1", escaped)
    return f"'{closed}'"


def literal(value: Any) -> Any:
    """Escape all strings in a value, so that OmegaConf doesn't read them as interpolations."""
    if isinstance(value, dict):
        return {key: literal(each) for key, each in value.items()}
    if isinstance(value, list):
        return [literal(each) for each in value]
    return re.sub(r"(\\*)\$\{", r"\1\1\\${", value) if isinstance(value, str) else value


def _check_text(word: str) -> None:
    if not isinstance(word, str):
        raise UserError(f"the override {word!r} is a {type(word).__name__}: give KEY=VALUE texts.")
    if not word.strip():
        raise UserError("one word is empty: give a name or a file as source and style.")
    if word in ("source=", "style=", "source.path=", "style.path="):
        raise UserError(f"'{word}' has no value: give a name or a file.")
    try:
        word.encode()
    except UnicodeEncodeError:
        raise UserError(
            f"'{word}' is not valid UTF-8, which records and pages require: rename the file."
        ) from None


def _is_override(word: str) -> bool:
    if re.fullmatch(r"~[\w@./-]+", word) and not word.startswith("~/"):
        return not exists(word)  # Hydra's syntax for deleting a key
    return "=" in word and not _is_files(word)


def _is_files(word: str) -> bool:
    """Whether a word that contains ``=`` names an existing file, or several separated by commas."""
    from styleexp.config.sources import SUFFIXES

    return all(
        Path(each).suffix.lower() in SUFFIXES and os.path.isfile(each) for each in _split(word)
    )


def _known(part: str, name: str) -> bool:
    from styleexp import plugins
    from styleexp.inputs import assets, shapes

    kinds = ("mesh", "image") if part == "style" else ("mesh",)
    named = name in shapes.names() or any(name in assets.names(kind) for kind in kinds)
    return named or (part == "style" and plugins.known("style", name))


def _quoted(override: str, multirun: bool) -> str:
    key, equals, value = override.partition("=")
    plain = key.lstrip("+")
    if not equals or plain.startswith("~"):
        return override
    if plain in PARTS:
        return _part(plain, value, multirun)
    if plain == "style.mask":
        return f"{key}={_masks(value, multirun)}"
    if plain.rsplit(".", 1)[-1] in FILES and "." in plain:
        return f"{key}={_files(plain, value, multirun)}"
    return override


def _part(part: str, value: str, multirun: bool) -> str:
    """Override for ``source=`` or ``style=``, given names or files."""
    values = [value]
    if multirun and not exists(value) and not FUNCTION.fullmatch(value):
        values = list(_split(value))
    files = [is_file(part, _unquoted(each)) for each in values]
    if not any(files):
        return f"{part}={value}"
    if not all(files):
        named = values[files.index(False)]
        raise UserError(
            f"{part}={value} mixes files with the name '{named}': give files alone, as "
            f"{part}.path=FILE,FILE, or names alone."
        )
    return f"{part}.path={_files(f'{part}.path', value, multirun)}"


def _files(key: str, value: str, multirun: bool) -> str:
    """Value of a key that names one or several files, in Hydra's grammar."""
    if multirun and not exists(value) and not FUNCTION.fullmatch(value):
        return ",".join(map(_file, _split(value)))
    parts = value.split(",")
    if not multirun and len(parts) > 1 and not exists(value) and all(map(exists, parts)):
        raise UserError(f"{key}={value} names {len(parts)} files: add -m to run each of them.")
    return value if multirun and FUNCTION.fullmatch(value) else _file(value)


def _masks(value: str, multirun: bool) -> str:
    """Value of ``style.mask`` in Hydra's grammar. Lists already are; a single mask may contain a
    file name."""
    if value[:1] in ("[", "") or FUNCTION.fullmatch(value):
        return value
    each = _split(value) if multirun else [value]
    return ",".join(map(_file, each))


def _file(value: str) -> str:
    """One file name in Hydra's grammar. A value that isn't an existing file may be null, already
    quoted for Hydra, or an interpolation."""
    as_it_is = value.lower() in ("", "null") or _in_quotes(value) or "${" in value
    return value if as_it_is and not exists(value) else quote(expanded(value))


def _split(value: str) -> Iterator[str]:
    """Split at commas, except within quotes or within the name of an existing file."""
    parts = value.split(",")
    while parts:
        count = 1
        for end in range(len(parts), 0, -1):
            joined = ",".join(parts[:end])
            if exists(joined) or _in_quotes(joined):
                count = end
                break
        yield ",".join(parts[:count])
        parts = parts[count:]


def _in_quotes(value: str) -> bool:
    return re.fullmatch(r"'(?:[^'\\]|\\.)*'|\"(?:[^\"\\]|\\.)*\"", value, re.DOTALL) is not None


def _unquoted(value: str) -> str:
    return value[1:-1] if _in_quotes(value) else value
