"""``styleexp-plugins``: list every part that can be chosen by name, its origin, and whether it
works."""

from __future__ import annotations

import argparse
import json
import sys
import warnings
from collections.abc import Sequence

from styleexp import plugins
from styleexp.cli.ending import ends_well


@ends_well
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; unusable plugins are listed and don't count as a failure."""
    parser = argparse.ArgumentParser(
        prog="styleexp-plugins",
        description="Renderers, encoders, styles, fields, losses, baselines and loggers, built "
        "in or from plugins: their origin, and why unusable ones can't be used. Plugins are "
        f"found in installed packages and in {plugins.VARIABLE} (KIND=MODULE:SPEC, ...).",
    )
    parser.add_argument("--json", action="store_true", help="print a JSON list of objects")
    options = parser.parse_args(arguments)
    with warnings.catch_warnings(action="ignore"):  # the list shows it
        choices = plugins.everything()
    if options.json:
        print(json.dumps([_row(choice) for choice in choices], indent=2))
        return 0
    table = [("kind", "name", "usable", "version", "origin")]
    for choice in choices:
        usable = "no" if choice.reason else "yes"
        table.append((choice.kind, choice.name, usable, choice.version or "", choice.origin))
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    reasons = [None, *(choice.reason for choice in choices)]
    for line, reason in zip(table, reasons, strict=True):
        print("  ".join(map(str.ljust, line, widths)).rstrip())
        if reason:
            print(f"    {reason}")
    return 0


def _row(choice: plugins.Choice) -> dict[str, str | bool | None]:
    kind = plugins.KINDS.get(choice.kind)
    return {
        "group": kind.group if kind else choice.kind,
        "name": choice.name,
        "origin": choice.origin,
        "version": choice.version,
        "usable": choice.reason is None,
        "reason": choice.reason,
    }


if __name__ == "__main__":
    sys.exit(main())
