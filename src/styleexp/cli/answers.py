"""Output of commands with subcommands: text, JSON, or a user error."""

from __future__ import annotations

import argparse
import json
import sys

from styleexp.system.errors import UserError


def answer(parser: argparse.ArgumentParser, options: argparse.Namespace) -> int:
    """Print the result of ``options.function``, with ``options.show`` or as JSON. Return 0, or 2
    after printing a `UserError`."""
    try:
        found = options.function(options)
    except UserError as error:
        print(f"{parser.prog}: {error}", file=sys.stderr)
        return 2
    if options.json:
        print(json.dumps(found, indent=2))
    else:
        options.show(found)
    return 0
