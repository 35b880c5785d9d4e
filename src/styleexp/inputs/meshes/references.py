"""The files that a mesh file names: material libraries, textures, buffers.

Meshes are untrusted, so only files in or below the mesh's folder are read, regardless of ``../``,
absolute paths and symbolic links.
"""

from __future__ import annotations

import base64
import binascii
import re
from pathlib import Path
from urllib.parse import unquote

from trimesh.resolvers import Resolver

from styleexp.system.errors import UserError

OUTSIDE = "is outside the mesh's folder"
ABSENT = "was not found"


def bare(name: str) -> str:
    """The file's name without folders, for Unix or Windows paths."""
    return re.split(r"[/\\]", name)[-1]


def find(name: str, folder: Path, root: Path) -> tuple[Path | None, str]:
    """Resolve ``name`` in ``folder`` to a file, or return None and the reason.

    Never returns a file outside ``root``, after following symbolic links. Absolute and Windows
    paths, common in files from other machines, are retried as bare names.
    """
    reason = ABSENT
    root = root.resolve()
    for candidate in dict.fromkeys((name, name.replace("\\", "/"), unquote(name), bare(name))):
        try:
            real = (folder / candidate).resolve(strict=True)
        except (OSError, ValueError, RuntimeError):  # missing, not a path, or a symlink loop
            continue
        if not real.is_relative_to(root):
            reason = OUTSIDE
        elif real.is_file():
            return folder / candidate, ""
    return None, reason


class Beside(Resolver):
    """trimesh resolver for files next to a mesh file, with the rules of `find`."""

    def __init__(self, path: Path):
        self.folder = path.absolute().parent

    def get(self, name: str) -> bytes:
        """Read a file. Raises `UserError` with a message that lacks its subject, the mesh's
        name."""
        found, reason = find(name, self.folder, self.folder)
        if found is None:
            raise UserError(
                f"refers to the file '{name}', which {reason}: put it next to the mesh, under that "
                "name."
            )
        return found.read_bytes()

    def keys(self) -> list[str]:
        """Return an empty list: only named files can be read."""
        return []

    def write(self, name: str, data: object) -> None:
        """Do nothing: reading a mesh writes no files."""
        raise NotImplementedError

    def namespaced(self, namespace: str) -> Beside:
        """Return self: namespaces of archives are not supported."""
        return self


def resolved(uri: str, beside: Beside) -> bytes:
    """Resolve a URI: embedded data, or a file in the mesh's folder."""
    if not uri.startswith("data:"):
        return beside.get(uri)
    head, _, body = uri.partition(",")
    try:
        if not head.endswith(";base64"):
            raise ValueError
        return base64.b64decode(body, validate=True)
    except (ValueError, binascii.Error):
        raise UserError("has a data URI that cannot be decoded: export the mesh again.") from None
