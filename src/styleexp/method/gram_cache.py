"""Cache of target Gram matrices, so that a run similar to an earlier one starts sooner.

Measuring the style and the source takes as long as a dozen steps, and most runs of a study share
it. Cache files are keyed by a digest of the inputs: meshes, options, weights, this package's code,
torch's version, threads, the processor's instructions. On a CPU cached values are those that would
be computed, bit for bit. If a file is missing or unreadable, the values are computed.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from styleexp.inputs import assets
from styleexp.system import atomic, digests, process
from styleexp.system.transfer import to_host

if TYPE_CHECKING:
    from torch import Tensor

    from styleexp.encoders.base import Encoder
    from styleexp.method.losses import Statistics

KEPT = 40
"""Maximum number of files, about 5 MB each; the least recently used are evicted."""


@dataclass(frozen=True)
class GramCache:
    """Remembers what `losses.GramLoss` says of a bank of views."""

    options: tuple[object, ...]
    """Options of everything involved, distinguished by ``repr``."""
    encoder: Encoder

    def __call__(
        self, about: list[object], make: Callable[[], tuple[Statistics, Statistics]]
    ) -> tuple[Statistics, Statistics]:
        """Return ``make()``, cached on disk. ``about`` holds its other inputs: tensors, or objects
        that ``repr`` distinguishes."""
        path = assets.cache_dir() / "grams" / f"{self._digest(about)}.safetensors"
        found = _read(path, self.encoder)
        if found is None:
            found = make()
            _write(path, found)
        return found

    @cached_property
    def _weights(self) -> str:
        weights = self.encoder.state_dict()
        return digests.of(dict(zip(weights, to_host(list(weights.values())), strict=True)))

    def _digest(self, about: list[object]) -> str:
        digest = hashlib.sha256(_code())
        known = [*self.options, torch.__version__, torch.get_num_threads()]
        known += [torch.backends.cpu.get_cpu_capability(), self.encoder.precision]
        known.append(process.gpu(next(self.encoder.parameters()).device))
        items = [*known, *about, self._weights]
        values = iter(to_host([item for item in items if isinstance(item, torch.Tensor)]))
        for item in items:
            if isinstance(item, torch.Tensor):
                digest.update(f"{item.device} {item.dtype} {tuple(item.shape)}".encode())
                digest.update(next(values).flatten().view(torch.uint8).numpy().data)
            else:
                digest.update(f"{item!r};".encode())
        return digest.hexdigest()[:32]


def uncached(
    about: list[object], make: Callable[[], tuple[Statistics, Statistics]]
) -> tuple[Statistics, Statistics]:
    """Return ``make()``: for parts whose code can't be hashed, such as plugins'."""
    return make()


@cache
def _code() -> bytes:
    """Digest of all modules of the package; a list of the relevant ones would need maintenance."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.digest()


def _read(path: Path, encoder: Encoder) -> tuple[Statistics, Statistics] | None:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as opened:
            digest = opened.metadata()["digest"]
            tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    except (OSError, SafetensorError, KeyError, TypeError):
        return None
    if digests.of(tensors) != digest:
        return None
    with suppress(OSError):  # read-only cache
        os.utime(path)
    device = next(encoder.parameters()).device
    ordered = [(name, tensors[name].to(device, non_blocking=True)) for name in sorted(tensors)]
    whole, local = ([t for n, t in ordered if n.startswith(k)] for k in ("global", "local"))
    return whole, local


def _write(path: Path, found: tuple[Statistics, Statistics]) -> None:
    from safetensors.torch import save

    tensors: dict[str, Tensor] = {}
    for kind, each in zip(("global", "local"), found, strict=True):
        tensors |= {f"{kind}.{i:02d}": gram for i, gram in enumerate(each)}
    tensors = dict(zip(tensors, to_host(list(tensors.values())), strict=True))
    content = save(tensors, {"digest": digests.of(tensors)})
    with suppress(OSError):  # the cache is optional
        path.parent.mkdir(parents=True, exist_ok=True)
        atomic.sweep(path.parent, seconds=atomic.A_DAY)
        atomic.write(path, atomic.data(content))
        files = sorted(path.parent.glob("[!.]*.safetensors"), key=lambda p: p.stat().st_mtime)
        for old in files[:-KEPT]:
            old.unlink(missing_ok=True)
