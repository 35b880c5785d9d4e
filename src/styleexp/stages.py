"""What a run is doing, for who waits before a terminal.

The parts say what they begin (`doing`), which costs nothing. The command line has it printed where
it takes long (`announced`).
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

FIRST = 1.5
"""Seconds after which a stage is named."""
AGAIN = 10.0
"""Seconds after which it is named again, with the time that it has taken."""

_stage: tuple[str, float] = ("", 0.0)
_listening = 0


def doing(what: str, at_once: bool = False) -> None:
    """Say what begins now, as in "reading the source"; nothing where ``what`` is empty.

    ``at_once``: for what Python's other threads can't run beside.
    """
    global _stage
    _stage = (what, time.monotonic())
    if at_once and _listening:
        print(f"{what} ...", flush=True)


def tell(what: str) -> None:
    """Say what was found, where somebody listens: a Python caller's terminal is its own."""
    if _listening:
        print(what, flush=True)


@contextmanager
def announced() -> Iterator[None]:
    """Have the stages of this process printed that take long."""
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
            with suppress(OSError):  # a reader that has gone is the run's own affair
                print(f"{what} ..." if due == FIRST else f"{what}: {seconds:.0f} s", flush=True)
            due = seconds + AGAIN
