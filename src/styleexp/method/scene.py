"""What stays fixed while the paper's loop runs: views, loss, target and base displacement."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import torch

from styleexp.method import height_maps, targets
from styleexp.method.base import Scene
from styleexp.method.baselines.options import SynthesisConfig
from styleexp.method.subject import stray_faces
from styleexp.method.surface import Surface, normalised
from styleexp.method.viewer import Viewer
from styleexp.method.views import orbit
from styleexp.renderers.base import Shading
from styleexp.system.errors import UserError
from styleexp.system.progress import doing
from styleexp.system.transfer import to_host

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from styleexp.encoders.base import Encoder
    from styleexp.method.losses import Loss, Statistics
    from styleexp.method.options import ShadingConfig, ViewsConfig
    from styleexp.method.subject import Subject
    from styleexp.method.targets import StyleTarget
    from styleexp.renderers.base import Renderer

Cache: TypeAlias = "Callable[[list[object], Callable[[], Pair]], Pair]"
"""Called with the inputs of a computation and the computation; see `gram_cache.GramCache`."""
Pair: TypeAlias = "tuple[Statistics, Statistics]"
"""Statistics of global and of local views."""


@dataclass(frozen=True)
class Parts:
    """The parts that the loop sees a mesh with."""

    renderer: Renderer
    encoder: Encoder
    loss: Loss


@dataclass(frozen=True, kw_only=True)
class PaperScene(Scene):
    """What the loop needs, and no step changes."""

    viewer: Viewer
    loss: Loss
    target: StyleTarget
    base: Float[Tensor, " vertices"] | None
    """Base displacement that the field adds to (``field.start``); None is zero."""
    scales: tuple[list[Tensor], list[Tensor]]
    """Divisors of the distances of global and local views; see `losses.Loss.scales`."""
    encoder: Encoder

    @property
    def skips_blank_views(self) -> bool:
        """Whether only the mesh counts for the loss."""
        return self.loss.masked

    @property
    def precision(self) -> torch.dtype:
        """Dtype that the field's costly part runs in, that of the encoder."""
        return torch.bfloat16 if self.encoder.precision == "bf16" else torch.float32


def prepare(subject: Subject, parts: Parts, cache: Cache) -> PaperScene:
    """Choose the shading, and describe the source and the style as the loss sees them.

    Raises `UserError` if the views don't see enough of the source or the style.
    """
    doing("applying the style's height map to the source")
    base, notes = base_of(subject)
    settings, surface, style = subject.settings, subject.surface, subject.style
    renderer, loss = parts.renderer, parts.loss.for_style(style)
    for_bank = targets.in_step(loss, settings.optim.seed, targets.BANK_STEP)
    grey = foreground_mean(settings.shading, settings.views, renderer, surface)
    shading = choose_shading(settings.shading, grey)
    lights = settings.shading.lights if style.mesh is not None else 1

    def viewer(mesh: Surface, scale: float) -> Viewer:
        return Viewer(
            settings.views,
            renderer,
            shading,
            mesh,
            seed=settings.optim.seed,
            scale=scale,
            lights=lights,
            light_frame=settings.shading.light_frame,
        )

    @functools.cache
    def own_viewer() -> Viewer:
        return viewer(surface, 1.0)

    def described(mesh: Surface, scale: float) -> targets.FixedTarget:
        """Statistics over a bank of views, cached across runs with the same inputs."""

        def make() -> Pair:
            doing(f"rendering views of {len(mesh.faces):,} faces for the target")
            seen_by = own_viewer() if mesh is surface else viewer(mesh, scale)
            bank = settings.loss.bank_views
            return targets.mesh_statistics(for_bank, seen_by, mesh.vertices, bank)

        device = str(mesh.vertices.device)
        known = mesh.on_cpu
        about = [known.vertices, known.faces, scale, lights, shading, device, style.mesh is None]
        return targets.FixedTarget(*cache(about, make))

    target: StyleTarget
    if style.mesh is not None:
        _, styled = normalised(style.mesh, surface.vertices.device)
        if settings.loss.target == "bank":
            target = described(styled, subject.unit)
        else:
            later = targets.OWN_VIEWS if settings.loss.target == "own_views" else 0
            target = targets.RenderedTarget(
                loss, viewer(styled, subject.unit), styled.vertices, later
            )
    else:
        assert style.picture is not None
        picture = torch.from_numpy(style.picture).to(surface.vertices.device)
        picture = targets.tone(picture, grey, settings.style)
        in_frame = settings.loss.target != "bank" and settings.style.scale_by == "frame"
        if in_frame or settings.loss.target == "whole":
            bank = targets.whole_image_bank(picture, settings)
        else:
            bank = targets.image_bank(picture, settings, subject.unit)
        target = targets.FixedTarget(*targets.mean_statistics(for_bank, bank))

    goal, own = target(0), described(surface, 1.0)(0)
    any_of = [torch.stack([each.any() for part in pair for each in part]) for pair in (own, goal)]
    there = torch.stack([each.any() for each in any_of]).tolist()
    for what, seen in zip(("source", "style"), there, strict=True):
        check_seen(what, seen, subject)
    return PaperScene(
        subject=subject,
        notes=notes,
        viewer=own_viewer(),
        loss=loss,
        target=target,
        base=base,
        scales=(for_bank.scales(goal[0], own[0]), for_bank.scales(goal[1], own[1])),
        encoder=parts.encoder,
    )


def check_seen(what: str, seen: bool, subject: Subject) -> None:
    """Raise `UserError` if all statistics of the source or of the style are zero."""
    if seen:
        return
    mesh = subject.source if what == "source" else subject.style.mesh
    if mesh is not None and (stray := stray_faces(what, mesh)):
        raise UserError(f"the views don't see the {what}: {stray[0]}")
    raise UserError(
        f"the views don't see enough of the {what}: it fully covers no cell of any style layer; "
        "lower views.distance, or raise views.resolution and views.local.size."
    )


def base_of(subject: Subject) -> tuple[Tensor | None, tuple[str, ...]]:
    """Base displacement of the field (``field.start``), and notes for the user."""
    start = subject.settings.field.start
    if start == "source" or subject.smooth:
        return None, ()
    if start == "synthesis":
        from styleexp.method.synthesis.method import relief

        return relief(subject, SynthesisConfig(), 1.0).float(), ()
    try:
        return height_maps.displacement(subject), ()
    except height_maps.NoPatch:
        assert subject.style.mesh is not None
        name = subject.style.mesh.name
        return None, (
            f"the style '{name}' is too coarse for a height map: the field starts at the source.",
        )


def foreground_mean(
    shading: ShadingConfig, views: ViewsConfig, renderer: Renderer, surface: Surface
) -> float:
    """Mean grey of the mesh's pixels over eight views around it."""
    look = Shading(albedo=shading.albedo, normals=shading.normals)
    azimuth = torch.arange(8) * (math.pi / 4)
    cameras = orbit(torch.zeros_like(azimuth), azimuth, views.distance, views.fov)
    with torch.no_grad():
        out = renderer.render(surface.vertices, surface.faces, cameras, look, (64, 64))
    image, coverage = to_host((out.image, out.coverage))
    seen = coverage > 0.99
    return float(image[seen].mean()) if bool(seen.any()) else 0.5


def choose_shading(config: ShadingConfig, grey: float) -> Shading:
    """The shading, with its background resolved to a number."""
    named = {"white": 1.0, "black": 0.0, "foreground": grey}
    background = config.background
    return Shading(
        albedo=config.albedo,
        normals=config.normals,
        outlines=config.outlines,
        background=named[background] if background in named else float(background),
    )
