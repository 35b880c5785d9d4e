"""``styleexp-assets``: list, locate and fetch meshes, images and weights."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence

from styleexp.cli.ending import ends_well
from styleexp.inputs import assets
from styleexp.system.errors import UserError, unknown_name


@ends_well
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, or 2 after printing a user error."""
    options = _parser().parse_args(arguments)
    try:
        if options.command == "list":
            _list(options.kind, options.json)
        for name in getattr(options, "names", []):
            kind = options.kind or _kind_of(name)
            found = assets.find if options.command == "fetch" else _where
            print(found(name, kind))
    except UserError as error:
        print(f"styleexp-assets: {error}", file=sys.stderr)
        return 2
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="styleexp-assets",
        description="Named meshes, images and weights: locations, licences and downloads. Search "
        "path: STYLEEXP_ASSETS; cache: STYLEEXP_CACHE.",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, text in (
        ("list", "list all names, and whether they are on this machine"),
        ("fetch", "download assets that aren't on this machine yet, and print their files"),
        ("where", "print the files of names that are on this machine; downloads nothing"),
    ):
        command = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        command.add_argument("--kind", choices=assets.KINDS, help="only this kind")
        if name == "list":
            command.add_argument("--json", action="store_true", help="print everything as JSON")
        else:
            command.add_argument("names", nargs="+", metavar="NAME")
    return parser


def _list(kind: str | None, as_json: bool) -> None:
    rows = []
    for each in (kind,) if kind else assets.KINDS:
        for name in assets.names(each):
            path, asset = assets.locate(name, each), assets.ASSETS.get(name)
            if asset is not None and asset.kind != each:
                asset = None
            row = {"name": name, "kind": each, "path": str(path) if path else None}
            for field in ("licence", "author", "source", "sha256"):
                row[field] = getattr(asset, field) if asset else None
            rows.append(row)
    if as_json:
        print(json.dumps(rows, indent=2))
        return
    header = ("name", "kind", "here", "licence", "author")
    table = [header]
    for row in rows:
        here = "yes" if row["path"] else "no"
        licence, author = row["licence"] or "unknown", row["author"] or "your file"
        table.append((str(row["name"]), str(row["kind"]), here, licence, author))
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    for line in table:
        print("  ".join(map(str.ljust, line, widths)).rstrip())


def _where(name: str, kind: str) -> str:
    path = assets.locate(name, kind)
    if path is None:
        if name not in assets.names(kind):
            raise unknown_name(kind, name, assets.names(kind))
        raise UserError(
            f"the {kind} '{name}' is not on this machine: 'styleexp-assets fetch {name}' downloads "
            "it, or add its folder to STYLEEXP_ASSETS."
        )
    return str(path)


def _kind_of(name: str) -> str:
    kinds = [kind for kind in assets.KINDS if name in assets.names(kind)]
    if len(kinds) == 1:
        return kinds[0]
    if kinds:
        raise UserError(f"'{name}' names more than one thing ({', '.join(kinds)}): add --kind.")
    raise unknown_name("asset", name, {n for kind in assets.KINDS for n in assets.names(kind)})


if __name__ == "__main__":
    sys.exit(main())
