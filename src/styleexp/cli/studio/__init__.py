"""``styleexp-studio``: a local page on which a style is put on a mesh while one watches.

`workbench` holds what is being made and works on it in a thread of its own, with what `kept`
remembers; `app` serves it to a browser on this machine; the page is among the reports' assets.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from datetime import datetime
from importlib.util import find_spec
from pathlib import Path

from styleexp.cli.ending import ends_well
from styleexp.system.errors import UserError

DESCRIPTION = """\
Open a local web page to stylise a mesh interactively: drop a mesh and a style, adjust size, height,
direction and mask, and save the mesh, its height and normal maps, and the equivalent command. Only
this machine can open the page. Needs the extra studio."""


@ends_well
def main(arguments: Sequence[str] | None = None) -> int:
    """Serve the page until Ctrl-C; return 0, or 2 after printing a user error."""
    options = _parser().parse_intermixed_args(arguments)
    try:
        missing = [name for name in ("starlette", "uvicorn") if find_spec(name) is None]
        if missing:
            raise UserError(f"it needs {missing[0]}: pip install 'styleexp[studio]'.")
        return _serve(options)
    except UserError as error:
        print(f"styleexp-studio: {error}", file=sys.stderr)
        return 2


def _serve(options: argparse.Namespace) -> int:
    from styleexp.api import configure
    from styleexp.cli.studio.settings import Settings
    from styleexp.config import sources

    more = tuple(word for word in options.words if "=" in word and not Path(word).exists())
    files = [word for word in options.words if word not in more]
    if len(files) > 2:
        raise UserError(
            f"unexpected argument '{files[2]}': give at most a mesh, a style and KEY=VALUE options."
        )
    settings = Settings(more=more).changed(dict(zip(("source", "style"), files, strict=False)))
    sources.check(configure(settings.source, settings.style, settings.overrides))
    folder = options.out or Path("outputs/studio") / f"{datetime.now():%Y-%m-%d_%H-%M-%S}"
    if folder.exists() and not folder.is_dir():
        raise UserError(f"--out '{folder}' is a file: give a folder.")

    from styleexp.cli.studio import app

    return app.serve(settings, folder, options.port, not options.no_browser)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="styleexp-studio", description=DESCRIPTION)
    parser.add_argument(
        "words",
        nargs="*",
        metavar="MESH STYLE KEY=VALUE",
        help="files or names (default: critter scales), and options as of styleexp",
    )
    parser.add_argument("--port", type=int, default=0, help="default: any free one")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FOLDER",
        help="folder for uploaded and saved files (default: outputs/studio/DATE)",
    )
    parser.add_argument("--no-browser", action="store_true", help="only print the address")
    return parser
