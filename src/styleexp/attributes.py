"""What a source's file says of its vertices under names of its own: numbers and vectors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from styleexp.errors import UserError
from styleexp.meshes.mesh import at_vertices

if TYPE_CHECKING:
    from jaxtyping import Float

    from styleexp.meshes import Mesh

ATTRIBUTE = "attribute:"
"""What such a name is written after, in the configuration."""


def numbers(source: Mesh, name: str, key: str) -> Float[np.ndarray, " vertices"]:
    """A number at each vertex, as the file has it. ``key`` is who asks; see `_found` for errors."""
    return _found(source, name, key, 1, "a number")[:, 0]


def vectors(source: Mesh, name: str, key: str) -> Float[np.ndarray, "vertices 3"]:
    """A vector at each vertex in the source's frame, of length 1, or 0 where the file's has none.

    Raises `UserError` where all are 0; else as `_found`.
    """
    given = _found(source, name, key, 3, "a vector (three numbers)")
    length = np.linalg.norm(given, axis=1, keepdims=True)
    if not length.any():
        raise UserError(
            f"{key}={ATTRIBUTE}{name}: all its vectors in '{source.name}' are 0, which points "
            "nowhere: export the mesh with directions in it."
        )
    return given / np.where(length > 0, length, 1.0)


def _found(
    source: Mesh, name: str, key: str, width: int, what: str
) -> Float[np.ndarray, "vertices width"]:
    """The attribute at the vertices. Raises `UserError` where there is none of that name, naming
    those there are, and where its width is another or its values aren't finite."""
    there = {} if source.carrier is None else source.carrier.attributes
    if name not in there:
        names = ", ".join(f"'{each}'" for each in there) or "none"
        raise UserError(
            f"{key}={ATTRIBUTE}{name}: the source '{source.name}' has no such vertex attribute; "
            f"it has {names} (those of a PLY's own properties, or a glTF's '_NAME')."
        )
    values = there[name]
    if values.shape[1] != width:
        raise UserError(
            f"{key}={ATTRIBUTE}{name}: at each vertex it has {values.shape[1]} numbers, and {what} "
            "is needed: give another attribute."
        )
    if not np.isfinite(values).all():
        raise UserError(
            f"{key}={ATTRIBUTE}{name}: it is NaN or infinite at some vertices of '{source.name}': "
            "repair it in the program that wrote it."
        )
    return at_vertices(source, values)
