"""Clocks, peak memory, and a description of the machine.

Everything is timed twice. Wall time is what users experience, but includes other processes on a
shared machine. CPU time is the process's own: with one thread it varies less on a busy machine.
Ratios of interleaved measurements in one process are reliable on either.
"""

from __future__ import annotations

import os
import platform
import resource
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    import torch

K = TypeVar("K")
STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


@dataclass(frozen=True)
class Times:
    """Wall and CPU seconds of each repeat."""

    wall: list[float]
    cpu: list[float]

    @property
    def ms(self) -> float:
        """Median of the wall times, in milliseconds."""
        return 1e3 * median(self.wall)

    @property
    def cpu_ms(self) -> float:
        """Median of the CPU times, summed over threads, in milliseconds."""
        return 1e3 * median(self.cpu)


def interleaved(contenders: Mapping[K, Callable[[], object]], repeats: int) -> dict[K, Times]:
    """Run the contenders in turns, ``repeats`` times each, after one warm-up."""
    for run in contenders.values():
        run()
    times: dict[K, Times] = {name: Times([], []) for name in contenders}
    for _ in range(repeats):
        for name, run in contenders.items():
            wall, cpu = time.perf_counter(), time.process_time()
            run()
            times[name].wall.append(time.perf_counter() - wall)
            times[name].cpu.append(time.process_time() - cpu)
    return times


def ratio(slower: list[float], faster: list[float]) -> float:
    """Median of the ratios of interleaved repeats."""
    return median(a / b for a, b in zip(slower, faster, strict=True))


def peak_memory_mb(run: Callable[[], object], device: torch.device | None = None) -> float:
    """Peak memory during ``run``, in MB, including earlier allocations: a GPU's own that torch took
    for tensors, if ``device`` is one, else that of the process.

    Where the process's counter can't be reset (anywhere but Linux), the peak since it started.
    """
    if device is not None and device.type == "cuda":
        import torch

        torch.cuda.reset_peak_memory_stats(device)
        run()
        torch.cuda.synchronize(device)
        return torch.cuda.max_memory_allocated(device) / 2**20
    anew = os.access(CLEAR, os.W_OK)
    if anew:
        CLEAR.write_text("5")
    run()
    if anew:
        peak = next(x for x in STATUS.read_text().splitlines() if x.startswith("VmHWM"))
        return int(peak.split()[1]) / 1024
    unit = 1 if platform.system() == "Darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20


def machine() -> dict[str, Any]:
    """Description of the machine, for comparing numbers."""
    import torch

    gpus = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "amx": torch.cpu._is_amx_tile_supported(),
        "avx512_bf16": torch.cpu._is_avx512_bf16_supported(),
        "gpus": gpus,
        "load": round(os.getloadavg()[0], 1),
        "system": platform.platform(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "threads": torch.get_num_threads(),
        "omp_wait_policy": os.environ.get("OMP_WAIT_POLICY"),
        "gomp_spincount": os.environ.get("GOMP_SPINCOUNT"),
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()
