"""All that stays fixed while the field learns: meshes, renderer, encoder, views, and the target."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from styleexp import meshes, styles
from styleexp.config import check
from styleexp.encoders import load_encoder
from styleexp.errors import UserError
from styleexp.geometry import Surface, vertex_areas
from styleexp.losses import StyleLoss
from styleexp.registry import build
from styleexp.renderers.base import Shading
from styleexp.renderers.specs import RENDERERS
from styleexp.sources import load_source, load_style
from styleexp.viewer import Viewer
from styleexp.views import orbit

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from styleexp.config import Config, StyleConfig
    from styleexp.renderers.base import Renderer
    from styleexp.styles import StyleTarget


@dataclass(frozen=True)
class Scene:
    """What a run optimises in. Tensors are in the normalised source's frame."""

    config: Config
    source: meshes.Mesh
    style: meshes.Mesh | np.ndarray
    """A mesh, or an image of shape (height, width, 3) in [0, 1]."""
    frame: meshes.Normalisation
    surface: Surface
    areas: Float[Tensor, " vertices"]
    viewer: Viewer
    loss: StyleLoss
    target: StyleTarget
    scales: tuple[list[Tensor], list[Tensor]]
    """What the distances of the global and the local views are divided by, for each layer."""
    notes: tuple[str, ...] = ()
    """What the user should know: repairs, a mesh too coarse for the style."""


def prepare(config: Config) -> Scene:
    """Load source, style, renderer and encoder, and measure the style."""
    check(config)
    device = choose_device(config.device)
    source = load_source(config.source)
    style = load_style(config.style)
    frame, surface = normalised(source, device)
    renderer = build("renderer", RENDERERS, config.renderer)
    grey = foreground_mean(config, renderer, surface)
    shading = choose_shading(config, grey)
    encoder = load_encoder(
        config.encoder.name,
        precision=config.encoder.precision,
        pooling=config.encoder.pooling,
        normalisation=config.encoder.normalisation,
        device=device,
        seed=config.optim.seed,
    )
    loss = StyleLoss(config.loss, encoder)
    viewer = Viewer(config, renderer, shading, surface)
    notes = list(source.repairs)
    if isinstance(style, meshes.Mesh):
        target = mesh_target(config, loss, renderer, shading, source, style, device)
    else:
        target = image_target(config, loss, style, grey, device)
    goal, own = target(0), styles.mesh_target(loss, viewer, surface.vertices)(0)
    return Scene(
        config=config,
        source=source,
        style=style,
        frame=frame,
        surface=surface,
        areas=vertex_areas(surface),
        viewer=viewer,
        loss=loss,
        target=target,
        scales=(loss.scales(goal[0], own[0]), loss.scales(goal[1], own[1])),
        notes=tuple(notes),
    )


def mesh_target(
    config: Config,
    loss: StyleLoss,
    renderer: Renderer,
    shading: Shading,
    source: meshes.Mesh,
    style: meshes.Mesh,
    device: torch.device,
) -> StyleTarget:
    """The target of a style mesh."""
    _, surface = normalised(style, device)
    scale = config.style.scale * scale_unit(config.style, source, style)
    viewer = Viewer(config, renderer, shading, surface, scale)
    if config.loss.target == "same_views":
        return styles.SameViewsTarget(loss, viewer, surface.vertices)
    return styles.mesh_target(loss, viewer, surface.vertices)


def image_target(
    config: Config, loss: StyleLoss, style: np.ndarray, grey: float, device: torch.device
) -> StyleTarget:
    """The target of a style image, in the tone of the source's renders."""
    rgb = torch.from_numpy(style).to(device)
    picture = styles.tone(rgb @ rgb.new_tensor([0.299, 0.587, 0.114]), grey, config.style)
    whole = config.loss.target == "same_views"
    batches = styles.whole_image_bank if whole else styles.image_bank
    return styles.FixedTarget(loss, batches(picture, config))


def scale_unit(config: StyleConfig, source: meshes.Mesh, style: meshes.Mesh) -> float:
    """What ``style.scale=1`` magnifies the style mesh by: see ``StyleConfig.scale_by``."""
    if config.scale_by == "frame":
        return 1.0
    areas = [
        meshes.face_areas(m.vertices, m.faces).sum() / meshes.normalisation(m.vertices).scale ** 2
        for m in (source, style)
    ]
    return float(np.sqrt(areas[0] / areas[1]))


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
    """The device asked for; ``auto`` is CUDA where there is one."""
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
    """The shading with its background as a number."""
    named = {"white": 1.0, "black": 0.0, "foreground": grey}
    background = config.shading.background
    return Shading(
        albedo=config.shading.albedo,
        normals=config.shading.normals,
        background=named[background] if background in named else float(background),
    )


def foreground_mean(config: Config, renderer: Renderer, surface: Surface) -> float:
    """Mean grey of the mesh itself over eight views around it."""
    shading = Shading(albedo=config.shading.albedo, normals=config.shading.normals)
    azimuth = torch.arange(8, device=surface.vertices.device) * (math.pi / 4)
    cameras = orbit(torch.zeros_like(azimuth), azimuth, config.views.distance, config.views.fov)
    with torch.no_grad():
        out = renderer.render(surface.vertices, surface.faces, cameras, shading, (64, 64))
    seen = out.coverage > 0.99
    return float(out.image[seen].mean()) if bool(seen.any()) else 0.5
