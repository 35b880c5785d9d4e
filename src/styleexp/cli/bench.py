"""``styleexp-bench``: benchmarks and profiles."""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from styleexp.cli.answers import answer
from styleexp.cli.ending import ends_well
from styleexp.system.errors import UserError

FACES = "5000, 20000, 80000, 320000, 1280000"


@ends_well
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, or 2 after printing a user error."""
    parser = _parser()
    return answer(parser, parser.parse_args(arguments))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="styleexp-bench",
        description="Benchmarks and profiles. Times are medians. CPU times are the process's "
        "own; with one thread they are valid even on a busy machine. Results: docs/benchmarks.md.",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    render = commands.add_parser(
        "render",
        help="time a render and its gradient, against other renderers",
        description="Forward and backward, including gradients of outlines, interleaved with the "
        "peers. Comma-separated values give one row per combination.",
    )
    render.add_argument(
        "--faces", type=_numbers, default=[20_000], help=f"number of faces, e.g. {FACES}"
    )
    render.add_argument("--views", type=_numbers, default=[5])
    render.add_argument(
        "--resolution", type=_numbers, default=[250], help="side of the image in pixels"
    )
    render.add_argument("--renderer", default="soft_raster", help="ours (soft_raster)")
    render.add_argument(
        "--peer",
        action="append",
        default=[],
        metavar="NAME",
        help="deodr, or the name of another built-in renderer; repeatable",
    )
    render.add_argument("--mesh", default="bubble", help="analytic shape (default: bubble)")
    render.add_argument("--repeats", type=int, default=7)
    render.add_argument("--threads", type=int, default=1, help="CPU threads of torch (default: 1)")
    render.add_argument("--device", default="cpu", help="cpu, cuda, or both (cpu,cuda)")
    render.set_defaults(function=_render, show=_show_rows)

    step = commands.add_parser(
        "step",
        help="profile an optimisation step by part",
        description="Takes the overrides of styleexp: styleexp-bench step method=robust "
        "source=critter style=bubble profile=full threads=1.",
    )
    step.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="as for styleexp")
    step.add_argument("--steps", type=int, default=10)
    step.set_defaults(function=_step, show=_show_step)

    convergence = commands.add_parser(
        "convergence",
        help="plot style distance over time, for several methods",
        description="Runs each method, stops the clock at points spread over the run, and "
        "measures the intermediate result.",
    )
    convergence.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="as for styleexp")
    convergence.add_argument("--methods", default="paper,robust", help="paper,robust")
    convergence.add_argument(
        "--points", type=int, default=8, help="measurements per run (default: 8)"
    )
    convergence.add_argument(
        "--out", type=Path, help="PNG to draw; its numbers are written next to it"
    )
    convergence.add_argument(
        "--redraw",
        type=Path,
        metavar="JSON",
        help="redraw an earlier measurement without running anything",
    )
    convergence.set_defaults(function=_convergence, show=_show_convergence)

    for command in (render, step, convergence):
        command.add_argument("--json", action="store_true", help="print everything as JSON")
    return parser


def _numbers(text: str) -> list[int]:
    numbers = [int(each) for each in text.split(",")]
    if min(numbers) < 1:
        raise ValueError(text)
    return numbers


def _render(options: argparse.Namespace) -> dict[str, Any]:
    import torch

    from styleexp.config.build import choose_device
    from styleexp.experiments.bench import render
    from styleexp.experiments.bench.measuring import machine

    if options.repeats < 1 or options.threads < 1:
        raise UserError("--repeats and --threads: give 1 or more.")
    torch.set_num_threads(options.threads)
    devices = [choose_device(name) for name in options.device.split(",")]
    sizes = list(itertools.product(options.faces, options.views, options.resolution))
    names = [options.renderer, *options.peer]
    if len(set(names)) < len(names):
        raise UserError(f"--peer {options.peer[-1]}: name each renderer once.")
    rows = []
    for row in render.sweep(options.mesh, sizes, names, devices, options.repeats):
        rows.append(row)
        if not options.json or len(sizes) > 1:
            print(_line(row), file=sys.stderr, flush=True)
    return {**(rows[0] if len(rows) == 1 else {"rows": rows}), "machine": machine()}


def _line(row: dict[str, Any]) -> str:
    line = (
        f"{row['faces']} faces, {row['views']} views, {row['resolution']} px, {row['device']}: "
        f"{row['ours_ms']:.0f} ms, CPU {row['ours_cpu_ms']:.0f}"
    )
    for peer in row.get("peers", [row] if "peer" in row else []):
        line += f"; {peer['peer']} {peer['peer_ms']:.0f} ms, CPU {peer['peer_cpu_ms']:.0f}"
        line += f", ratio {peer['ratio']:.2f}, by CPU time {peer['ratio_cpu']:.2f}"
    return line


def _step(options: argparse.Namespace) -> dict[str, Any]:
    from styleexp.experiments.bench import step

    if options.steps < 1:
        raise UserError("--steps: give 1 or more.")
    return step.measure(_checked(options.overrides), options.steps)


def _convergence(options: argparse.Namespace) -> dict[str, Any]:
    from styleexp.experiments.bench import convergence

    if options.redraw is not None:
        return convergence.redraw(options.redraw, options.out or options.redraw.with_suffix(".png"))
    if options.points < 1:
        raise UserError("--points: give 1 or more.")
    out = options.out or Path("convergence.png")
    methods = options.methods.split(",")
    return convergence.measure(_checked(options.overrides), methods, options.points, out)


def _checked(overrides: list[str]) -> list[str]:
    """Return the overrides if Hydra accepts them; else raise its error as one sentence."""
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    from styleexp.config.compose import compose
    from styleexp.config.explain import explain

    try:
        compose(overrides)
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(explain(error)) from error
    return overrides


def _show_rows(found: dict[str, Any]) -> None:
    row = found.get("rows", [found])[0]
    for name, value in row.get("parts_cpu_ms", {}).items():
        print(f"  {name:22s} {value:8.1f} ms of CPU time")


def _show_step(found: dict[str, Any]) -> None:
    print(f"{'part':22s} {'wall ms':>9s} {'CPU ms':>9s} {'share':>7s}")
    for name, wall in found["parts_ms"].items():
        cpu = found["parts_cpu_ms"][name]
        print(f"{name:22s} {wall:9.1f} {cpu:9.1f} {cpu / found['step_cpu_ms']:7.1%}")
    print(f"{'step':22s} {found['step_ms']:9.1f} {found['step_cpu_ms']:9.1f}")
    print(
        f"encoder {found['encoder_share_cpu']:.1%} of a step, "
        f"field {found['field_share_cpu']:.1%}; {found['dtype']}, "
        f"{found['threads']} threads, {found['device']}, {found['peak_memory_mb']:.0f} MB"
    )
    if "encoder_over_floor" in found:
        rates = found["gflop_per_cpu_second"]
        print(
            f"encoder {found['encoder_gflop']:.0f} GFLOP a step: "
            f"{found['encoder_over_convolutions']:.2f} x its convolutions alone, "
            f"{found['encoder_over_floor']:.2f} x their arithmetic at the best rate "
            f"(product {rates['product']:.0f}, convolution {rates['convolution']:.0f} GFLOP/s)"
        )


def _show_convergence(found: dict[str, Any]) -> None:
    for method, points in found["methods"].items():
        for point in points:
            print(
                f"{method:8s} step {point['step']:5d}  {point['seconds']:7.1f} s  CPU "
                f"{point['cpu_seconds']:7.1f} s  style distance {point['style_distance']:.3f}"
            )
    print(found["figure"])


if __name__ == "__main__":
    sys.exit(main())
