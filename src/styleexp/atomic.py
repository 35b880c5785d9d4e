"""Files that are there whole or not at all, however the process or the machine ends."""

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
"""In the names of files that are being written; all of them begin with a dot."""
A_DAY = 86400.0
"""Seconds after which nobody is writing a file any more."""


def write(target: Path, writer: Callable[[Path], Any]) -> Path:
    """Let ``writer`` write under a name of its own beside ``target``, then move it into place.

    Content and name are on the disk when this returns. Readers see the old file or the new one, and
    of several writers the last one wins. Raises ``OSError`` where the folder can't be written.
    """
    # The suffix stays last: writers choose the format by it.
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
    """A writer of UTF-8 text, for `write`."""
    return lambda path: path.write_text(content, encoding="utf-8")


def data(content: bytes) -> Callable[[Path], Any]:
    """A writer of bytes, for `write`."""
    return lambda path: path.write_bytes(content)


def sweep(folder: Path, seconds: float = 0.0) -> None:
    """Remove what writers that were killed left in ``folder``, if it is older than ``seconds``.

    Without an age the caller knows, by a lock, that nobody is writing there.
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
    """Bring a folder's names to the disk, where the system can."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
