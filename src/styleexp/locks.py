"""Who works in a folder: a file lock that ends with its process, however that ends."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

NAME = ".lock"


class Busy(Exception):
    """Another process holds the lock."""


@contextmanager
def hold(folder: Path, timeout: float = 0.0) -> Iterator[None]:
    """Hold a folder's lock; `Busy` if it isn't free within ``timeout`` seconds (-1 waits for ever).

    The kernel releases it when the process ends, kill -9 included. Raises ``OSError`` where the
    folder can't be written or its file system has no locks.
    """
    from filelock import FileLock, Timeout

    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / NAME, fallback_to_soft=False)
    try:
        lock.acquire(timeout=timeout)
    except Timeout as error:
        raise Busy(str(folder)) from error
    except NotImplementedError as error:
        raise OSError(f"the file system of '{folder}' has no file locks") from error
    try:
        yield
    finally:
        lock.release()


def held(folder: Path) -> bool:
    """Whether a process holds the folder's lock now; nobody does where the folder is read-only."""
    if not (folder / NAME).exists():
        return False
    try:
        with hold(folder):
            return False
    except Busy:
        return True
    except OSError:
        return False
