"""Size of a style's pattern on a source (``style.scale``, ``style.scale_by``)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from styleexp.inputs import measured, meshes
from styleexp.method import pictures
from styleexp.method.refinement import MAX_FACES
from styleexp.method.synthesis.exemplar import PictureExemplar, pattern_of
from styleexp.method.synthesis.room import ball_radius
from styleexp.method.synthesis.shape import exemplar_of
from styleexp.method.synthesis.walk import Sheet

if TYPE_CHECKING:
    from jaxtyping import Float, Int

    from styleexp.method.options import StyleConfig
    from styleexp.method.subject import Style
    from styleexp.method.synthesis.exemplar import MeshExemplar

PER_PART = 0.65
"""Wavelength, in thicknesses of the source, at which a pattern is shrunk by the square root of 2
(``style.scale_by=parts``). Of sixteen pairs, raters liked those least that had most."""
MOST_SHRUNK = 0.35
"""Minimum factor on the size. A sheet with two sides, such as a garment, is thin, but not small."""
EDGE = 0.05
"""Maximum edge length, in radii, of the mesh on which the thickness is measured."""
OPEN = 1.0
"""Length of the boundary, relative to the square root of the area, from which a surface is open."""
POINTS = 5_000
"""Maximum number of vertices at which the thickness is measured."""
PIXELS = 512
"""Longer side at which a picture is measured."""
CARRIED = 6.0
"""Minimum number of mean edges, at the maximum number of faces, per wavelength of a picture's
detail: blades of grass are lumps on fewer."""
MOST_GROWN = 2.0
"""Maximum factor on a picture's size for its detail."""


def pattern_unit(config: StyleConfig, source: meshes.Mesh, style: Style) -> float:
    """Size of a unit pattern on the normalised source; see ``StyleConfig.scale_by``.

    An image is treated as covering the unit sphere.
    """
    if config.scale_by == "frame":
        return config.scale
    size = math.sqrt(4 * math.pi) if style.mesh is None else normalised_size(style.mesh)
    unit = normalised_size(source) / size
    if config.scale_by == "parts":
        unit *= finer(config, source, style, unit)
    return config.scale * unit


def finer(config: StyleConfig, source: meshes.Mesh, style: Style, unit: float) -> float:
    """Factor on a pattern's size by area, ``unit``: smaller on thin parts, but not too small for
    the detail of a picture."""
    example = example_of(config, style)
    if example is None:
        return 1.0
    ratio = pattern_of(example).wavelength * unit / (PER_PART * thickness(source))
    factor = max(1 / math.hypot(1, ratio), MOST_SHRUNK)
    if style.mesh is None:
        edge = normalised_size(source) / math.sqrt(MAX_FACES * math.sqrt(3) / 4)
        carried = CARRIED * edge * example.frequency / unit
        factor = max(factor, min(carried, MOST_GROWN))
    return factor


def normalised_size(mesh: meshes.Mesh) -> float:
    """Square root of the mesh's area in the unit sphere."""
    area = meshes.face_areas(mesh.vertices, mesh.faces).sum()
    return math.sqrt(area) / meshes.normalisation(mesh.vertices).scale


def example_of(config: StyleConfig, style: Style) -> MeshExemplar | PictureExemplar | None:
    """The style as an exemplar, whatever the source; None without relief. An image's heights are
    not scaled."""
    if style.mesh is not None:
        return exemplar_of(style.mesh, config.relief_length)
    assert style.picture is not None
    height = pictures.picture_height(config, style.picture).height
    height = pictures.resized(height, min(PIXELS, max(height.shape)))
    return PictureExemplar(height, pictures.picture_side(config, 1.0) / max(height.shape))


def _is_open(vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]) -> bool:
    """Whether a surface's boundary is so long that it has no inside, as of a terrain; not for a few
    small holes."""
    sides = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    edges, uses = np.unique(sides, axis=0, return_counts=True)
    a, b = edges[uses == 1].T
    length = np.linalg.norm(vertices[a] - vertices[b], axis=1).sum()
    return bool(length > OPEN * math.sqrt(meshes.face_areas(vertices, faces).sum()))


def thickness(source: meshes.Mesh) -> float:
    """Median over the surface, by area, of the diameter of the largest ball inside that touches
    it, in radii of the normalised source; at most 2, and 2 for an open surface."""
    given = {"vertices": source.vertices, "faces": source.faces}
    return float(measured.kept("thickness", given, "", lambda: _thickness(source))["thickness"][0])


def _thickness(source: meshes.Mesh) -> measured.Arrays:
    unit = meshes.normalisation(source.vertices).apply(source.vertices)
    if _is_open(unit, source.faces):
        return {"thickness": np.array([2.0])}
    fine = meshes.refine(meshes.Mesh(source.name, unit, source.faces), EDGE)
    sheet = Sheet(fine.vertices, fine.faces)
    some = np.arange(0, len(fine.vertices), math.ceil(len(fine.vertices) / POINTS))
    radius = ball_radius(sheet, -1, 1.0, some)
    order = radius.argsort()
    share = sheet.areas[some][order].cumsum()
    middle = order[np.searchsorted(share, share[-1] / 2)]
    return {"thickness": 2 * radius[[middle]]}
