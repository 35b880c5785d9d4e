"""``styleexp reproduce``: make a run again from its record, and say what came out equal."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from styleexp.cli.ending import ends_well
from styleexp.system.errors import UserError

NAME = "reproduce"


@ends_well
def main(arguments: Sequence[str]) -> int:
    """Run the command; return 0 if all is equal, 1 if the results differ. Raises `UserError`."""
    options = _parser().parse_args(arguments)
    if not options.folder.is_dir():
        raise UserError(f"there is no folder '{options.folder}': give a run's folder.")
    from styleexp.experiments.reproduce import reproduce

    try:
        return reproduce(options.folder, options.out)
    except BrokenPipeError:
        raise
    except OSError as error:
        where = f"'{error.filename}'" if error.filename else "a file"
        raise UserError(f"{where} can't be read or written ({error.strerror or error}).") from error


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=f"styleexp {NAME}",
        description="Make a finished run again, from its own record, in a new folder. Its inputs "
        "and the code of its plugins must be what they were (by sha256). First it says what else "
        "differs from then: versions, the commit, device, threads, machine; at the end, whether "
        "the vertices have the same bits, or how far apart they are, and each metric. The run's "
        "own folder stays as it is. Exit code: 0 if all is equal, 1 if the results differ, 2 if "
        "the run can't be made again, 130 if it was stopped.",
    )
    parser.add_argument("folder", type=Path, metavar="RUN", help="folder of a finished run")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FOLDER",
        help="folder for the new run, which must not exist or be empty (default: a new one below "
        "outputs/reproduced)",
    )
    return parser
