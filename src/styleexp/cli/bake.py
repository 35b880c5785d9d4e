"""``styleexp-bake``: a run's displacement as textures of its source."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from styleexp import atomic
from styleexp.errors import UserError

DESCRIPTION = """\
Bake the displacement of a finished run to the texture coordinates of its source: a height map and a
tangent-space normal map (OpenGL, green is up), for the source mesh as it was. bake.json says how to
read the height."""
FORMATS = ("png", "exr")
SIZES = (16, 16384)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, or 2 after printing what the user can mend."""
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
    """Bake a run's folder, into ``out`` or its ``bake``; returns the files' paths."""
    if not folder.is_dir():
        raise UserError(f"there is no folder '{folder}': give a run's.")
    if not SIZES[0] <= size <= SIZES[1]:
        raise UserError(f"--size {size} is not allowed: give {SIZES[0]} to {SIZES[1]} pixels.")
    if kind == "exr":
        from importlib.util import find_spec

        if find_spec("OpenEXR") is None:
            raise UserError(
                "--format exr needs OpenEXR: pip install 'styleexp[exr]', or take --format png."
            )
    from styleexp import bake as baking
    from styleexp.reports import shown

    source, vertices, displacement = shown.read_moved(folder)
    maps = baking.bake(source, displacement, vertices, size)
    if maps.overlap > 0.01:
        print(
            f"styleexp-bake: warning: {maps.overlap:.0%} of the texture lies under several faces "
            "(mirrored, stacked or tiled islands), which can't each have a relief of their own: "
            "the last face's is kept. Unwrap without overlaps for all of them.",
            file=sys.stderr,
        )
    if source.carrier is not None and source.carrier.flipped.any():
        print(
            "styleexp-bake: warning: faces of the source's file point inwards; the maps are for "
            "normals that point outwards (in Blender: Mesh > Normals > Recalculate Outside).",
            file=sys.stderr,
        )
    target = out or folder / "bake"
    target.mkdir(parents=True, exist_ok=True)
    told = {"run": str(folder), "source": source.name, **baking.write(maps, target, kind)}
    atomic.write(target / "bake.json", atomic.text(json.dumps(told, indent=2) + "\n"))
    return [target / name for name in (f"height.{kind}", f"normal.{kind}", "bake.json")]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="styleexp-bake", description=DESCRIPTION)
    parser.add_argument("folder", type=Path, metavar="RUN_FOLDER", help="of a finished run")
    parser.add_argument("--size", type=int, default=2048, help="pixels on a side (2048)")
    parser.add_argument(
        "--format",
        choices=FORMATS,
        default="png",
        help="png: 16 bits a channel; exr: floats, the displacement itself (extra exr)",
    )
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="RUN_FOLDER/bake")
    return parser


if __name__ == "__main__":
    sys.exit(main())
