"""Atomic file writes: after a crash a file is complete or absent."""

from __future__ import annotations

import os
import secrets
import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

MARK = ".partial"
"""Marker in the names of files that are being written; these names begin with a dot."""
A_DAY = 86400.0
"""Seconds after which a partial file counts as abandoned."""


def write(target: Path, writer: Callable[[Path], Any]) -> Path:
    """Let ``writer`` write a temporary file next to ``target``, then move it into place.

    Content and name are synced to disk on return. Readers see the old file or the new one; with
    several writers the last one wins. Raises ``OSError`` if the folder isn't writable.
    """
    # Keep the suffix last: writers infer the format from it.
    name = f".{target.stem}.{secrets.token_hex(4)}{MARK}{target.suffix}"
    partial = target.with_name(name)
    try:
        writer(partial)
        with open(partial, "rb") as written:
            os.fsync(written.fileno())
        os.replace(partial, target)
    except BaseException:
        with suppress(OSError):
            partial.unlink()
        raise
    _sync(target.parent)
    return target


def text(content: str) -> Callable[[Path], Any]:
    """Return a writer of UTF-8 text, for `write`."""
    return lambda path: path.write_text(content, encoding="utf-8")


def data(content: bytes) -> Callable[[Path], Any]:
    """Return a writer of bytes, for `write`."""
    return lambda path: path.write_bytes(content)


def sweep(folder: Path, seconds: float = 0.0) -> None:
    """Remove partial files of killed writers in ``folder`` that are older than ``seconds``.

    With the default of 0 the caller must hold a lock, so that nobody is writing there.
    """
    for left in folder.glob(f".*{MARK}*"):
        with suppress(OSError):
            if abs(time.time() - left.stat().st_mtime) < seconds:
                continue
            if left.is_dir():
                shutil.rmtree(left)
            else:
                left.unlink()


def _sync(folder: Path) -> None:
    """Sync a folder's entries to disk, where the system can."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
