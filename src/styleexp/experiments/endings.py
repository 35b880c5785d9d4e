"""How a run ends other than by finishing: interrupted, out of memory, or unable to write."""

from __future__ import annotations

import os
import re
import signal
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from styleexp.config.schema import Config
    from styleexp.runs.records import RunFolder


@contextmanager
def interruptible() -> Iterator[list[int]]:
    """Yield a list that the first Ctrl-C (or SIGTERM, or a closed terminal) appends to; a second
    one stops at once."""
    caught: list[int] = []

    def note(number: int, frame: Any) -> None:
        if caught:
            raise KeyboardInterrupt
        caught.append(number)

    signals = [signal.SIGINT, signal.SIGTERM]
    # Windows has no SIGHUP, and nohup ignores it.
    hangup = getattr(signal, "SIGHUP", None)
    if hangup is not None and signal.getsignal(hangup) is not signal.SIG_IGN:
        signals.append(hangup)
    before = {s: signal.signal(s, note) for s in signals}
    try:
        yield caught
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def failed_writing(folder: RunFolder, error: OSError) -> UserError:
    """Record a failure of the file system, and return it as an error for the user."""
    if not folder.path.is_dir():
        return UserError(
            f"the run's folder '{folder.path}' was removed during the run: start the run again."
        )
    if isinstance(error, FileNotFoundError) and _is_within(error.filename, folder.path):
        message = (
            f"files of the run's folder '{folder.path}' were removed during the run: start the "
            "run again."
        )
        folder.forget()
        fail(folder, message)
        return UserError(message)
    fail(folder, str(error))
    if error.filename is not None and not _is_within(error.filename, folder.path):
        return UserError(
            f"'{error.filename}' can't be read or written ({error.strerror or error}): check its "
            "permissions and the free space."
        )
    return UserError(
        f"writing to '{folder.path}' failed ({error.strerror or error}): free some space or "
        "choose another folder with hydra.run.dir=FOLDER."
    )


def _is_within(name: object, folder: Path) -> bool:
    if not isinstance(name, str | Path):
        return False
    return Path(os.path.abspath(name)).is_relative_to(os.path.abspath(folder))


def is_out_of_memory(error: BaseException) -> bool:
    """Whether Python, torch's CPU allocator or CUDA ran out of memory."""
    import torch

    kinds = (MemoryError, torch.OutOfMemoryError)
    return isinstance(error, kinds) or "can't allocate memory" in str(error)


def out_of_memory(config: Config, error: BaseException) -> str:
    """One sentence for the user about a lack of memory, the machine's or a GPU's."""
    import torch

    views = "fewer or smaller views (views.count, views.resolution), "
    remedy = f"{'' if config.baseline else views}a mesh with fewer faces, or fewer runs at once"
    if isinstance(error, torch.OutOfMemoryError):
        asked = re.search(r"allocate ([\d.]+ \w+)", str(error))
        more = f" (failed to allocate {asked[1]})" if asked else ""
        return (
            f"there is not enough memory on the GPU for this run{more}: use {remedy} on it, or "
            "device=cpu."
        )
    asked = re.search(r"allocate (\d+) bytes", str(error))
    more = f" (failed to allocate {int(asked[1]) / 1e6:.0f} MB)" if asked else ""
    return f"there is not enough memory for this run{more}: use {remedy}."


def fail(folder: RunFolder, reason: str) -> None:
    """Record that the run failed, if the folder is this run's and can be written."""
    with suppress(OSError):  # report the error even if it can't be recorded
        if folder.begun:
            folder.write_status("failed", reason=reason)
