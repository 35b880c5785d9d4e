"""How fine the source must be for a relief (``source.refine``)."""

from __future__ import annotations

import math

from styleexp.inputs import meshes

EDGES_PER_WAVELENGTH = 12.0
"""Number of longest edges per wavelength of the style's relief when refining the source; half as
many blur the grooves between bubbles."""
MAX_FACES = 200_000
"""Maximum number of faces that refining aims for."""
MEAN_TO_LONGEST = 0.65
"""Ratio of mean to longest edge after refining, which halves edges."""


def refined(mesh: meshes.Mesh, wavelength: float, how: str) -> meshes.Mesh:
    """Refine the mesh until its edges are short enough for a relief of this wavelength, in radii.
    ``how`` is ``source.refine``: a target number of faces, or ``auto``, at most `MAX_FACES`."""
    scale = meshes.normalisation(mesh.vertices).scale
    area = meshes.face_areas(mesh.vertices, mesh.faces).sum()
    faces = MAX_FACES if how == "auto" else float(how)
    longest = math.sqrt(area / (faces * math.sqrt(3) / 4)) / MEAN_TO_LONGEST
    if how == "auto":
        return meshes.refine(mesh, max(wavelength / EDGES_PER_WAVELENGTH * scale, longest))
    # On a uniform mesh, a tiny change of the length decides if all edges are halved or only some.
    low, high = longest / 2, longest * 2
    fine = mesh
    for _ in range(8):
        longest = math.sqrt(low * high)
        fine = meshes.refine(mesh, longest)
        if abs(math.log(len(fine.faces) / faces)) < 0.1:
            break
        low, high = (longest, high) if len(fine.faces) > faces else (low, longest)
    return fine
