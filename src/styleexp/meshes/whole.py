"""Whether a file is all there, before trimesh, which reads what there is, gets it."""

from __future__ import annotations

import importlib.util
import json
import re
import struct
from typing import Any

from styleexp.errors import UserError

EARLY = "ends too early: copy or export the mesh again."
MOST_ZEROS = 10_000_000
"""Elements that a glTF file may call for without holding them (they are zeros)."""
LOOKS = re.compile(
    r"KHR_materials_\w+|KHR_texture_\w+|EXT_texture_\w+|KHR_lights_punctual"
    r"|KHR_xmp\w*|KHR_animation_pointer"
)
"""glTF extensions that a file may require without a change to its surface as trimesh reads it."""


def check(kind: str, data: bytes) -> None:
    """Raise `UserError`, the end of a sentence that begins with the file's name, unless it is."""
    if kind == "stl":
        _stl(data)
    elif kind == "off":
        _off(data)
    elif kind in ("glb", "gltf"):
        _gltf(gltf_header(kind, data))


def gltf_header(kind: str, data: bytes) -> dict[str, Any]:
    """The JSON of a glTF file."""
    text = data
    if kind == "glb":
        if data[:4] != b"glTF":
            raise UserError("is not a GLB file: export it again.")
        if len(data) < 20:
            raise UserError(EARLY)
        (length,) = struct.unpack("<I", data[12:16])
        text = data[20 : 20 + length]
        if len(text) < length:
            raise UserError(EARLY)
    try:
        header = json.loads(text)
    except (ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())[:80]
        raise UserError(f"is not whole JSON ({reason}): copy or export the mesh again.") from None
    if not isinstance(header, dict):
        raise UserError("is JSON, but no glTF: export the mesh again.")
    return header


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


def _gltf(header: dict[str, Any]) -> None:
    for name in header.get("extensionsRequired", ()):
        if name == "KHR_draco_mesh_compression" and importlib.util.find_spec("DracoPy"):
            continue
        if not LOOKS.fullmatch(str(name)):
            raise UserError(
                f"needs the glTF extension {name}, which is not read: export the mesh without it "
                "(compression off)."
            )
    for accessor in header.get("accessors", ()):
        count = accessor.get("count", 0)
        if "bufferView" not in accessor and count > MOST_ZEROS:
            raise UserError(f"promises {count} values that it does not hold: export it again.")
    _acyclic([node.get("children", ()) for node in header.get("nodes", ())])


def _acyclic(children: list[Any]) -> None:
    """A node must not be below itself."""
    parents = [0] * len(children)
    for row in children:
        for child in row:
            if 0 <= child < len(parents):
                parents[child] += 1
    free = [k for k, count in enumerate(parents) if count == 0]
    for node in free:  # grows: those whose parents are all done
        for child in children[node]:
            if 0 <= child < len(parents):
                parents[child] -= 1
                if parents[child] == 0:
                    free.append(child)
    if len(free) < len(children):
        raise UserError("has nodes that are below themselves: export the mesh again.")
