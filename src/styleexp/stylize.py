"""The paper on one page: a displacement field, learned until the renders' Grams match the style's.

source mesh C ──► Fourier features ──► MLP ──► d ──► M = C + d n          Sec. 3.2, Eq. 1
M ──► differentiable renderer ──► global and local views                  Sec. 3.3.1, Eq. 2
views ──► VGG ──► Gram matrices ──► distance to the style's               Sec. 3.3.2-3, Eqs. 3-8
"""

from __future__ import annotations

import math
import sys
import time
import types
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from styleexp import meshes, styles
from styleexp.compose import compose
from styleexp.encoders import load_encoder
from styleexp.errors import UserError
from styleexp.fields import DisplacementField, zero_mean
from styleexp.geometry import vertex_areas
from styleexp.losses import StyleLoss
from styleexp.registry import build
from styleexp.renderers.base import Shading
from styleexp.renderers.specs import RENDERERS
from styleexp.sources import load_source, load_style
from styleexp.viewer import Viewer
from styleexp.views import orbit, step_generator

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from torch import Tensor

    from styleexp.config import Config, SourceConfig, StyleConfig
    from styleexp.renderers.base import Renderer
    from styleexp.styles import StyleTarget


@dataclass(frozen=True)
class Scene:
    """All that stays fixed during a run. Tensors are in the normalised source's frame."""

    config: Config
    source: meshes.Mesh
    style: meshes.Mesh | np.ndarray
    """A mesh, or an image of shape (height, width, 3) in [0, 1]."""
    frame: meshes.Normalisation
    vertices: Float[Tensor, "vertices 3"]
    faces: Int[Tensor, "faces 3"]
    normals: Float[Tensor, "vertices 3"]
    areas: Float[Tensor, " vertices"]
    viewer: Viewer
    loss: StyleLoss
    target: StyleTarget
    scales: tuple[list[Tensor], list[Tensor]]
    """What the distances of the global and the local views are divided by, for each layer."""
    notes: tuple[str, ...] = ()
    """What the user should know: repairs, a mesh too coarse for the style."""


@dataclass
class State:
    """All that a step changes: what a checkpoint holds."""

    field: DisplacementField
    optimizer: torch.optim.Adam
    step: int = 0


@dataclass(frozen=True)
class Step:
    """What one step of the optimisation measured."""

    step: int
    loss: float
    loss_global: float
    loss_local: float
    rms_displacement: float
    seconds: float = field(compare=False)


@dataclass(frozen=True)
class Result:
    """The generated mesh M."""

    scene: Scene
    displacement: Float[np.ndarray, " vertices"]
    """Signed, along the source's normals, in the source's own units."""
    vertices: Float[np.ndarray, "vertices 3"]
    """In the source's own frame."""

    def save(self, path: str | Path) -> None:
        """Write M as PLY (with the displacement as a vertex attribute), OBJ or GLB."""
        meshes.save_mesh(self.scene.source, self.vertices, path, self.displacement)


def stylize(source: str | Path, style: str | Path, *overrides: str) -> Result:
    """Put the local geometry of ``style``, a mesh or picture, onto the mesh ``source``.

    Both are names or files (what has a suffix or a folder is a file). ``overrides`` are those of the
    command line: ``stylize("my.obj", "bubble", "profile=fast", "field.sigma=3")``. Writes nothing;
    ``save`` of what it returns does. Raises `UserError` for what the command line would report.
    """
    config = compose(overrides)
    point_at(config.source, source)
    point_at(config.style, style)
    scene = prepare(config)
    state = start(scene)
    for _ in optimise(scene, state):
        pass
    return finish(scene, state)


def prepare(config: Config) -> Scene:
    """Load source, style, renderer and encoder, and measure the style."""
    device = choose_device(config.device)
    source = load_source(config.source)
    style = load_style(config.style)
    frame, vertices, faces, normals = to_tensors(source, device)
    renderer = build("renderer", RENDERERS, config.renderer)
    shading = choose_shading(config, renderer, vertices, faces)
    encoder = load_encoder(
        config.encoder.name,
        precision=config.encoder.precision,
        pooling=config.encoder.pooling,
        normalisation=config.encoder.normalisation,
        device=device,
        seed=config.optim.seed,
    )
    loss = StyleLoss(config.loss, encoder)
    seed, light = config.optim.seed, config.shading.light
    viewer = Viewer(
        config.views, renderer, shading, vertices, faces, normals, light=light, seed=seed
    )
    if isinstance(style, meshes.Mesh):
        _, style_vertices, style_faces, style_normals = to_tensors(style, device)
        style_viewer = Viewer(
            config.views,
            renderer,
            shading,
            style_vertices,
            style_faces,
            style_normals,
            light=light,
            scale=config.style.scale * scale_unit(config.style, source, style),
            seed=seed,
        )
        target: StyleTarget
        if config.loss.target == "same_views":
            target = styles.SameViewsTarget(loss, style_viewer, style_vertices)
        else:
            target = styles.FixedTarget(
                loss, styles.mesh_bank(style_viewer, style_vertices, config.loss.bank_views)
            )
    else:
        picture = torch.from_numpy(style).to(device) @ vertices.new_tensor([0.299, 0.587, 0.114])
        picture = styles.tone(
            picture, foreground_mean(renderer, shading, vertices, faces), config.style
        )
        if config.loss.target == "same_views":
            batches = styles.whole_image_bank(picture, config.views, config.loss.bank_views, seed)
        else:
            batches = styles.image_bank(
                picture, config.style, config.views, config.loss.bank_views, seed
            )
        target = styles.FixedTarget(loss, batches)
    own = styles.FixedTarget(loss, styles.mesh_bank(viewer, vertices, config.loss.bank_views))(0)
    goal = target(0)
    return Scene(
        config,
        source,
        style,
        frame,
        vertices,
        faces,
        normals,
        vertex_areas(vertices, faces),
        viewer,
        loss,
        target,
        (loss.scales(goal[0], own[0]), loss.scales(goal[1], own[1])),
        source.repairs,
    )


def start(scene: Scene) -> State:
    """The state before the first step: M = C."""
    optim = scene.config.optim
    displacement_field = DisplacementField(scene.config.field, step_generator(optim.seed, 0, 7))
    displacement_field.to(scene.vertices.device)
    return State(
        displacement_field, torch.optim.Adam(displacement_field.parameters(), lr=optim.rate)
    )


def optimise(scene: Scene, state: State) -> Iterator[Step]:
    """Run the remaining steps, yielding after each; ``state`` may be saved between them."""
    optim, loss = scene.config.optim, scene.loss
    while state.step < optim.steps:
        begun = time.perf_counter()
        for group in state.optimizer.param_groups:
            group["lr"] = optim.rate * optim.decay ** (state.step // optim.decay_every)

        displacement = displace(scene, state)
        generated = scene.vertices + displacement[:, None] * scene.normals
        if optim.renormalize:
            generated = generated / generated.detach().norm(dim=1).max()
        whole, local = scene.viewer(generated, state.step)
        whole_target, local_target = scene.target(state.step)
        loss_global = loss.distance(
            loss.grams(whole.image, whole.coverage), whole_target, scene.scales[0]
        )
        loss_local = loss.distance(
            loss.grams(local.image, local.coverage), local_target, scene.scales[1]
        )
        total = loss.config.lambda_global * loss_global + loss.config.lambda_local * loss_local

        state.optimizer.zero_grad()
        total.backward()
        state.optimizer.step()
        if not math.isfinite(total.item()):
            raise UserError(
                f"the loss became {total.item()} at step {state.step}: lower optim.rate, or check "
                f"'{scene.source.name}' for degenerate geometry."
            )
        state.step += 1
        yield Step(
            state.step,
            total.item(),
            loss_global.item(),
            loss_local.item(),
            displacement.detach().square().mean().sqrt().item(),
            time.perf_counter() - begun,
        )


def displace(
    scene: Scene, state: State, precision: torch.dtype | None = None
) -> Float[Tensor, " vertices"]:
    """The displacement of every vertex, in radii of the normalised source."""
    config = scene.config.field
    if precision is None:
        precision = torch.bfloat16 if scene.loss.encoder.precision == "bf16" else torch.float32
    opened = 1.0
    if config.progressive > 0:
        opened = min(1.0, state.step / (config.progressive * scene.config.optim.steps))
    displacement = state.field(state.field.encode(scene.vertices, opened), precision)
    if config.zero_mean:
        displacement = zero_mean(displacement, scene.areas, config.bound)
    return displacement


def finish(scene: Scene, state: State) -> Result:
    """The generated mesh in the source's own frame; the field is evaluated in float32."""
    with torch.no_grad():
        displacement = displace(scene, state, torch.float32).double() * scene.config.strength
    offset = displacement[:, None] * scene.normals.double()
    radius = float(scene.frame.scale)
    return Result(
        scene,
        displacement.cpu().numpy() * radius,
        scene.source.vertices + offset.cpu().numpy() * radius,
    )


def scale_unit(config: StyleConfig, source: meshes.Mesh, style: meshes.Mesh) -> float:
    """What ``style.scale=1`` magnifies the style mesh by: see ``StyleConfig.scale_by``."""
    if config.scale_by == "frame":
        return 1.0
    areas = [
        meshes.face_areas(m.vertices, m.faces).sum() / meshes.normalisation(m.vertices).scale ** 2
        for m in (source, style)
    ]
    return float(np.sqrt(areas[0] / areas[1]))


def point_at(part: SourceConfig | StyleConfig, what: str | Path) -> None:
    """Set ``part.path`` if ``what`` looks like a file, else ``part.name``."""
    is_file = Path(what).suffix != "" or Path(what).name != str(what)
    setattr(part, "path" if is_file else "name", str(what))


def to_tensors(mesh: meshes.Mesh, device: torch.device):  # type: ignore[no-untyped-def]
    """Normalisation, and normalised vertices, faces and unit normals on the device."""
    frame = meshes.normalisation(mesh.vertices)
    vertices = frame.apply(mesh.vertices)
    normals = meshes.vertex_normals(vertices, mesh.faces)
    return (
        frame,
        torch.from_numpy(vertices).float().to(device),
        torch.from_numpy(mesh.faces).to(device),
        torch.from_numpy(normals).float().to(device),
    )


def choose_device(name: str) -> torch.device:
    """The device asked for; ``auto`` is CUDA where there is one."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise UserError(
            f"device={name} was asked for, but torch sees no CUDA device: use device=cpu."
        )
    return torch.device(name)


def choose_shading(
    config: Config,
    renderer: Renderer,
    vertices: Float[Tensor, "vertices 3"],
    faces: Int[Tensor, "faces 3"],
) -> Shading:
    """The shading with its background as a number."""
    shading = Shading(albedo=config.shading.albedo, normals=config.shading.normals)
    background = config.shading.background
    if background == "foreground":
        return replace(shading, background=foreground_mean(renderer, shading, vertices, faces))
    return replace(
        shading, background={"white": 1.0, "black": 0.0}.get(background) or float(background)
    )


def foreground_mean(
    renderer: Renderer,
    shading: Shading,
    vertices: Float[Tensor, "vertices 3"],
    faces: Int[Tensor, "faces 3"],
) -> float:
    """Mean grey of the mesh itself over eight views around it."""
    azimuth = torch.arange(8, device=vertices.device) * (math.pi / 4)
    cameras = orbit(torch.zeros_like(azimuth), azimuth, 2.0, 60.0)
    with torch.no_grad():
        out = renderer.render(vertices, faces, cameras, shading, (64, 64))
    seen = out.coverage > 0.99
    return float(out.image[seen].mean()) if bool(seen.any()) else 0.5


class _CallableModule(types.ModuleType):
    """Lets ``styleexp.stylize(...)`` work although importing this module puts the module itself
    there."""

    def __call__(self, source: str | Path, style: str | Path, *overrides: str) -> Result:
        return stylize(source, style, *overrides)


sys.modules[__name__].__class__ = _CallableModule
