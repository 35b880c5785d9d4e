"""What every method starts from: source and style in one frame, and what is measured on them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from styleexp.inputs import meshes
from styleexp.inputs.images import is_normal_map
from styleexp.inputs.style import Style
from styleexp.method import masks, pattern_size, pictures
from styleexp.method.pictures import Heights
from styleexp.method.refinement import refined
from styleexp.method.relief import half_range, mesh_frequency, mesh_relief, picture_frequency
from styleexp.method.surface import Surface, normalised, vertex_areas
from styleexp.method.synthesis.exemplar import MeshExemplar
from styleexp.system.errors import UserError
from styleexp.system.progress import doing

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from styleexp.method.options import FieldConfig, Settings, StyleConfig


BOUND_MARGIN = 2.0
"""Displacement bound as a multiple of the style's own relief."""

PICTURE_STEEPNESS = 0.2
"""Assumed half range of an image's relief, in wavelengths, since an image doesn't determine its
height. The analytic styles have 0.10 to 0.16, on whose finest detail less depends."""

PICTURE_DETAIL = 128
"""Longer side, in pixels, at which an image's frequency is measured; finer detail is ignored."""


STRAY = 5.0
"""Distance of a vertex, as a multiple of the 99th percentile, above which its faces are stray."""


@dataclass(frozen=True, kw_only=True)
class Subject:
    """Inputs of a run, and their measures. Tensors are in the normalised source's frame."""

    settings: Settings
    source: meshes.Mesh
    style: Style
    frame: meshes.Normalisation
    surface: Surface
    areas: Float[Tensor, " vertices"]
    unit: float
    """Size of a unit pattern on the normalised source; see `pattern_size`."""
    sigma: float
    """Standard deviation of the Fourier frequencies, in cycles per radius of the normalised
    source."""
    bound: float
    """Displacements lie in [-bound, bound], in radii of the normalised source."""
    relief: float
    """Half the range of the style's own relief, in radii of the normalised source."""
    heights: Heights | None = None
    """Heights of an image style; None for a mesh."""
    example: MeshExemplar | None = None
    """A style mesh's relief apart from its shape, for methods that separate them."""
    smooth: bool = False
    """Whether no relief was found when separating it."""
    mask: Float[Tensor, " vertices"] | None = None
    """Factor on the displacement, 0 to 1 (``style.mask``); None is 1 everywhere."""
    notes: tuple[str, ...] = ()
    """Notes for the user, such as repairs or a mesh too coarse for the style."""

    @property
    def weights(self) -> Float[Tensor, " vertices"]:
        """Area weight of each vertex in means over the surface that gets relief."""
        return self.areas if self.mask is None else self.areas * self.mask


def measure(
    settings: Settings,
    source: meshes.Mesh,
    style: Style,
    device: torch.device,
    *,
    separate: bool = False,
    as_tone: bool = False,
) -> Subject:
    """Measure the style, refine the source for it (``source.refine``), and normalise the source.

    Args:
        settings: the options.
        source: the source mesh.
        style: the style.
        device: device of the subject's tensors.
        separate: separate a style mesh's relief from its shape (``method=synthesis``).
        as_tone: the method compares renders with an image's tone, so that ``style.kind=auto`` is a
            photo.

    Raises:
        UserError: options that don't fit the style, or a mask or direction that the source lacks
            the data for.
    """
    masks.check(settings.style, source)
    doing(f"measuring the source ({len(source.faces):,} faces) and the style")
    heights = heights_of(settings.style, style, as_tone)
    unit = pattern_size.pattern_unit(settings.style, source, style)
    sigma, bound, height = choose_field(settings.field, style, heights, settings.style.image_tile)
    size = 1.0 if settings.style.scale_by == "frame" else unit
    example, smooth = None, False
    if separate:
        doing("separating the style's relief from its shape")
        found = pattern_size.example_of(settings.style, style)
        smooth = found is None
        if found is not None and settings.field.sigma is None:
            sigma = min(max(found.frequency, 1.0), 10.0)
        if isinstance(found, MeshExemplar):
            example = found
    if heights is not None and heights.in_proportion:
        side = pictures.picture_side(settings.style, unit)
        height = pictures.spread(heights.height) * side / size
        bound = BOUND_MARGIN * height if settings.field.bound is None else bound
    given_size = 1.0 if settings.field.unit == "source" else size
    sigma /= size if settings.field.sigma is None else given_size
    bound *= size if settings.field.bound is None else given_size
    if settings.source.refine != "none" and not smooth:
        doing("refining the source for the style")
        source = refined(source, 1 / sigma, settings.source.refine)
    frame, surface = normalised(source, device)
    areas = vertex_areas(surface)
    mask, share = placed(settings.style, source, areas)
    return Subject(
        settings=settings,
        source=source,
        style=style,
        heights=heights,
        example=example,
        smooth=smooth,
        frame=frame,
        surface=surface,
        areas=areas,
        mask=mask,
        unit=unit,
        sigma=sigma,
        bound=bound,
        relief=height * size,
        notes=(
            *source.repairs,
            *(f"style: {repair}" for repair in style.repairs),
            *stray_faces("source", source),
            *(stray_faces("style", style.mesh) if style.mesh is not None else ()),
            *too_coarse(source, 1 / sigma, settings.source.refine),
            *share,
            *mistaken(settings.style, style, heights),
            *(no_relief(style) if smooth else ()),
        ),
    )


def heights_of(config: StyleConfig, style: Style, as_tone: bool) -> Heights | None:
    """Heights of an image style; None for a mesh, for which options that only apply to images are
    refused."""
    if style.picture is not None:
        if config.relief_length is not None:
            raise UserError(
                f"style.relief_length={config.relief_length} separates a style mesh's relief "
                "from its shape, but the style is a picture: leave it out."
            )
        return pictures.picture_height(config, style.picture, as_tone)
    for key, plain in (("kind", "auto"), ("invert", False), ("image_depth", None)):
        if (value := getattr(config, key)) != plain:
            raise UserError(
                f"style.{key}={str(value).lower()} only applies to pictures, but the style "
                f"'{style.mesh.name if style.mesh else style.name}' is a mesh: leave it out."
            )
    return None


def placed(
    config: StyleConfig, source: meshes.Mesh, areas: Float[Tensor, " vertices"]
) -> tuple[Float[Tensor, " vertices"] | None, list[str]]:
    """``style.mask`` at the source's vertices, and a note on the fraction of the surface it
    selects."""
    if config.mask is None:
        return None, []
    mask = torch.from_numpy(masks.weights(config, source)).to(areas)
    share = float((areas * mask).sum() / areas.sum())
    return mask, [f"the relief covers {100 * share:.1f} % of the surface (style.mask)"]


def choose_field(
    config: FieldConfig, style: Style, heights: Heights | None = None, tile: float = 1.0
) -> tuple[float, float, float]:
    """sigma, bound and the half range of the relief, in radii of the style: as configured, or
    measured on the style. An image style needs its ``heights`` and its size
    (``style.image_tile``)."""
    if heights is None:
        assert style.mesh is not None
        vertices = meshes.normalisation(style.mesh.vertices).apply(style.mesh.vertices)
        normals = meshes.vertex_normals(vertices, style.mesh.faces)
        relief = mesh_relief(vertices, style.mesh.faces, normals, length=0.5)
        frequency = mesh_frequency(relief, vertices, style.mesh.faces)
        height = min(max(half_range(relief), 0.005), 0.05)
    else:
        small = pictures.resized(heights.height, PICTURE_DETAIL)
        frequency = picture_frequency(small.numpy()) / (math.sqrt(4 * math.pi) * tile)
        height = PICTURE_STEEPNESS / min(max(frequency, 1.0), 10.0)
    sigma = min(max(frequency, 1.0), 10.0) if config.sigma is None else config.sigma
    bound = BOUND_MARGIN * height if config.bound is None else config.bound
    return sigma, bound, height


def too_coarse(mesh: meshes.Mesh, wavelength: float, refine: str) -> list[str]:
    """A note if the mesh's edges are too long for details of this size, in radii, although it was
    refined as ``source.refine`` says."""
    edge = meshes.mean_edge_length(mesh.vertices, mesh.faces)
    edge /= meshes.normalisation(mesh.vertices).scale
    if edge <= wavelength / 4:
        return []
    way = {
        "none": "add source.refine=auto, which keeps texture coordinates",
        "auto": "a larger style.scale makes them larger",
    }.get(refine, f"source.refine={refine} is too few faces, auto takes as many as it needs")
    return [
        f"'{mesh.name}' is too coarse for this style: its edges are {edge:.3f} radii long, and the "
        f"style's details about {wavelength:.3f}; {way}."
    ]


def mistaken(config: StyleConfig, style: Style, heights: Heights | None) -> list[str]:
    """A note on a normal map whose colours this method can only read as tone."""
    if heights is None or style.picture is None or config.kind != "auto":
        return []
    if heights.in_proportion:
        way = "down (DirectX)" if heights.kind == "normal_dx" else "up (OpenGL)"
        return [
            f"'{style.name}' is read as a normal map, green {way} (detected by style.kind=auto)"
        ]
    if not is_normal_map(style.picture):
        return []
    return [
        f"'{style.name}' looks like a normal map: its colours are read as tone, not as directions; "
        "method=synthesis and method=displacement_map read it as one."
    ]


def no_relief(style: Style) -> list[str]:
    """A note on a style without relief."""
    return [
        f"the style '{style.name}' has no relief, its surface is smooth: the source is left "
        "unchanged"
    ]


def stray_faces(what: str, mesh: meshes.Mesh) -> list[str]:
    """A note if a few faces lie so far away that the rest is tiny in the unit sphere, and so in all
    views."""
    distance = np.linalg.norm(mesh.vertices - np.median(mesh.vertices, axis=0), axis=1)
    bulk = float(np.quantile(distance, 0.99))
    far = (distance[mesh.faces] > 3 * bulk).any(axis=1)
    if distance.max() <= STRAY * bulk or not far.any():
        return []
    first = int(far.argmax())
    x, y, z = mesh.vertices[mesh.faces[first]].mean(axis=0)
    return [
        f"{far.sum()} of the {len(far)} faces of the {what} '{mesh.name}' are far from all others "
        f"(the first has index {first}, at {x:.4g}, {y:.4g}, {z:.4g}): delete them in a mesh "
        f"editor, or the rest fills only {100 * bulk / distance.max():.0f} % of every view."
    ]
