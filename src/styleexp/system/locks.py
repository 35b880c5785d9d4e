"""Folder locks: file locks that are released even if the process is killed."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from filelock import FileLock

NAME = ".lock"
_taken: dict[str, FileLock] = {}
"""Locks that this process has taken and not used yet, keyed by folder."""


class Busy(Exception):
    """Another process holds the lock."""


@contextmanager
def hold(folder: Path, timeout: float = 0.0) -> Iterator[None]:
    """Hold a folder's lock; raise `Busy` after ``timeout`` seconds (-1 waits forever).

    The kernel releases it when the process ends, even after kill -9. Raises ``OSError`` if the
    folder isn't writable or its file system has no locks.
    """
    lock = _taken.pop(os.path.abspath(folder), None) or _acquired(folder, timeout)
    try:
        yield
    finally:
        lock.release()


def take(folder: Path, timeout: float = 0.0) -> None:
    """Take a folder's lock for this process's next `hold`, or until `drop` or exit.

    Raises the same as `hold`.
    """
    _taken[os.path.abspath(folder)] = _acquired(folder, timeout)


def drop(folder: Path) -> None:
    """Release a lock taken by `take`, if any."""
    lock = _taken.pop(os.path.abspath(folder), None)
    if lock is not None:
        lock.release()


def _acquired(folder: Path, timeout: float) -> FileLock:
    from filelock import FileLock, Timeout

    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / NAME, fallback_to_soft=False)
    try:
        lock.acquire(timeout=timeout)
    except Timeout as error:
        raise Busy(str(folder)) from error
    except NotImplementedError as error:
        raise OSError(f"the file system of '{folder}' has no file locks") from error
    return lock


def held(folder: Path) -> bool:
    """Whether a process holds the folder's lock now; False for a read-only folder."""
    if os.path.abspath(folder) in _taken:
        return True
    if not (folder / NAME).exists():
        return False
    try:
        with hold(folder):
            return False
    except Busy:
        return True
    except OSError:
        return False
