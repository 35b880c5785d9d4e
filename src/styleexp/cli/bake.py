"""``styleexp-bake``: bake a run's result into textures of its source, or of another mesh."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from styleexp.cli.ending import ends_well
from styleexp.system import atomic
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from styleexp.inputs.meshes import Mesh
    from styleexp.runs import bake as baking

DESCRIPTION = """\
Bake a finished run's result into maps for the mesh that it was made from, or another one in the
same place: height, tangent-space normals (OpenGL, green is up), ambient occlusion and curvature;
and result_low.glb, that mesh with its maps. bake.json describes their encoding. A source that was
not refined gets height and normals only, without --onto."""
FORMATS = ("png", "exr")
SIZES = (16, 16384)
MOST_ONTO = 8192
"""Largest side of maps of another mesh, which take 5 GB of memory."""
SOURCE = "source"
"""Value of ``--onto`` for the run's own source."""


@ends_well
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, or 2 after printing a user error."""
    options = _parser().parse_args(arguments)
    try:
        for path in bake(options):
            print(path)
    except UserError as error:
        print(f"styleexp-bake: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        raise
    except OSError as error:
        where = f"'{error.filename}'" if error.filename else "the maps"
        print(f"styleexp-bake: {where} cannot be written ({error.strerror}).", file=sys.stderr)
        return 2
    return 0


def bake(options: argparse.Namespace) -> list[Path]:
    """Bake a run's folder, into ``out`` or its subfolder ``bake``; return the files' paths."""
    _check(options)
    from styleexp.experiments.reports import shown
    from styleexp.runs import bake as baking

    folder, onto = options.folder, options.onto
    if onto is None and (options.cage is not None or options.unwrap):
        onto = SOURCE
    low: baking.Low | None = None
    if onto is None:
        try:
            source, vertices, displacement = shown.read_moved(folder)
            if baking.has_coordinates(source):
                maps = baking.bake(source, displacement, vertices, options.size)
            else:
                onto = SOURCE
        except shown.OtherVertices:
            onto = SOURCE
    if onto is not None:
        source, maps, low = _onto(options, onto)
    for warning in baking.warnings(source, maps):
        _note(f"warning: {warning}")
    target = options.out or folder / "bake"
    target.mkdir(parents=True, exist_ok=True)
    record = {"run": str(folder), "source" if onto in (None, SOURCE) else "mesh": source.name}
    if onto is not None:
        record["onto"] = onto
    told = baking.write(maps, target, options.format)
    written = [target / part["file"] for part in told.values() if isinstance(part, dict)]
    if low is not None:
        written.append(target / "result_low.glb")
        atomic.write(written[-1], atomic.data(baking.glb(low, maps)))
    atomic.write(target / "bake.json", atomic.text(json.dumps(record | told, indent=2) + "\n"))
    return [*written, target / "bake.json"]


def _check(options: argparse.Namespace) -> None:
    """Raise `UserError` for what can be told from the options alone."""
    if not options.folder.is_dir():
        raise UserError(f"there is no folder '{options.folder}': give a run's folder.")
    _check_size(options.size, SIZES[1])
    if options.cage is not None and not (options.cage > 0 and math.isfinite(options.cage)):
        raise UserError(
            f"--cage {options.cage} is not allowed: give a distance above 0, in the mesh's units."
        )
    if options.format == "exr" and find_spec("OpenEXR") is None:
        raise UserError(
            "--format exr needs OpenEXR: pip install 'styleexp[exr]', or use --format png."
        )


def _check_size(size: int, most: int) -> None:
    if not SIZES[0] <= size <= most:
        raise UserError(f"--size {size} is not allowed: give {SIZES[0]} to {most} pixels.")


def _onto(options: argparse.Namespace, onto: str) -> tuple[Mesh, baking.Maps, baking.Low]:
    """The mesh to bake to, its maps, and the mesh as it was baked to."""
    from styleexp.inputs.meshes import from_arrays, load_mesh
    from styleexp.runs import bake as baking
    from styleexp.runs import origins, reading, results

    _check_size(options.size, MOST_ONTO)
    baking.check_rays()
    path = options.folder / results.NAME
    run = reading.recorded(options.folder, "bake")
    if not path.is_file():
        raise UserError(f"'{options.folder}' has no result.ply: give the folder of a finished run.")
    mesh = origins.source(run) if onto == SOURCE else load_mesh(onto)
    stored = results.read(path)
    try:
        detail = from_arrays(stored.vertices, stored.faces)
    except UserError as error:
        raise UserError(f"'{path}' {error}") from None
    low, maps, notes = baking.baked(mesh, detail, options.size, options.cage, options.unwrap)
    for note in notes:
        _note(note)
    return low.mesh, maps, low


def _note(what: str) -> None:
    print(f"styleexp-bake: {what}", file=sys.stderr)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="styleexp-bake", description=DESCRIPTION)
    parser.add_argument("folder", type=Path, metavar="RUN_FOLDER", help="folder of a finished run")
    parser.add_argument(
        "--onto",
        metavar="source|FILE",
        help="the mesh to bake to: the one that the run was made from, as it was before it was "
        "refined (default), or a file in the same place and units; needs the extra bake",
    )
    parser.add_argument(
        "--cage",
        type=float,
        metavar="DISTANCE",
        help="how far from the mesh the result is looked for, in the mesh's units (default: from "
        "the distance between both)",
    )
    parser.add_argument(
        "--unwrap",
        action="store_true",
        help="make new texture coordinates (otherwise only for a mesh that has none)",
    )
    parser.add_argument("--size", type=int, default=2048, help="side in pixels (default: 2048)")
    parser.add_argument(
        "--format",
        choices=FORMATS,
        default="png",
        help="png: 16 bits per channel; exr: 32-bit floats, unscaled displacement (needs the "
        "extra exr)",
    )
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="RUN_FOLDER/bake")
    return parser


if __name__ == "__main__":
    sys.exit(main())
