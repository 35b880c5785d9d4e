"""``styleexp-metrics``: measure results, and test the metrics themselves."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from styleexp.cli.answers import answer
from styleexp.cli.ending import ends_well
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from styleexp.experiments.metrics import Judge

TRUTH_SOURCES = ("sphere", "torus", "critter")
"""Sources of the truth board, all analytic."""
COLUMNS = ("rank1", "scale", "noise", "strength", "no_style", "imperfect", "turned")
SHOWN = (
    "source",
    "style",
    "match",
    "craft",
    "style_distance",
    "relief_distance",
    "looks_like",
    "silhouette_iou",
    "flipped_faces",
    "self_intersections",
    "status",
)


@ends_well
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, or 2 after printing a user error."""
    parser = _parser()
    return answer(parser, parser.parse_args(arguments))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="styleexp-metrics",
        description="Measure results: distance to the style, and preservation of the shape. "
        "docs/metrics.md explains each number and its reliability.",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    run = commands.add_parser("run", help="measure a finished run's result again")
    run.add_argument("folder", type=Path)
    run.set_defaults(function=_run, show=_show_one)

    compare = commands.add_parser("compare", help="measure any result, from any tool")
    compare.add_argument("result", type=Path, help="mesh file, in the source's frame")
    compare.add_argument("source", help="mesh file or name")
    compare.add_argument("style", help="mesh or image file, or name")
    compare.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="such as style.scale=2")
    compare.set_defaults(function=_compare, show=_show_one)

    board = commands.add_parser(
        "board", help="measure every run below a folder, and identify their styles"
    )
    board.add_argument("folder", type=Path)
    board.add_argument("--write", action="store_true", help="also rewrite each run's metrics.json")
    board.set_defaults(function=_board, show=_show_board)

    truth = commands.add_parser(
        "truth-board", help="test the metrics on results with a known style"
    )
    truth.add_argument("--sources", default=",".join(TRUTH_SOURCES), help="names, comma-separated")
    truth.add_argument(
        "--pictures",
        default="",
        metavar="NAMES",
        help="test these pictures instead of the mesh styles",
    )
    truth.add_argument(
        "--vertices", type=int, default=30_000, help="approximate number of vertices of each source"
    )
    truth.set_defaults(function=_truth, show=_show_truth)

    for command in (run, compare, board, truth):
        command.add_argument("--json", action="store_true", help="print everything as JSON")
        command.add_argument("--judge", default="auto", metavar="ENCODER", help=JUDGE_HELP)
        command.add_argument(
            "--windows", type=int, default=32, help="surface windows to compare (default: 32)"
        )
    return parser


JUDGE_HELP = "encoder used for judging (default: one that the run did not train with); none: skip "
"its metrics"


def _judge(options: argparse.Namespace, trained: str | None = None) -> Judge | None:
    from styleexp.encoders.options import judge_name
    from styleexp.experiments.metrics import load_judge

    if options.windows < 1:
        raise UserError(f"--windows {options.windows}: give 1 or more.")
    return load_judge(judge_name(options.judge, trained), options.windows)


def _run(options: argparse.Namespace) -> dict[str, Any]:
    from styleexp.experiments.metrics.board import measure_run
    from styleexp.runs import reading

    trained = reading.recorded(options.folder, "measure").config.get("encoder.name")
    return measure_run(options.folder, _judge(options, trained))


def _compare(options: argparse.Namespace) -> dict[str, Any]:
    from styleexp.api import configure
    from styleexp.config.sources import load_source, load_style
    from styleexp.experiments.metrics import measure
    from styleexp.experiments.metrics.board import read_result

    if not options.result.is_file():
        raise UserError(f"there is no file '{options.result}': give the result's mesh file.")
    config = configure(options.source, options.style, options.overrides)
    source, style = load_source(config.source), load_style(config.style)
    vertices, faces = read_result(options.result, source)
    return measure(config, source, style, vertices, faces, _judge(options))


def _board(options: argparse.Namespace) -> dict[str, Any]:
    from styleexp.experiments.metrics.board import measure_board

    judge = _judge(options)
    if judge is None:
        raise UserError(
            "--judge none: styles can't be identified without a judge; name an encoder."
        )
    return measure_board(options.folder, judge, options.write)


def _truth(options: argparse.Namespace) -> dict[str, Any]:
    from styleexp.config.sources import load_source, load_style
    from styleexp.experiments.metrics import truth
    from styleexp.inputs import meshes, shapes
    from styleexp.inputs.options import SourceConfig
    from styleexp.method.options import StyleConfig

    names = options.sources.split(",")
    sources = []
    for name in names:
        if name in shapes.SOURCES:
            sources.append(shapes.make(name, options.vertices))
        else:
            sources.append(meshes.remesh(load_source(SourceConfig(name=name)), options.vertices))
    judge = _judge(options)
    if judge is None:
        raise UserError("--judge none: the truth board tests a judge; name an encoder.")

    def report(what: str) -> None:
        print(what, file=sys.stderr, flush=True)

    styles, candidates = list(shapes.RELIEFS), truth.CANDIDATES
    if options.pictures:
        styles, candidates = options.pictures.split(","), truth.PICTURE_CANDIDATES
        pictures = {}
        for name in styles:
            found = load_style(StyleConfig(name=name))
            if found.picture is None:
                raise UserError(
                    f"--pictures: '{name}' is a mesh; omit the option to test all meshes."
                )
            pictures[name] = found.picture
        board = truth.measure_pictures(sources, pictures, judge.name, options.windows, report)
    else:
        board = truth.measure_board(sources, judge.name, options.windows, report)
    verdicts = truth.judge_metrics(board, candidates)
    return {
        "rank1": {name: verdict["rank1"] for name, verdict in verdicts.items()},
        "cases": len(names) * len(styles),
        "sources": names,
        "styles": styles,
        "judge": judge.name,
        "metrics": verdicts,
    }


def _show_one(found: dict[str, Any]) -> None:
    for name, value in found.items():
        print(f"{name:20s} {value:.4g}")


def _show_board(found: dict[str, Any]) -> None:
    _table(
        [*SHOWN],
        [[row.get(c, "") for c in SHOWN] for row in found["runs"]],
    )
    print(
        f"identified: {found['identification']} of {found['of']} among {found['styles']} styles; "
        f"silhouette IoU at least {found['min_silhouette_iou']:.3f}; flipped faces at most "
        f"{100 * found['max_flipped']:.2f} %"
    )


def _show_truth(found: dict[str, Any]) -> None:
    rows = [
        [
            name,
            *(f"{verdict[c]:.3f}" if c in verdict else "" for c in COLUMNS),
            "yes" if verdict["kept"] else "no",
        ]
        for name, verdict in found["metrics"].items()
    ]
    _table(["metric", *COLUMNS, "kept"], rows)
    print(f"fractions of {found['cases']} cases, judged by {found['judge']}")


def _table(columns: list[str], rows: list[list[Any]]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table()
    for column in columns:
        table.add_column(column.replace("_", " "))
    for row in rows:
        table.add_row(*(f"{c:.3g}" if isinstance(c, float) else str(c) for c in row))
    console = Console()
    if not console.is_terminal:
        console = Console(width=160)  # a log has no width
    console.print(table)
