"""Checks of what a style's factory returns: ``check_style(content)``."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from styleexp.inputs.meshes import Mesh
from styleexp.inputs.meshes.mesh import face_areas
from styleexp.testing import checks

Content = Mesh | np.ndarray


def a_mesh_or_a_picture(content: Content) -> None:
    """A `styleexp.Mesh`, or an image of shape (height, width, 3) of floats in [0, 1]."""
    if isinstance(content, Mesh):
        return
    assert isinstance(content, np.ndarray), f"a {type(content).__name__}"
    assert content.ndim == 3, f"shape {content.shape}"
    assert content.shape[2] == 3, f"shape {content.shape}"
    assert content.dtype.kind == "f", f"{content.dtype}, not floats"
    assert np.isfinite(content).all(), "not finite"
    assert 0 <= content.min() <= content.max() <= 1, f"from {content.min()} to {content.max()}"


def a_picture_has_contrast(content: Content) -> None:
    """A picture isn't of one tone."""
    if isinstance(content, Mesh):
        raise checks.NotApplicable("it is a mesh")
    assert np.ptp(content) > 0.01, "one tone"


def a_mesh_is_sound(content: Content) -> None:
    """A mesh has finite vertices, faces that refer to them, no face without area, and, if it is
    closed, outward winding."""
    if not isinstance(content, Mesh):
        raise checks.NotApplicable("it is a picture")
    vertices, faces = content.vertices, content.faces
    assert vertices.shape[1:] == (3,), f"vertices of shape {vertices.shape}"
    assert faces.shape[1:] == (3,), f"faces of shape {faces.shape}"
    assert np.isfinite(vertices).all(), "vertices that are not finite"
    assert len(faces) >= 4, f"{len(faces)} faces"
    assert 0 <= faces.min() <= faces.max() < len(vertices), "faces of vertices that aren't there"
    assert face_areas(vertices, faces).min() > 0, "faces without area"
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    if (counts == 2).all():
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        assert (a * np.cross(b, c)).sum() > 0, "its faces wind clockwise seen from outside"


CHECKS: tuple[Callable[[Content], None], ...] = (
    a_mesh_or_a_picture,
    a_picture_has_contrast,
    a_mesh_is_sound,
)


def check_style(content: Content) -> dict[str, str]:
    """Run every check; see `checks.run`."""
    return checks.run(CHECKS, content)
