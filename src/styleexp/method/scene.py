"""Everything that stays fixed during optimisation: meshes, renderer, encoder, views and target.

`Subject` is the part that every method needs, including the baselines; `Scene` adds what the style
loss needs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from styleexp.config.schema import check
from styleexp.config.sources import load_source, load_style, refined
from styleexp.inputs import meshes
from styleexp.inputs.images import is_normal_map
from styleexp.method import gram_cache, height_maps, masks, pictures, targets
from styleexp.method.baselines.specs import SynthesisConfig
from styleexp.method.pictures import Heights
from styleexp.method.relief import half_range, mesh_frequency, mesh_relief, picture_frequency
from styleexp.method.surface import Surface, vertex_areas
from styleexp.method.viewer import Viewer
from styleexp.method.views import orbit
from styleexp.plugins import build
from styleexp.renderers.base import Shading
from styleexp.system.errors import UserError
from styleexp.system.progress import doing

if TYPE_CHECKING:
    from collections.abc import Callable

    from jaxtyping import Float
    from torch import Tensor

    from styleexp.config.schema import Config, FieldConfig, StyleConfig
    from styleexp.method.losses import Grams, StyleLoss
    from styleexp.method.synthesis.exemplar import MeshExemplar
    from styleexp.method.targets import StyleTarget
    from styleexp.renderers.base import Renderer


BOUND_MARGIN = 2.0
"""Displacement bound as a multiple of the style's own relief."""

PICTURE_STEEPNESS = 0.15
"""Assumed half range of an image's relief, in wavelengths, since an image doesn't determine its
height. The analytic styles have 0.10 to 0.16."""

PICTURE_DETAIL = 128
"""Longer side, in pixels, at which an image's frequency is measured; finer detail is ignored."""


STRAY = 5.0
"""Distance of a vertex, as a multiple of the 99th percentile, above which its faces are stray."""


@dataclass(frozen=True, kw_only=True)
class Subject:
    """Inputs of a run that every method needs. Tensors are in the normalised source's frame."""

    config: Config
    source: meshes.Mesh
    style: meshes.Mesh | np.ndarray
    """A mesh, or an image of shape (height, width, 3) in [0, 1]."""
    frame: meshes.Normalisation
    surface: Surface
    areas: Float[Tensor, " vertices"]
    unit: float
    """Size of a unit pattern on the normalised source; see `pattern_unit`."""
    sigma: float
    """Standard deviation of the Fourier frequencies, in cycles per radius of the normalised
    source."""
    bound: float
    """Displacements lie in (-bound, bound), in radii of the normalised source."""
    relief: float
    """Half the range of the style's own relief, in radii of the normalised source."""
    heights: Heights | None = None
    """Heights of an image style; None for a mesh."""
    example: MeshExemplar | None = None
    """Exemplar of a mesh style, for ``method=synthesis``."""
    smooth: bool = False
    """Whether ``method=synthesis`` found no relief on the style."""
    mask: Float[Tensor, " vertices"] | None = None
    """Factor on the displacement, 0 to 1 (``style.mask``); None is 1 everywhere."""
    notes: tuple[str, ...] = ()
    """Notes for the user, such as repairs or a mesh too coarse for the style."""

    @property
    def weights(self) -> Float[Tensor, " vertices"]:
        """Area weight of each vertex in means over the surface that gets relief."""
        return self.areas if self.mask is None else self.areas * self.mask


@dataclass(frozen=True, kw_only=True)
class Scene(Subject):
    """A `Subject` with everything that the style loss needs."""

    viewer: Viewer
    loss: StyleLoss
    target: StyleTarget
    base: Float[Tensor, " vertices"] | None
    """Base displacement that the field adds to (``field.start``); None is zero."""
    scales: tuple[list[Tensor], list[Tensor]]
    """Divisors of the distances of global and local views, per layer."""


def load(
    config: Config, relief_of: Callable[[meshes.Mesh], MeshExemplar | None] | None = None
) -> Subject:
    """Load source and style, and measure the style. ``relief_of`` separates a style mesh's relief
    from its shape (None if it has no relief); the source is then refined for that relief."""
    check(config)
    device = choose_device(config.device)
    source = load_source(config.source)
    masks.check(config.style, source)
    style = load_style(config.style)
    doing(f"measuring the source ({len(source.faces):,} faces) and the style")
    heights = heights_of(config, style)
    unit = pattern_unit(config.style, source, style if isinstance(style, meshes.Mesh) else None)
    sigma, bound, height = choose_field(config.field, style, heights, config.style.image_tile)
    size = 1.0 if config.style.scale_by == "frame" else unit
    example, smooth = None, False
    if relief_of is not None and isinstance(style, meshes.Mesh):
        doing("separating the style's relief from its shape")
        example = relief_of(style)
        smooth = example is None
        if example is not None and config.field.sigma is None:
            sigma = min(max(example.frequency, 1.0), 10.0)
    if heights is not None and heights.in_proportion:
        height = pictures.spread(heights.height) * height_maps.picture_side(config, unit) / size
        bound = BOUND_MARGIN * height if config.field.bound is None else bound
    given_size = 1.0 if config.field.unit == "source" else size
    sigma /= size if config.field.sigma is None else given_size
    bound *= size if config.field.bound is None else given_size
    if config.source.refine != "none" and not smooth:
        source = refined(source, 1 / sigma, config.source.refine)
    frame, surface = normalised(source, device)
    areas = vertex_areas(surface)
    mask, told = placed(config.style, source, areas)
    return Subject(
        config=config,
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
            *(f"style: {repair}" for repair in getattr(style, "repairs", ())),
            *stray_faces("source", source),
            *(stray_faces("style", style) if isinstance(style, meshes.Mesh) else ()),
            *too_coarse(source, 1 / sigma),
            *told,
            *mistaken(config, style, heights),
            *(no_relief(config.style) if smooth else ()),
        ),
    )


def heights_of(config: Config, style: meshes.Mesh | np.ndarray) -> Heights | None:
    """Heights of an image style; None for a mesh, for which options that only apply to images are
    refused."""
    if isinstance(style, np.ndarray):
        if config.style.relief_length is not None:
            raise UserError(
                f"style.relief_length={config.style.relief_length} separates a style mesh's relief "
                "from its shape, but the style is a picture: leave it out."
            )
        return pictures.picture_height(config, style)
    for key, plain in (("kind", "auto"), ("invert", False), ("image_depth", None)):
        if (value := getattr(config.style, key)) != plain:
            raise UserError(
                f"style.{key}={str(value).lower()} only applies to pictures, but the style "
                f"'{style.name}' is a mesh: leave it out."
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


def prepare(config: Config) -> Scene:
    """Load source, style, renderer and encoder, and measure the style."""
    relief_of = None
    if config.field.start == "synthesis":
        from styleexp.method.synthesis import method

        relief_of = method.relief_of(config)
    subject = load(config, relief_of)
    doing("applying the style's height map to the source")
    base, told = start_of(subject)
    surface, style, unit = subject.surface, subject.style, subject.unit
    device = surface.vertices.device
    renderer = build("renderer", config.renderer)
    grey = foreground_mean(config, renderer, surface)
    shading = choose_shading(config, grey)
    encoder = build("encoder", config.encoder, device=device, seed=config.optim.seed)
    loss_config = config.loss
    if loss_config.masked == "pictures":
        loss_config = replace(loss_config, masked=isinstance(style, np.ndarray))
    loss = build("loss", loss_config, encoder=encoder)
    lights = config.shading.lights if isinstance(style, meshes.Mesh) else 1
    viewer = Viewer(config, renderer, shading, surface, lights=lights)

    def measured(mesh: Surface, scale: float) -> targets.FixedTarget:
        """Grams over a bank of views, cached across runs with the same inputs."""
        about = [mesh.vertices, mesh.faces, scale, lights, shading, str(device)]

        def make() -> tuple[Grams, Grams]:
            doing(f"rendering views of {len(mesh.faces):,} faces for the target")
            seen = Viewer(config, renderer, shading, mesh, scale, lights)
            return targets.mesh_grams(loss, seen, mesh.vertices)

        return targets.FixedTarget(*gram_cache.grams(config, encoder, about, make))

    target: StyleTarget
    if isinstance(style, meshes.Mesh):
        _, styled = normalised(style, device)
        if config.loss.target != "bank":
            style_viewer = Viewer(config, renderer, shading, styled, unit, lights)
            later = targets.OWN_VIEWS if config.loss.target == "own_views" else 0
            target = targets.RenderedTarget(loss, style_viewer, styled.vertices, later)
        else:
            target = measured(styled, unit)
    else:
        picture = targets.tone(torch.from_numpy(style).to(device), grey, config.style)
        in_frame = config.loss.target != "bank" and config.style.scale_by == "frame"
        if in_frame or config.loss.target == "whole":
            bank = targets.whole_image_bank(picture, config)
        else:
            bank = targets.image_bank(picture, config, unit)
        target = targets.FixedTarget(*targets.mean_grams(loss, bank))
    goal, own = target(0), measured(surface, 1.0)(0)
    for what, grams in (("source", own), ("style", goal)):
        if not any(bool(gram.any()) for part in grams for gram in part):
            mesh = subject.source if what == "source" else style
            if isinstance(mesh, meshes.Mesh) and (stray := stray_faces(what, mesh)):
                raise UserError(f"the views don't see the {what}: {stray[0]}")
            raise UserError(
                f"the views don't see enough of the {what}: it fully covers no cell of any style "
                "layer; lower views.distance, or raise views.resolution and views.local.size."
            )
    return Scene(
        **{**vars(subject), "notes": (*subject.notes, *told)},
        viewer=viewer,
        loss=loss,
        target=target,
        base=base,
        scales=(loss.scales(goal[0], own[0]), loss.scales(goal[1], own[1])),
    )


def start_of(subject: Subject) -> tuple[Tensor | None, list[str]]:
    """Base displacement of the field (``field.start``), and notes for the user."""
    if subject.config.field.start == "source" or subject.smooth:
        return None, []
    if subject.config.field.start == "synthesis":
        from styleexp.method.synthesis.method import relief

        return relief(subject, SynthesisConfig(), 1.0).float(), []
    try:
        return height_maps.displacement(subject), []
    except height_maps.NoPatch:
        assert isinstance(subject.style, meshes.Mesh)
        name = subject.style.name
        return None, [
            f"the style '{name}' is too coarse for a height map: the field starts at the source."
        ]


def pattern_unit(config: StyleConfig, source: meshes.Mesh, style: meshes.Mesh | None) -> float:
    """Size of a unit pattern on the normalised source; see ``StyleConfig.scale_by``.

    An image (``style`` None) is treated as covering the unit sphere.
    """
    if config.scale_by == "frame":
        return config.scale
    sphere = math.sqrt(4 * math.pi)
    unit = 1.0 if style is None else normalised_size(style) / sphere
    return config.scale * normalised_size(source) / sphere / unit


def choose_field(
    config: FieldConfig,
    style: meshes.Mesh | np.ndarray,
    heights: Heights | None = None,
    tile: float = 1.0,
) -> tuple[float, float, float]:
    """sigma, bound and the half range of the relief, in radii of the style: as configured, or
    measured on the style. An image style needs its ``heights`` and its size
    (``style.image_tile``)."""
    if heights is None:
        assert isinstance(style, meshes.Mesh)
        vertices = meshes.normalisation(style.vertices).apply(style.vertices)
        normals = meshes.vertex_normals(vertices, style.faces)
        relief = mesh_relief(vertices, style.faces, normals, length=0.5)
        frequency = mesh_frequency(relief, vertices, style.faces)
        height = min(max(half_range(relief), 0.005), 0.05)
    else:
        small = targets.resized(heights.height, PICTURE_DETAIL)
        frequency = picture_frequency(small.numpy()) / (math.sqrt(4 * math.pi) * tile)
        height = PICTURE_STEEPNESS / min(max(frequency, 1.0), 10.0)
    sigma = min(max(frequency, 1.0), 10.0) if config.sigma is None else config.sigma
    bound = BOUND_MARGIN * height if config.bound is None else config.bound
    return sigma, bound, height


def too_coarse(mesh: meshes.Mesh, wavelength: float) -> list[str]:
    """A note if the mesh's edges are too long for details of this size, in radii."""
    edge = meshes.mean_edge_length(mesh.vertices, mesh.faces)
    edge /= meshes.normalisation(mesh.vertices).scale
    if edge <= wavelength / 4:
        return []
    return [
        f"'{mesh.name}' is too coarse for this style: its edges are {edge:.3f} radii long, and the "
        f"style's details about {wavelength:.3f}; add source.refine=auto, which keeps texture "
        "coordinates."
    ]


def mistaken(config: Config, style: meshes.Mesh | np.ndarray, heights: Heights | None) -> list[str]:
    """A note on a normal map whose colours this method can only read as tone."""
    if heights is None or isinstance(style, meshes.Mesh) or config.style.kind != "auto":
        return []
    name = config.style.path or config.style.name
    if heights.in_proportion:
        way = "down (DirectX)" if heights.kind == "normal_dx" else "up (OpenGL)"
        return [f"'{name}' is read as a normal map, green {way} (detected by style.kind=auto)"]
    if not is_normal_map(style):
        return []
    return [
        f"'{name}' looks like a normal map: its colours are read as tone, not as directions; "
        "method=synthesis and method=displacement_map read it as one."
    ]


def no_relief(config: StyleConfig) -> list[str]:
    """A note on a style without relief."""
    return [
        f"the style '{config.path or config.name}' has no relief, its surface is smooth: the "
        "source is left unchanged"
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


def normalised_size(mesh: meshes.Mesh) -> float:
    """Square root of the mesh's area in the unit sphere."""
    area = meshes.face_areas(mesh.vertices, mesh.faces).sum()
    return math.sqrt(area) / meshes.normalisation(mesh.vertices).scale


def normalised(mesh: meshes.Mesh, device: torch.device) -> tuple[meshes.Normalisation, Surface]:
    """The mesh in the unit sphere, on the device (Sec. 4.1)."""
    frame = meshes.normalisation(mesh.vertices)
    vertices = frame.apply(mesh.vertices)
    normals = meshes.vertex_normals(vertices, mesh.faces)
    surface = Surface(
        torch.from_numpy(vertices).float().to(device),
        torch.from_numpy(mesh.faces).to(device),
        torch.from_numpy(normals).float().to(device),
    )
    return frame, surface


def choose_device(name: str) -> torch.device:
    """The requested device; ``auto`` is CUDA if available."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise UserError(f"device={name} can't be used ({reason}): use device=cpu.") from error
    return device


def choose_shading(config: Config, grey: float) -> Shading:
    """The shading, with its background resolved to a number."""
    named = {"white": 1.0, "black": 0.0, "foreground": grey}
    background = config.shading.background
    return Shading(
        albedo=config.shading.albedo,
        normals=config.shading.normals,
        outlines=config.shading.outlines,
        background=named[background] if background in named else float(background),
    )


def foreground_mean(config: Config, renderer: Renderer, surface: Surface) -> float:
    """Mean grey of the mesh's pixels over eight views around it."""
    shading = Shading(albedo=config.shading.albedo, normals=config.shading.normals)
    azimuth = torch.arange(8, device=surface.vertices.device) * (math.pi / 4)
    cameras = orbit(torch.zeros_like(azimuth), azimuth, config.views.distance, config.views.fov)
    with torch.no_grad():
        out = renderer.render(surface.vertices, surface.faces, cameras, shading, (64, 64))
    seen = out.coverage > 0.99
    return float(out.image[seen].mean()) if bool(seen.any()) else 0.5
