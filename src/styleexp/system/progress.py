"""Progress messages: what a run is doing.

Parts announce what they begin (`doing`), which costs nothing. The command line prints the stages
that take long (`announced`).
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

FIRST = 1.5
"""Seconds after which a stage is named."""
AGAIN = 10.0
"""Seconds after which it is named again, with its elapsed time."""

_stage: tuple[str, float] = ("", 0.0)
_listening = 0


def doing(what: str, at_once: bool = False) -> None:
    """Announce a stage, such as "reading the source"; an empty ``what`` ends it.

    ``at_once``: print immediately, for calls that block Python's other threads.
    """
    global _stage
    _stage = (what, time.monotonic())
    if at_once and _listening:
        print(f"{what} ...", flush=True)


def stage() -> str:
    """The stage that was announced last, empty between stages."""
    return _stage[0]


def tell(what: str) -> None:
    """Print a finding on the command line; silent for Python callers."""
    if _listening:
        print(what, flush=True)


@contextmanager
def announced() -> Iterator[None]:
    """Print the stages of this process that take long."""
    global _listening
    ended = threading.Event()
    teller = threading.Thread(target=_tell, args=(ended,), daemon=True)
    _listening += 1
    teller.start()
    try:
        yield
    finally:
        doing("")
        _listening -= 1
        ended.set()


def _tell(ended: threading.Event) -> None:
    last, due = _stage, 0.0
    while not ended.wait(0.25):
        stage = what, begun = _stage
        if stage != last:
            last, due = stage, FIRST
        seconds = time.monotonic() - begun
        if what and seconds >= due:
            with suppress(OSError):  # the run itself handles a closed output
                print(f"{what} ..." if due == FIRST else f"{what}: {seconds:.0f} s", flush=True)
            due = seconds + AGAIN
