"""Measurements of styles, kept in the user's cache for the next run with the same style.

A measurement is found again only if everything that its last bit depends on is the same: what was
measured, the options, this package's code, the versions of the packages that compute, the kind of
processor and the number of threads. What can't be read is measured anew; if the cache can't be
written, nothing is kept.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import logging
import os
import platform
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from styleexp.inputs import assets
from styleexp.system import atomic, digests

if TYPE_CHECKING:
    from torch import Tensor

Arrays = dict[str, np.ndarray]
MOST_BYTES = 1 << 30
"""Size of all that is kept, above which what was used longest ago goes."""
COMPUTING = ("numpy", "scipy", "torch", "gpytoolbox")
VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

log = logging.getLogger(__name__)
_anew = False


@contextmanager
def anew() -> Iterator[None]:
    """Within it nothing kept is used: to find out whether measuring again gives the same."""
    global _anew
    before, _anew = _anew, True
    try:
        yield
    finally:
        _anew = before


def kept(
    kind: str, given: Mapping[str, np.ndarray | Tensor], about: str, make: Callable[[], Arrays]
) -> Arrays:
    """What ``make`` measures on the arrays ``given`` with the options ``about``, from the cache if
    it is there."""
    if _anew:
        return _laid_out(make())
    key = digests.of(given, f"{kind} {about} {_circumstances()}")
    path = folder() / f"{kind}-{key[:32]}.safetensors"
    if (found := _read(path, key)) is not None:
        with suppress(OSError):
            os.utime(path)
        return found
    made = _laid_out(make())
    try:
        _write(path, made, key)
    except OSError as error:
        log.info("%s can't be kept: %s", path, error)
    return made


def folder() -> Path:
    """Where measurements are kept."""
    return assets.cache_dir() / "measured"


def _circumstances() -> str:
    import torch

    threads = [os.environ.get(name, "") for name in VARIABLES]
    processor = platform.machine(), torch.backends.cpu.get_cpu_capability()
    return f"{_code()} {processor} {threads} {torch.get_num_threads()}"


@cache
def _code() -> str:
    """Hash of this package's code and of the versions of what it computes with."""
    import styleexp

    root = Path(styleexp.__file__).parent
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    for name in COMPUTING:
        digest.update(f"{name} {importlib.metadata.version(name)}".encode())
    return digest.hexdigest()


def _laid_out(made: Arrays) -> Arrays:
    """In memory as they are after reading: sums over other layouts may differ in the last bit."""
    return {name: np.ascontiguousarray(each) for name, each in made.items()}


def _read(path: Path, key: str) -> Arrays | None:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="np") as opened:
            about: dict[str, Any] = opened.metadata() or {}
            found = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    except (OSError, SafetensorError, ValueError):
        return None
    whole = about.get("key") == key and about.get("digest") == digests.of(found, key)
    return found if whole else None


def _write(path: Path, made: Arrays, key: str) -> None:
    from safetensors.numpy import save

    content = save(made, {"key": key, "digest": digests.of(made, key)})
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic.sweep(path.parent, seconds=atomic.A_DAY)
    atomic.write(path, atomic.data(content))
    _prune(path.parent)


def _prune(where: Path) -> None:
    """Remove what was used longest ago, down to `MOST_BYTES`."""
    known = []
    for path in where.glob("*.safetensors"):
        with suppress(OSError):  # another process may have removed it
            known.append((path.stat().st_mtime, path.stat().st_size, path))
    total = 0
    for _, size, path in sorted(known, reverse=True):
        total += size
        if total > MOST_BYTES:
            with suppress(OSError):
                path.unlink()
