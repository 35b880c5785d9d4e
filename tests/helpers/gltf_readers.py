"""glTF as others read it: the Khronos validator, glTF-Transform, and a file's plain JSON."""

from __future__ import annotations

import json
import shutil
import struct
import subprocess
from pathlib import Path
from typing import Any

TOOLS = Path(__file__).parent / "gltf_tools"


def tools() -> str:
    """The program that runs them. Raises `UserError` where it or they aren't installed."""
    from styleexp.system.errors import UserError

    node = shutil.which("node")
    if node is None or not (TOOLS / "node_modules" / "gltf-validator").is_dir():
        raise UserError("no Node.js with gltf-validator and glTF-Transform: run .ci/install-gltf.")
    return node


def _ask(task: str, paths: list[Path]) -> Any:
    told = subprocess.run(
        [tools(), str(TOOLS / "read.js"), task, *map(str, paths)],
        capture_output=True, text=True, check=True, timeout=120,
    )  # fmt: skip
    return json.loads(told.stdout)


def issues(*paths: Path) -> list[list[str]]:
    """For each file the validator's errors and warnings."""
    return [
        [f"{m['code']} {m.get('pointer', '')}: {m['message']}" for m in found if m["severity"] < 2]
        for found in _ask("validate", list(paths))
    ]


def errors(*paths: Path) -> list[list[str]]:
    """For each file the validator's errors."""
    return [
        [f"{m['code']} {m.get('pointer', '')}: {m['message']}" for m in found if m["severity"] < 1]
        for found in _ask("validate", list(paths))
    ]


def values(*paths: Path) -> list[list[list[list[float]]]]:
    """For each file every accessor's elements, normalised integers as fractions."""
    return _ask("values", list(paths))


def parts(path: Path) -> tuple[dict[str, Any], bytes]:
    """A GLB's document and binary chunk."""
    content = path.read_bytes()
    (length,) = struct.unpack("<I", content[12:16])
    return json.loads(content[20 : 20 + length]), content[28 + length :]
