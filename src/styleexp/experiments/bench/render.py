"""Benchmark a render and its gradient, for built-in and third-party renderers, interleaved in one
process."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from styleexp.experiments.bench import peers
from styleexp.experiments.bench.measuring import Times, interleaved, peak_memory_mb, ratio
from styleexp.experiments.bench.parts import STAGES, Parts, timed_stages
from styleexp.experiments.bench.task import Contender, Rendered, Task, make_task
from styleexp.plugins import build, find

if TYPE_CHECKING:
    from styleexp.renderers.base import Renderer


def ours(task: Task, name: str, device: torch.device) -> Contender:
    """A built-in backend, forward and backward."""
    renderer: Renderer = build("renderer", find("renderer", name).spec.config(name=name))
    if device.type not in renderer.capabilities.devices:
        device = torch.device("cpu")
    vertices = task.vertices.to(device, copy=True).requires_grad_()
    faces, weights = task.faces.to(device), task.weights.to(device)

    def run() -> Rendered:
        vertices.grad = None
        size = (task.resolution, task.resolution)
        out = renderer.render(vertices, faces, task.cameras, task.shading, size)
        grey = out.image[..., 0] if out.image.shape[-1] == 1 else out.image.mean(-1)
        grey.backward(weights)
        assert vertices.grad is not None
        return Rendered(grey.detach().cpu().numpy(), vertices.grad.cpu().numpy())

    return run


def measure(task: Task, names: Sequence[str], device: torch.device, repeats: int) -> dict[str, Any]:
    """Time ``names`` and compare the others with the first."""
    contenders = {
        name: peers.PEERS[name](task) if name in peers.PEERS else ours(task, name, device)
        for name in names
    }
    memory = {name: peak_memory_mb(run, device) for name, run in contenders.items()}
    seen = {name: run() for name, run in contenders.items()}
    times = interleaved(contenders, repeats)
    first = names[0]
    row: dict[str, Any] = {
        "renderer": first,
        "device": str(device),
        "faces": len(task.faces),
        "views": len(task.cameras),
        "resolution": task.resolution,
        "coverage": float((seen[first].image != task.shading.background).mean()),
        **_times("ours", times[first]),
        "peak_memory_mb": memory[first],
    }
    for name in names[1:]:
        compared = {
            "peer": name,
            **_times("peer", times[name]),
            "ratio": ratio(times[name].wall, times[first].wall),
            "ratio_cpu": ratio(times[name].cpu, times[first].cpu),
            "peer_peak_memory_mb": memory[name],
            "image_difference": float(np.abs(seen[name].image - seen[first].image).mean()),
            "gradient_cosine": _cosine(seen[name].gradient, seen[first].gradient),
        }
        if len(names) == 2:
            row |= compared
        else:
            row.setdefault("peers", []).append(compared)
    if first == "soft_raster":
        row["parts_cpu_ms"] = parts(task, device, repeats)
    return row


def sweep(
    mesh: str,
    sizes: Sequence[tuple[int, int, int]],
    names: Sequence[str],
    devices: Sequence[torch.device],
    repeats: int,
) -> Iterator[dict[str, Any]]:
    """Benchmark every combination; one row per (faces, views, resolution) and device."""
    task, made = None, None
    for faces, views, resolution in sizes:
        if made != (faces, views, resolution):
            task, made = make_task(mesh, faces, views, resolution), (faces, views, resolution)
        assert task is not None
        for device in devices:
            yield measure(task, names, device, repeats)


def parts(task: Task, device: torch.device, repeats: int) -> dict[str, float]:
    """CPU milliseconds of a render's parts: medians, which needn't sum exactly to the total."""
    clock = Parts(device)
    run = ours(task, "soft_raster", device)
    rows = []
    with timed_stages(clock, STAGES):
        run()
        for _ in range(repeats):
            clock.begin()
            run()
            rows.append(clock.end())
    names = {name for row in rows for name in row}
    medians = {n: float(np.median([row[n][1] if n in row else 0.0 for row in rows])) for n in names}
    return {name: 1e3 * medians[name] for name in sorted(medians, key=lambda n: -medians[n])}


def _times(whose: str, times: Times) -> dict[str, float]:
    return {f"{whose}_ms": times.ms, f"{whose}_cpu_ms": times.cpu_ms}


def _cosine(a: np.ndarray, b: np.ndarray) -> float:
    return float((a * b).sum() / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-30))
