"""Detect truncated files, which trimesh would read without an error."""

from __future__ import annotations

import re
import struct

from styleexp.system.errors import UserError

EARLY = "ends too early: copy or export the mesh again."


def check(kind: str, data: bytes) -> None:
    """Raise `UserError` if the file is truncated; the message lacks its subject, the file's
    name."""
    if kind == "stl":
        _stl(data)
    elif kind == "off":
        _off(data)


def _stl(data: bytes) -> None:
    whole = 84 + 50 * struct.unpack("<I", data[80:84])[0] if len(data) >= 84 else 84
    if len(data) == whole:
        return
    if data[:80].lstrip().lower().startswith(b"solid") and b"\0" not in data:
        if b"endsolid" not in data[-1000:].lower():
            raise UserError(EARLY)
    elif len(data) < whole:
        raise UserError(EARLY)


def _off(data: bytes) -> None:
    lines = [line for line in re.split(rb"[\r\n]+", data) if line.split(b"#")[0].strip()]
    head = re.match(rb"\s*(?:\w*OFF)?\s*(?:#[^\r\n]*\s*)*(\d+)\s+(\d+)", data)
    if head and len(lines) < 1 + int(head[1]) + int(head[2]):
        raise UserError(EARLY)
