"""Smooth fields of unit tangent directions, which define a pattern's up on a surface."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import cg

from styleexp.inputs import meshes

if TYPE_CHECKING:
    from jaxtyping import Float

    from styleexp.method.synthesis.walk import Sheet

FLOW, UP = 0.08, 0.018
"""Length, in units of the vertices, at which smoothness and the wished direction have equal weight:
with a long one the field flows along the form; with a short one it follows the wish wherever the
surface allows."""


def direction_field(
    sheet: Sheet, wish: Float[np.ndarray, "vertices 3"], length: float
) -> Float[np.ndarray, "vertices 3"]:
    """Smoothest unit tangent field (connection Laplacian) that follows ``wish`` where it is
    tangential; ``length`` is `FLOW`, `UP` or any other.

    Solves one sparse complex system. ``wish`` needs to be neither unit nor tangent; where it is
    normal to the surface it has no effect.
    """
    vertices, normals = sheet.vertices, sheet.normals
    x, y = frames(normals)
    edges = meshes.edges_of(sheet.faces)
    a, b = edges[edges[:, 0] != edges[:, 1]].T
    along = vertices[b] - vertices[a]
    turn = [np.arctan2((along * y[k]).sum(1), (along * x[k]).sum(1)) for k in (a, b)]
    carried = np.exp(1j * (turn[0] - turn[1]))
    count = len(vertices)
    rows, columns = np.concatenate([a, b]), np.concatenate([b, a])
    both = np.concatenate([-carried, -carried.conj()])
    laplacian = coo_matrix((both, (rows, columns)), (count, count)).tocsc()
    degree = np.bincount(rows, minlength=count)
    tangent = wish - (wish * normals).sum(1, keepdims=True) * normals
    say = sheet.areas / length**2 * np.linalg.norm(tangent, axis=1) ** 2
    asked = (tangent * x).sum(1) + 1j * (tangent * y).sum(1)
    asked = say * asked / np.abs(asked).clip(min=1e-9)
    # A component without a wish would make the matrix singular.
    diagonal = degree + say + 1e-6
    matrix = (laplacian + diags(diagonal)).tocsr()
    field = cg(matrix, asked + 1e-9, rtol=1e-6, M=diags(1 / diagonal))[0]
    field /= np.abs(field).clip(min=1e-300)
    return field.real[:, None] * x + field.imag[:, None] * y


def frames(
    normals: Float[np.ndarray, "vertices 3"],
) -> tuple[Float[np.ndarray, "vertices 3"], Float[np.ndarray, "vertices 3"]]:
    """Two unit tangents per vertex, right-handed with the normal."""
    reference = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]])
    x = reference - (reference * normals).sum(1, keepdims=True) * normals
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return x, np.cross(normals, x)


def turned(
    ahead: Float[np.ndarray, "vertices 3"],
    normals: Float[np.ndarray, "vertices 3"],
    angle: Float[np.ndarray, " vertices"] | float,
) -> Float[np.ndarray, "vertices 3"]:
    """Rotate directions about the normals by an angle in radians, counter-clockwise."""
    angle = np.broadcast_to(angle, len(ahead))[:, None]
    return np.cos(angle) * ahead + np.sin(angle) * np.cross(normals, ahead)
