"""Tell from a file's beginning that it is no mesh, before anything heavy is imported to read it."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from styleexp.system.errors import UserError

PIECE = 1 << 20
NO_FACES = "it has no faces; reconstruct or export a surface first."


def check(path: Path) -> None:
    """Raise `UserError` if a mesh file is empty, has another content than its suffix says, or, as
    an OBJ, has no face. What else may be wrong with it, `meshes.load_mesh` finds."""
    wrong = FAULTS.get(path.suffix.lower())
    if wrong is None or not path.is_file():
        return
    try:
        with path.open("rb") as file:
            head = file.read(PIECE)
    except OSError:
        return  # said by the reader
    if not head.strip() and len(head) < PIECE:
        raise UserError(f"'{path}' is empty: export the mesh again.")
    if fault := wrong(head, path):
        raise UserError(f"'{path}' {fault}")


def _obj(head: bytes, path: Path) -> str:
    """Looks for the first face; a large file's is usually past its first piece."""
    if b"\0" in head:
        return ""  # UTF-16, or no text at all: the reader says which
    vertices = False
    with path.open("rb") as file:
        before = b"\n"
        while piece := file.read(PIECE):
            text = before + piece
            if re.search(rb"[\r\n][ \t]*f[ \t\\]", text):
                return ""
            vertices = vertices or re.search(rb"[\r\n][ \t]*v[ \t]", text) is not None
            before = text[-256:]
    return f"is a point cloud: {NO_FACES}" if vertices else f"contains no mesh: {NO_FACES}"


def _stl(head: bytes, path: Path) -> str:
    size = path.stat().st_size
    binary = len(head) >= 84 and size == 84 + 50 * int.from_bytes(head[80:84], "little")
    known = binary or head.lstrip().lower().startswith(b"solid") or b"\0" in head
    return "" if known else "is not an STL file: export the mesh again."


def _ply(head: bytes, path: Path) -> str:
    return "" if head.startswith(b"ply") else "is not a PLY file: export the mesh again."


def _off(head: bytes, path: Path) -> str:
    # The word is optional: counts alone may begin the file.
    known = re.match(rb"(?:\s|#[^\r\n]*[\r\n])*(?:\w*OFF\b|\d+\s+\d+)", head)
    return "" if known else "is not an OFF file: export the mesh again."


def _glb(head: bytes, path: Path) -> str:
    return "" if head.startswith(b"glTF") else "is not a GLB file: export it again."


def _gltf(head: bytes, path: Path) -> str:
    known = head.lstrip(b"\xef\xbb\xbf \t\r\n").startswith((b"{", b"["))
    return "" if known else "is not a glTF file: export the mesh again."


FAULTS: dict[str, Callable[[bytes, Path], str]] = {
    ".obj": _obj,
    ".stl": _stl,
    ".ply": _ply,
    ".off": _off,
    ".glb": _glb,
    ".gltf": _gltf,
}
"""What is wrong with a file of each suffix, as the predicate of a sentence; empty if nothing."""
