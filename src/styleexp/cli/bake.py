"""``styleexp-bake``: bake a run's displacement into textures of its source."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from styleexp.system import atomic
from styleexp.system.errors import UserError

DESCRIPTION = """\
Bake the displacement of a finished run into a height map and a tangent-space normal map (OpenGL,
green is up), using the texture coordinates of the unchanged source mesh. bake.json describes the
encoding of the height."""
FORMATS = ("png", "exr")
SIZES = (16, 16384)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, or 2 after printing a user error."""
    options = _parser().parse_args(arguments)
    try:
        for path in bake(options.folder, options.size, options.format, options.out):
            print(path)
    except UserError as error:
        print(f"styleexp-bake: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        where = f"'{error.filename}'" if error.filename else "the maps"
        print(f"styleexp-bake: {where} cannot be written ({error.strerror}).", file=sys.stderr)
        return 2
    return 0


def bake(folder: Path, size: int, kind: str, out: Path | None = None) -> list[Path]:
    """Bake a run's folder, into ``out`` or its subfolder ``bake``; return the files' paths."""
    if not folder.is_dir():
        raise UserError(f"there is no folder '{folder}': give a run's folder.")
    if not SIZES[0] <= size <= SIZES[1]:
        raise UserError(f"--size {size} is not allowed: give {SIZES[0]} to {SIZES[1]} pixels.")
    if kind == "exr":
        from importlib.util import find_spec

        if find_spec("OpenEXR") is None:
            raise UserError(
                "--format exr needs OpenEXR: pip install 'styleexp[exr]', or use --format png."
            )
    from styleexp.experiments.reports import shown
    from styleexp.runs import bake as baking

    source, vertices, displacement = shown.read_moved(folder)
    maps = baking.bake(source, displacement, vertices, size)
    if maps.overlap > 0.01:
        print(
            f"styleexp-bake: warning: {maps.overlap:.0%} of the texture is shared by several "
            "faces (mirrored, stacked or tiled islands) and keeps only the last face's relief. "
            "Unwrap without overlaps to keep all.",
            file=sys.stderr,
        )
    if source.carrier is not None and source.carrier.flipped.any():
        print(
            "styleexp-bake: warning: faces of the source's file point inwards, but the maps "
            "assume outward normals (in Blender: Mesh > Normals > Recalculate Outside).",
            file=sys.stderr,
        )
    target = out or folder / "bake"
    target.mkdir(parents=True, exist_ok=True)
    record = {"run": str(folder), "source": source.name, **baking.write(maps, target, kind)}
    atomic.write(target / "bake.json", atomic.text(json.dumps(record, indent=2) + "\n"))
    return [target / name for name in (f"height.{kind}", f"normal.{kind}", "bake.json")]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="styleexp-bake", description=DESCRIPTION)
    parser.add_argument("folder", type=Path, metavar="RUN_FOLDER", help="folder of a finished run")
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
