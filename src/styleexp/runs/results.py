"""Read a run's result, ``result.ply``, which like everything in the folder may be damaged or a
stranger's."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from styleexp.inputs.meshes import ply
from styleexp.inputs.meshes.welding import check_indices
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from jaxtyping import Float, Int

    from styleexp.inputs.meshes.ply import Ply

NAME = "result.ply"


@dataclass(frozen=True)
class Stored:
    """A result as stored: the source's vertices, or its file's rows, split at seams."""

    vertices: Float[np.ndarray, "rows 3"]
    faces: Int[np.ndarray, "faces 3"]
    displacement: Float[np.ndarray, " rows"] | None
    """In the source's units; None if the file has none."""


def read(path: Path) -> Stored:
    """Read a run's result in file order.

    Raises `UserError` for anything else than a PLY file of triangles.
    """
    table = _parse(path)
    try:
        vertices = _positions(table)
        corners = table.elements.get("face", {}).get("vertex_indices")
        if not isinstance(corners, ply.Lists) or (corners.lengths != 3).any():
            raise UserError("has no faces, or others than triangles: run again.")
        check_indices(corners.values, len(vertices))
        displacement = None
        if "displacement" in table.elements["vertex"]:
            displacement = ply.numbers(table.elements["vertex"], "displacement")[:, 0]
    except UserError as error:
        raise UserError(f"'{path}' {error}") from None
    return Stored(vertices, corners.values.astype(np.int64).reshape(-1, 3), displacement)


def positions(path: Path) -> Float[np.ndarray, "rows 3"]:
    """Read the vertices of any PLY file in file order. Raises `UserError` like `read`."""
    table = _parse(path)
    try:
        return _positions(table)
    except UserError as error:
        raise UserError(f"'{path}' {error}") from None


def _parse(path: Path) -> Ply:
    try:
        return ply.parse(path.read_bytes())
    except UserError as error:
        raise UserError(f"'{path}' {error}") from None
    except (OSError, ValueError, OverflowError, MemoryError) as error:
        raise UserError(f"'{path}' cannot be read ({error}): run again.") from None


def _positions(table: Ply) -> np.ndarray:
    vertex = table.elements.get("vertex", {})
    if not all(isinstance(vertex.get(axis), np.ndarray) for axis in "xyz"):
        raise UserError("has no vertices with x, y and z: run again.")
    return ply.numbers(vertex, *"xyz")
