"""In-memory meshes and images."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from styleexp.inputs import images
from styleexp.inputs.meshes.mesh import Carrier, Mesh
from styleexp.inputs.meshes.ply_meshes import DISPLACEMENT
from styleexp.inputs.meshes.precision import of_floats
from styleexp.inputs.meshes.welding import check_indices, weld
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from jaxtyping import Float, Int


def from_memory(given: Any, kind: str) -> Mesh | Float[np.ndarray, "height width 3"]:
    """Convert ``(vertices, faces)`` or a ``trimesh.Trimesh`` to a `Mesh`, or an array to an image.

    A `Mesh` is returned unchanged. Arrays are copied. ``kind`` is used in errors: ``source`` or
    ``style``. Raises `UserError` for other types, and for data that `load_mesh` or
    `images.load_image` would reject.
    """
    if isinstance(given, Mesh):
        return given
    try:
        if isinstance(given, np.ndarray):
            return images.from_array(given)
        if isinstance(given, tuple | list) and len(given) == 2:
            return from_arrays(*given)
        if hasattr(given, "vertices") and hasattr(given, "faces"):
            return from_arrays(
                given.vertices,
                given.faces,
                getattr(given, "visual", None),
                getattr(given, "vertex_attributes", None),
            )
    except UserError as error:
        raise UserError(f"the {kind} {error}") from None
    raise UserError(
        f"the {kind} is a {type(given).__name__}: give a name, a file, (vertices, faces), a "
        "trimesh.Trimesh, or an array as a picture."
    )


def from_arrays(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    visual: Any = None,
    attributes: Any = None,
) -> Mesh:
    """Make a validated, welded, outward-facing mesh, named ``array``; see `load_mesh`. Keeps a
    trimesh's texture coordinates, material and vertex colours (``visual``), and its ``attributes``,
    numeric arrays of shape (vertices,) or (vertices, width), keyed by name.

    Raises `UserError` with a message that lacks its subject.
    """
    try:
        points, corners = np.array(vertices), np.array(faces)
        if np.iscomplexobj(points):
            raise TypeError("complex numbers")
        points = points.astype(np.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())[:100].rstrip(".")
        raise UserError(
            f"is not a pair of numeric arrays ({reason}): give (vertices, faces)."
        ) from None
    if points.ndim != 2 or points.shape[1] != 3:
        raise UserError(f"has vertices of shape {points.shape}: give (vertices, 3).")
    if corners.ndim != 2 or corners.shape[1] != 3 or not np.issubdtype(corners.dtype, np.integer):
        raise UserError(
            f"has faces of shape {corners.shape} and type {corners.dtype}: give integers of shape "
            "(faces, 3)."
        )
    corners = corners.astype(np.int64)
    check_indices(corners, len(points))
    used, places = np.unique(corners, return_inverse=True)
    notes = []
    if len(used) < len(points):
        notes.append(f"left out {len(points) - len(used)} vertices that no face uses")
    corners = places.reshape(corners.shape)
    no_row = np.zeros(len(used), dtype=np.int64)
    rounding = of_floats(points) if np.asarray(vertices).dtype == np.float32 else 0.0
    carrier = Carrier(corners, no_row, np.zeros(len(corners), dtype=bool), precision=rounding)
    if visual is not None:
        carrier = replace(carrier, **_looks(visual, used, len(corners), notes))
    kept = {}
    for name, values in {k: np.asarray(v) for k, v in (attributes or {}).items()}.items():
        fits = values.dtype.kind in "buif" and values.shape[:1] == points.shape[:1] and values.size
        if fits and name != DISPLACEMENT:
            kept[name] = values.astype(np.float64).reshape(len(points), -1)[used]
    carrier = replace(carrier, attributes=kept)
    return weld("array", points[used], carrier, notes)


def _looks(visual: Any, used: np.ndarray, faces: int, notes: list[str]) -> dict[str, Any]:
    """`Carrier` fields from a trimesh's ``visual``."""
    if visual.kind == "vertex":
        return {"colors": np.asarray(visual.vertex_colors, dtype=np.uint8)[used]}
    if visual.kind == "face":
        return {"face_colors": np.asarray(visual.face_colors, dtype=np.uint8)}
    if visual.kind != "texture" or visual.uv is None:
        return {}
    material = visual.material
    if hasattr(material, "to_pbr"):
        material = material.to_pbr()
    if material.name is None:
        material.name = "material"
    return {
        "uv": np.asarray(visual.uv, dtype=np.float64)[used],
        "materials": (material,),
        "face_material": np.zeros(faces, dtype=np.int64),
    }
