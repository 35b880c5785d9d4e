"""Style distance over time, for several methods.

Training losses of different methods can't be compared, so each method's current result is measured
with the metric for finished runs, with the clock stopped. Seconds include everything before the
first step: loading meshes and encoder, and measuring targets.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from styleexp.config.schema import Config

Point = dict[str, float]


def measure(overrides: Sequence[str], methods: Sequence[str], points: int, out: Path) -> dict:
    """Run every method with these overrides; draw ``out`` and write its numbers next to it."""
    import torch

    from styleexp.config.compose import compose
    from styleexp.experiments.bench.measuring import machine

    if not out.parent.is_dir():
        raise UserError(f"cannot write '{out.name}': there is no folder '{out.parent}'.")
    if any(each.startswith("method=") for each in overrides):
        raise UserError("name the methods with --methods, not with method=.")
    if len(set(methods)) < len(methods):
        raise UserError(f"--methods {','.join(methods)}: name each method once.")
    configs = {name: compose([*overrides, f"method={name}"]) for name in methods}
    found: dict[str, Any] = {"overrides": list(overrides), "methods": {}}
    for name, config in configs.items():
        if config.threads:
            torch.set_num_threads(config.threads)
        found["methods"][name] = run(config, points)
    found["machine"] = machine()
    numbers = out.with_suffix(".json")
    numbers.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    return found | _drawn(found, out)


def run(config: Config, points: int) -> list[Point]:
    """Run once and measure before the first step and at ``points`` steps, denser at the
    beginning."""
    from styleexp.config import build
    from styleexp.encoders.options import judge_name
    from styleexp.experiments import metrics

    name = judge_name(config.metrics.judge, config.encoder.name)
    judge = metrics.load_judge(name, config.metrics.windows)
    if judge is None:
        raise UserError("metrics.judge=none leaves out the style distance: name an encoder.")
    total = config.optim.steps
    # Twice as dense at the beginning, where the distance falls fastest.
    stops = {round(total * (k / points) ** 1.5) for k in range(points + 1)} - {0} | {total}
    wall, cpu = time.perf_counter(), time.process_time()
    method, scene = build.prepare(config)
    state = method.start(scene)
    if state is None:
        raise UserError("a method without steps has no curve: choose another in --methods.")
    seconds, cpu_seconds = time.perf_counter() - wall, time.process_time() - cpu

    measured: list[Point] = []

    def note() -> None:
        result = method.finish(scene, state)
        source, style = result.subject.source, result.subject.style
        values = metrics.measure(config, source, style, result.vertices, source.faces, judge)
        kept = ("style_distance", "relief_distance", "silhouette_iou")
        times = {"step": state.step, "seconds": seconds, "cpu_seconds": cpu_seconds}
        measured.append(times | {k: values[k] for k in kept if k in values})

    note()
    wall, cpu = time.perf_counter(), time.process_time()
    for step in method.optimise(scene, state):
        if step.step in stops:
            seconds += time.perf_counter() - wall
            cpu_seconds += time.process_time() - cpu
            note()
            wall, cpu = time.perf_counter(), time.process_time()
    return measured


def redraw(numbers: Path, out: Path) -> dict[str, Any]:
    """Redraw an earlier measurement."""
    try:
        found = json.loads(numbers.read_text(encoding="utf-8"))
        return found | _drawn(found, out)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(
            f"'{numbers}' can't be drawn ({error}): give the JSON file that --out wrote."
        ) from error


def _drawn(found: dict[str, Any], out: Path) -> dict[str, str]:
    try:
        import matplotlib
    except ImportError:
        raise UserError("drawing needs matplotlib: pip install 'styleexp[report]'.") from None
    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(6.4, 4), layout="constrained")
    one_thread = found["machine"]["threads"] == 1
    clock = "cpu_seconds" if one_thread else "seconds"
    for name, points in found["methods"].items():
        xs, ys = [p[clock] for p in points], [p["style_distance"] for p in points]
        axes.plot(xs, ys, marker="o", label=name)
    axes.set_xlabel("CPU seconds, one thread" if one_thread else "seconds")
    axes.set_ylabel("style distance (0: the style itself)")
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
    axes.legend(title="method")
    figure.savefig(out, dpi=110)
    pyplot.close(figure)
    return {"figure": str(out)}
