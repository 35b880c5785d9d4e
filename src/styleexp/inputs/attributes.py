"""Named per-vertex attributes of a source file: numbers and vectors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from styleexp.inputs.meshes.mesh import at_vertices
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from jaxtyping import Float

    from styleexp.inputs.meshes import Mesh

ATTRIBUTE = "attribute:"
"""Prefix of attribute names in the configuration."""


def numbers(source: Mesh, name: str, key: str) -> Float[np.ndarray, " vertices"]:
    """A scalar attribute at each vertex, as stored. ``key`` names the option in errors; see
    `_found`."""
    return _found(source, name, key, 1, "a number")[:, 0]


def vectors(source: Mesh, name: str, key: str) -> Float[np.ndarray, "vertices 3"]:
    """A vector attribute at each vertex in the source's frame, of length 1, or 0 where the file's
    is 0.

    Raises `UserError` if all vectors are 0, and as `_found` does.
    """
    given = _found(source, name, key, 3, "a vector (three numbers)")
    length = np.linalg.norm(given, axis=1, keepdims=True)
    if not length.any():
        raise UserError(
            f"{key}={ATTRIBUTE}{name}: all its vectors in '{source.name}' are zero: export the "
            "mesh with non-zero directions."
        )
    return given / np.where(length > 0, length, 1.0)


def _found(
    source: Mesh, name: str, key: str, width: int, what: str
) -> Float[np.ndarray, "vertices width"]:
    """The attribute at the vertices. Raises `UserError` if the name is unknown (listing the known
    ones), the width differs, or values aren't finite."""
    there = {} if source.carrier is None else source.carrier.attributes
    if name not in there:
        names = ", ".join(f"'{each}'" for each in there) or "none"
        raise UserError(
            f"{key}={ATTRIBUTE}{name}: the source '{source.name}' has no such vertex attribute; "
            f"it has {names} (custom properties of a PLY, or '_NAME' attributes of a glTF)."
        )
    values = there[name]
    if values.shape[1] != width:
        raise UserError(
            f"{key}={ATTRIBUTE}{name}: it has {values.shape[1]} numbers per vertex, but {what} is "
            "needed: give another attribute."
        )
    if not np.isfinite(values).all():
        raise UserError(
            f"{key}={ATTRIBUTE}{name}: it is NaN or infinite at some vertices of '{source.name}': "
            "repair it in the program that wrote it."
        )
    return at_vertices(source, values)
