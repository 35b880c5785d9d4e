"""How a command with subcommands ends: its answer as text or JSON, or what the user can mend."""

from __future__ import annotations

import argparse
import json
import sys

from styleexp.errors import UserError


def answer(parser: argparse.ArgumentParser, options: argparse.Namespace) -> int:
    """Print what ``options.function`` finds, by ``options.show`` or as JSON; return 0, or 2 after
    printing a `UserError`."""
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
