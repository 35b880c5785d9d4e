"""Process-wide state: threads, and the global random number generators."""

from __future__ import annotations

import random
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import torch


def prepare(threads: int, seed: int) -> None:
    """Set torch's threads (0: all cores), its backends and the global generators for a run,
    independent of earlier state.

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
    torch.backends.cudnn.allow_tf32 = False
    torch.backends.cuda.matmul.allow_tf32 = False
    random.seed(seed)
    np.random.seed(seed % 2**32)
    torch.manual_seed(seed)


def gpu(device: torch.device) -> dict[str, Any]:
    """What a record or a cache says of a GPU: its name, and how `prepare` lets it compute. TF32,
    torch's default for fp32 convolutions, rounds like bf16: fp32 shall mean fp32. Empty for the
    CPU."""
    import torch

    if device.type != "cuda":
        return {}
    return {
        "name": torch.cuda.get_device_name(device),
        "tf32": {
            "convolutions": torch.backends.cudnn.allow_tf32,
            "products": torch.backends.cuda.matmul.allow_tf32,
        },
    }


def has_onednn(tensor: torch.Tensor) -> bool:
    """Whether oneDNN's own operators, which torch wouldn't call by itself, take this tensor: on a
    CPU, and with bfloat16 on none without AVX-512."""
    import torch

    if tensor.device.type != "cpu" or not torch.backends.mkldnn.is_available():
        return False
    return tensor.dtype != torch.bfloat16 or torch.ops.mkldnn._is_mkldnn_bf16_supported()


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
    convolutions, products = torch.backends.cudnn, torch.backends.cuda.matmul
    tf32 = convolutions.allow_tf32, products.allow_tf32

    def put_back_tf32() -> None:
        convolutions.allow_tf32, products.allow_tf32 = tf32

    python, numpys = random.getstate(), np.random.get_state()
    restore = [
        lambda: torch.set_num_threads(threads),
        lambda: torch.set_rng_state(drawn),
        put_back_tf32,
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
