"""Who works in a folder: a file lock that ends with its process, however that ends."""

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
"""Locks that this process has taken and not used yet, by their folders."""


class Busy(Exception):
    """Another process holds the lock."""


@contextmanager
def hold(folder: Path, timeout: float = 0.0) -> Iterator[None]:
    """Hold a folder's lock; `Busy` if it isn't free within ``timeout`` seconds (-1 waits for ever).

    The kernel releases it when the process ends, kill -9 included. Raises ``OSError`` where the
    folder can't be written or its file system has no locks.
    """
    lock = _taken.pop(os.path.abspath(folder), None) or _acquired(folder, timeout)
    try:
        yield
    finally:
        lock.release()


def take(folder: Path, timeout: float = 0.0) -> None:
    """Take a folder's lock for the next `hold` of this process, or until `drop` or its end.

    Raises what `hold` raises.
    """
    _taken[os.path.abspath(folder)] = _acquired(folder, timeout)


def drop(folder: Path) -> None:
    """Let go what was taken, if it was."""
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
    """Whether a process holds the folder's lock now; nobody does where the folder is read-only."""
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
