"""Time of an optimisation step by part, and its distance from the lower bound."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import torch

from styleexp.config import build
from styleexp.config.compose import compose
from styleexp.encoders import VGG
from styleexp.experiments.bench.floor import Call, encoder_floor
from styleexp.experiments.bench.measuring import machine, peak_memory_mb
from styleexp.experiments.bench.parts import BACKWARD, GRAMS, NORMALS, OTHER, Parts, timed_stages
from styleexp.method.scene import PaperScene
from styleexp.runs.records import RunFolder
from styleexp.system.errors import UserError

FORWARD = (
    "field",
    "normals",
    "render",
    "image views",
    "encoder",
    "Gram matrices",
    "loss",
    "target",
    "optimiser",
    "logging",
)
PARTS = tuple(name + end for name in FORWARD for end in ("", BACKWARD))
"""Parts in the order of a step. Those without a backward pass are omitted from the output."""


class _Timed:
    """Proxy that times a callable as a part and forwards its attributes."""

    def __init__(self, clock: Parts, name: str, inner: Any) -> None:
        self._inner, self._call = inner, clock.timed(name, inner)

    def __call__(self, *given: Any) -> Any:
        return self._call(*given)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)


def measure(
    overrides: Sequence[str], steps: int, watch: Callable[[Any], object] = lambda step: None
) -> dict[str, Any]:
    """Time ``steps`` steps after two warm-up steps, with overrides as for ``styleexp``; ``watch``
    is called with each."""
    config = compose(overrides)
    if config.threads:
        torch.set_num_threads(config.threads)
    method, scene = build.prepare(config)
    state = method.start(scene)
    if state is None or not isinstance(scene, PaperScene):
        raise UserError("this method doesn't optimise a style loss: choose method=robust or paper.")
    config.optim.steps = max(config.optim.steps, steps + 2)
    device = scene.subject.surface.vertices.device

    clock, calls = Parts(device), _note_calls(scene.encoder)
    clock.wrap("field", state, "field")
    clock.wrap("render", scene.viewer.renderer, "render")
    clock.wrap("encoder", scene.loss, "encoder")
    if hasattr(scene.encoder, "gram_sums"):
        clock.wrap("encoder", scene.encoder, "gram_sums")
    for name in ("describe", "distance"):
        clock.wrap("loss", scene.loss, name)
    for name in ("step", "zero_grad"):
        clock.wrap("optimiser", state.optimizer, name)
    views, target = (
        _Timed(clock, "image views", scene.viewer),
        _Timed(clock, "target", scene.target),
    )
    timed = replace(scene, viewer=views, target=target)  # type: ignore[arg-type]

    rows: list[dict[str, tuple[float, float]]] = []
    with tempfile.TemporaryDirectory() as name, timed_stages(clock, [*NORMALS, *GRAMS]):
        folder = RunFolder(Path(name))
        loop = method.optimise(timed, state)
        log = clock.timed("logging", lambda step: _log(folder, step, state, config))

        def take(count: int) -> None:
            for _ in range(count):
                calls.clear()
                clock.begin()
                taken = next(loop)
                log(taken)
                rows.append(clock.end())
                watch(taken)

        take(2)
        peak = peak_memory_mb(lambda: take(steps), device)
    rows = rows[2:]
    return _summary(rows, scene, calls, config) | {"peak_memory_mb": peak}


def _log(folder: RunFolder, step: Any, state: Any, config: Any) -> None:
    """Log a step as a run does."""
    folder.append_metrics(step)
    if state.step % config.optim.checkpoint_every == 0:
        folder.save_checkpoint(state)


def _note_calls(encoder: Any) -> list[Call]:
    """Record each encoder call in the returned list."""
    calls: list[Call] = []

    def note(images: torch.Tensor, layers: Iterable[str]) -> None:
        calls.append((tuple(images.shape), tuple(layers), images.requires_grad))

    if isinstance(encoder, VGG):
        encoder.register_forward_pre_hook(lambda _, given: note(*given[:2]))
        sums = encoder.gram_sums

        def noted(images: torch.Tensor, masks: Any) -> Any:
            note(images, masks)
            return sums(images, masks)

        encoder.gram_sums = noted  # type: ignore[method-assign]
    return calls


def _summary(rows: list[Any], scene: PaperScene, calls: list[Call], config: Any) -> dict[str, Any]:
    names = [name for name in (*PARTS, OTHER) if any(name in row for row in rows)]
    names += sorted({name for row in rows for name in row} - set(names))
    wall, cpu = (
        {name: 1e3 * median(row.get(name, (0, 0))[i] for row in rows) for name in names}
        for i in (0, 1)
    )
    step_wall, step_cpu = (
        1e3 * median(sum(each[i] for each in row.values()) for row in rows) for i in (0, 1)
    )
    encoder = scene.encoder
    summary: dict[str, Any] = {
        "step_ms": step_wall,
        "step_cpu_ms": step_cpu,
        "parts_ms": wall,
        "parts_cpu_ms": cpu,
        "encoder_share": _share(wall, "encoder", step_wall),
        "encoder_share_cpu": _share(cpu, "encoder", step_cpu),
        "field_share": _share(wall, "field", step_wall),
        "field_share_cpu": _share(cpu, "field", step_cpu),
    }
    if isinstance(encoder, VGG) and calls and scene.subject.surface.vertices.device.type == "cpu":
        floor = encoder_floor(encoder, calls)
        spent = cpu["encoder"] + cpu.get(f"encoder{BACKWARD}", 0.0)
        summary |= {
            "encoder_over_floor": spent / (1e3 * floor.seconds),
            "encoder_over_convolutions": spent / (1e3 * floor.convolutions),
            "encoder_gflop": floor.flops / 1e9,
            "gflop_per_cpu_second": {k: v / 1e9 for k, v in floor.rates.items()},
        }
    return summary | {
        "vertices": len(scene.subject.surface.vertices),
        "faces": len(scene.subject.surface.faces),
        "views": [list(shape[:3:2]) for shape, _, _ in calls],
        "steps": len(rows),
        "encoder": config.encoder.name,
        "layers": list(getattr(scene.loss, "layers", ())),
        "dtype": getattr(encoder, "precision", "fp32"),
        "device": str(scene.subject.surface.vertices.device),
        "threads": torch.get_num_threads(),
        "machine": machine(),
    }


def _share(parts: dict[str, float], name: str, whole: float) -> float:
    return (parts.get(name, 0.0) + parts.get(f"{name}{BACKWARD}", 0.0)) / whole
