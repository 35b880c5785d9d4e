"""Process-wide state: threads, and the global random number generators."""

from __future__ import annotations

import random
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache


def prepare(threads: int, seed: int) -> None:
    """Set torch's threads (0: all cores) and the global generators for a run, independent of
    earlier state.

    Built-in parts use their own generators; plugins may not. Mitsuba's variant is set in every call
    of its renderer.
    """
    import numpy as np
    import torch

    default = _default_threads()  # read before it changes
    threads = threads or default
    torch.set_num_threads(threads)
    if "drjit" in sys.modules:
        sys.modules["drjit"].set_thread_count(threads)
    random.seed(seed)
    np.random.seed(seed % 2**32)
    torch.manual_seed(seed)


@cache
def _default_threads() -> int:
    import torch

    return torch.get_num_threads()


_LOCK = threading.Lock()
_guests = 0
_restore: list[Callable[[], None]] = []


@contextmanager
def undisturbed(threads: int, seed: int) -> Iterator[None]:
    """`prepare`, and restore everything on exit.

    With concurrent threads, the last one to exit restores the state that the first one saved.
    """
    global _guests, _restore
    with _LOCK:
        if _guests == 0:
            _restore = _kept()
        _guests += 1
        prepare(threads, seed)
    try:
        yield
    finally:
        with _LOCK:
            _guests -= 1
            if _guests == 0:
                for put_back in _restore:
                    put_back()


def _kept() -> list[Callable[[], None]]:
    """Functions that restore the current state."""
    import numpy as np
    import torch

    threads, drawn = torch.get_num_threads(), torch.get_rng_state()
    python, numpys = random.getstate(), np.random.get_state()
    restore = [
        lambda: torch.set_num_threads(threads),
        lambda: torch.set_rng_state(drawn),
        lambda: random.setstate(python),
        lambda: np.random.set_state(numpys),
    ]
    if torch.cuda.is_available():
        on_gpus = torch.cuda.get_rng_state_all()
        restore.append(lambda: torch.cuda.set_rng_state_all(on_gpus))
    if "drjit" in sys.modules:
        count = sys.modules["drjit"].thread_count()
        restore.append(lambda: sys.modules["drjit"].set_thread_count(count))
    return restore
