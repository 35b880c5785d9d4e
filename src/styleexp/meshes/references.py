"""The files that a mesh file names: material libraries, textures, buffers.

A mesh may come from anywhere, so only files in or below its own folder are read for it, wherever
``../``, an absolute path or a symbolic link would lead.
"""

from __future__ import annotations

import base64
import binascii
import re
from pathlib import Path
from urllib.parse import unquote

from trimesh.resolvers import Resolver

from styleexp.errors import UserError

OUTSIDE = "lies outside the mesh's folder"
ABSENT = "was not found"


def bare(name: str) -> str:
    """The file's name without folders, be they written the Unix or the Windows way."""
    return re.split(r"[/\\]", name)[-1]


def find(name: str, folder: Path, root: Path) -> tuple[Path | None, str]:
    """The file that ``name`` in ``folder`` means, or None and why there is none.

    Nothing outside of ``root`` is found, with symbolic links followed. Files made elsewhere often
    hold an absolute or a Windows path: then the bare name is tried.
    """
    reason = ABSENT
    root = root.resolve()
    for candidate in dict.fromkeys((name, name.replace("\\", "/"), unquote(name), bare(name))):
        try:
            real = (folder / candidate).resolve(strict=True)
        except (OSError, ValueError, RuntimeError):  # absent, not a path, a circle of links
            continue
        if not real.is_relative_to(root):
            reason = OUTSIDE
        elif real.is_file():
            return folder / candidate, ""
    return None, reason


class Beside(Resolver):
    """Gives trimesh what lies beside a mesh file, by `find`'s rules."""

    def __init__(self, path: Path):
        self.folder = path.absolute().parent

    def get(self, name: str) -> bytes:
        """A file's content. Raises `UserError`, the end of a sentence that begins with the mesh."""
        found, reason = find(name, self.folder, self.folder)
        if found is None:
            raise UserError(
                f"refers to the file '{name}', which {reason}: put it beside the mesh, under that "
                "name."
            )
        return found.read_bytes()

    def keys(self) -> list[str]:
        """Nothing is listed: what a file does not name is not offered to it."""
        return []

    def write(self, name: str, data: object) -> None:
        """Reading a mesh writes nothing."""
        raise NotImplementedError

    def namespaced(self, namespace: str) -> Beside:
        """The same place: folders of archives are not read."""
        return self


def resolved(uri: str, beside: Beside) -> bytes:
    """What a URI stands for: data in itself, or a file in the mesh's folder."""
    if not uri.startswith("data:"):
        return beside.get(uri)
    head, _, body = uri.partition(",")
    try:
        if not head.endswith(";base64"):
            raise ValueError
        return base64.b64decode(body, validate=True)
    except (ValueError, binascii.Error):
        raise UserError("has a data URI that cannot be decoded: export the mesh again.") from None
