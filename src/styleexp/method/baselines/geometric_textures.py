"""Geometric textures from a GAN on triangles, after Hertz et al. 2020, scaled down for a CPU.

*Deep Geometric Texture Synthesis* learns from one exemplar. At each of several subdivision levels,
a generator on faces displaces the vertices in any direction, and a critic on faces distinguishes
the result from the exemplar at that level (WGAN-GP; reconstruction from one fixed noise stabilises
the generator). Levels are trained one after the other, from coarse to fine. The generators then
displace another mesh, level by level. Written from the paper's description; docs/baselines.md lists
the differences.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import nn

from styleexp.inputs import meshes, shapes
from styleexp.method.base import Diverged, Method, Result, Scene, State
from styleexp.method.baselines.face_gan import Critic, Generator, Patch, gradient_penalty
from styleexp.method.baselines.pyramid import Level, pyramid, restrict, upsample
from styleexp.method.relief import smoother
from styleexp.method.subject import Subject
from styleexp.method.surface import Surface, vertex_areas
from styleexp.method.views import step_generator
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from collections.abc import Callable

    from jaxtyping import Float
    from torch import Tensor

    from styleexp.method.baselines.options import GeometricTexturesConfig

    Project = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]

NOISE = (1.0, 0.3)
"""Noise added to the input of the lowest level and of the others, relative to the exemplar's
RMS."""

PENALTY, RECONSTRUCTION = 1.0, 10.0
"""Weights of the gradient penalty and of the reconstruction."""

INNER = 0.5
"""Fraction of a patch's faces, the innermost, that the critic sees; rim faces lack neighbours."""

SMOOTH_LENGTH = 0.5
"""Length, in radii of the style mesh, above which features count as shape, not texture."""

TRAIN, RECALL, APPLY = 12, 13, 14
"""Streams of random numbers: training, the fixed noise, and the result's."""

LEAST_VERTICES, MOST_VERTICES = 20, 1_000_000
"""Limits on the vertices of source and style: minimum at the lowest level, maximum at the
highest."""


@dataclass(frozen=True, kw_only=True)
class TextureScene(Scene):
    """Exemplar and source at every level. The subject's source is the source's finest level."""

    exemplar: list[Level]
    fields: list[Tensor]
    """The exemplar's texture per level: displacements (vertices, 3), in radii of the style."""
    levels: list[Level]
    """The source's levels, in radii of the normalised source."""


@dataclass(frozen=True)
class TextureStep:
    """Measurements, averaged over the iterations of one step."""

    step: int
    level: int
    loss: float
    """The generator's loss."""
    critic: float
    """Critic score of the exemplar minus that of the generated texture."""
    penalty: float
    reconstruction: float
    """Mean squared error, relative to the mean square of the exemplar's texture."""
    seconds: float = field(compare=False)


@dataclass(frozen=True)
class GeometricTextures(Method[TextureScene]):
    """The geometric-textures baseline: see the module."""

    config: GeometricTexturesConfig

    def __post_init__(self) -> None:
        check_size("style", self.config.base, self.config.levels)

    def prepare(self, subject: Subject) -> TextureScene:
        """Subdivide exemplar and source."""
        if subject.style.mesh is None:
            raise UserError(
                "method=geometric_textures learns from a mesh, and the style "
                f"'{subject.style.name}' is a picture: give a mesh as style, or choose another "
                "method."
            )
        steps = subject.settings.optim.steps
        if steps < self.config.levels:
            raise UserError(
                f"optim.steps={steps} leaves a level untrained: give at least "
                f"baseline.levels={self.config.levels} steps."
            )
        device = subject.surface.vertices.device
        exemplar, fields = fit_exemplar(
            subject.style.mesh, self.config.base, self.config.levels, device
        )
        # Triangles of the exemplar's size, relative to the pattern.
        area = float(_area(subject.surface.vertices, subject.surface.faces))
        own = float(_area(exemplar[0].base, exemplar[0].faces)) * subject.unit**2
        count = round(len(exemplar[0].base) * area / own)
        check_size("source", count, self.config.levels)
        shape = subject.frame.apply(subject.source.vertices)
        coarse, project = _resampled(subject.source.name, shape, subject.source.faces, count)
        levels = pyramid(*coarse, self.config.levels, lambda points: project(points)[0], device)
        finest = levels[-1]
        repairs = subject.source.repairs
        source = meshes.Mesh(
            subject.source.name,
            subject.frame.invert(finest.base.double().cpu().numpy()),
            finest.faces.cpu().numpy(),
            repairs,
        )
        normals = meshes.vertex_normals(source.vertices, source.faces)
        surface = Surface(finest.base, finest.faces, torch.from_numpy(normals).float().to(device))
        note = (
            f"the result doesn't have the source's own faces: '{source.name}' was resampled to "
            f"{len(levels[0].base)} vertices and subdivided to {len(finest.base)}"
        )
        subdivided = replace(
            subject,
            source=source,
            surface=surface,
            areas=vertex_areas(surface),
            notes=(*repairs, note),
        )
        return TextureScene(subject=subdivided, exemplar=exemplar, fields=fields, levels=levels)

    def start(self, scene: TextureScene) -> State:
        """Untrained networks: a generator and a critic per level."""
        optim = scene.subject.settings.optim
        width, depth = self.config.width, self.config.depth
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(optim.seed)
            pairs = [(Generator(width, depth), Critic(width, depth)) for _ in scene.exemplar]
        networks = nn.ModuleList(
            nn.ModuleDict({"generator": generator, "critic": critic}) for generator, critic in pairs
        )
        networks.to(scene.subject.surface.vertices.device)
        # One optimiser for all: it skips parameters without a gradient.
        adam = torch.optim.Adam(networks.parameters(), lr=optim.rate, betas=(0.5, 0.999))
        return State(networks, adam)

    def optimise(self, scene: TextureScene, state: State) -> Iterator[TextureStep]:
        """Train one level after the other, each for an equal share of the steps."""
        optim, count = scene.subject.settings.optim, len(scene.exemplar)
        while state.step < optim.steps:
            begun = time.perf_counter()
            number = state.step * count // optim.steps
            random = step_generator(optim.seed, state.step, stream=TRAIN)
            with torch.no_grad():
                rough = _below(scene, state.field, number, random)
                recalled = _below(scene, state.field, number, None)
            measured = [
                self._iterate(scene, state, number, rough, recalled, random)
                for _ in range(self.config.iterations)
            ]
            state.step += 1
            loss, critic, penalty, error = np.mean(measured, axis=0).tolist()
            if not np.isfinite([loss, critic, penalty, error]).all():
                raise Diverged(state.step, f"the loss of level {number} became NaN or infinite")
            seconds = time.perf_counter() - begun
            yield TextureStep(state.step, number, loss, critic, penalty, error, seconds)

    def _iterate(
        self,
        scene: TextureScene,
        state: State,
        number: int,
        rough: Tensor,
        recalled: Tensor,
        random: torch.Generator,
    ) -> tuple[float, float, float, float]:
        """One generator update after several critic updates, on one patch of a level."""
        level, target = scene.exemplar[number], scene.fields[number]
        generator, critic = state.field[number]["generator"], state.field[number]["critic"]
        unit = _unit(target)
        patch, inner = choose_patch(level, self.config.patch, random)
        real = inner.seen(target / unit)

        def generated() -> Tensor:
            noisy = rough / unit + _noise(rough, number, random)
            return inner.seen(rough / unit + generator(patch, noisy))

        for _ in range(self.config.critic_steps):
            with torch.no_grad():
                fake = generated()
            gap = critic(real, inner.neighbours).mean() - critic(fake, inner.neighbours).mean()
            mix = float(torch.rand(1, generator=random))
            penalty = gradient_penalty(critic, inner, real, fake, mix)
            self._update(state, PENALTY * penalty - gap, critic)

        score = critic(generated(), inner.neighbours).mean()
        noise = _fixed_noise(scene, rough) if number == 0 else 0.0
        again = recalled / unit + generator(patch, recalled / unit + noise)
        error = (inner.seen(again) - real).square().sum() / real.square().sum().clamp(min=1e-12)
        loss = RECONSTRUCTION * error - score
        self._update(state, loss, generator)
        return loss.item(), gap.item(), penalty.item(), error.item()

    def _update(self, state: State, loss: Tensor, network: nn.Module) -> None:
        """Update one network only."""
        parameters = list(network.parameters())
        state.optimizer.zero_grad(set_to_none=True)
        for parameter, grad in zip(parameters, torch.autograd.grad(loss, parameters), strict=True):
            parameter.grad = grad
        state.optimizer.step()

    @torch.no_grad()
    def finish(self, scene: TextureScene, state: State | None) -> Result:
        """Apply the generators to the source, level by level."""
        assert state is not None
        subject = scene.subject
        random = step_generator(scene.subject.settings.optim.seed, 0, stream=APPLY)
        texture = torch.zeros_like(scene.levels[0].base)
        for number, level in enumerate(scene.levels):
            if number:
                texture = upsample(level, texture)
            texture = _detailed(scene, state.field, number, level, texture, random)
        size = subject.unit * subject.settings.strength * subject.frame.scale
        moved = texture.double().cpu().numpy() * size
        normals = subject.surface.normals.double().cpu().numpy()
        return Result(subject, (moved * normals).sum(axis=1), subject.source.vertices + moved)


def check_size(what: str, lowest: int, levels: int) -> None:
    """Raise `UserError` if a mesh is too coarse at the lowest level, or too fine at the highest."""
    highest = lowest * 4 ** (levels - 1)
    if lowest < LEAST_VERTICES or highest > MOST_VERTICES:
        raise UserError(
            f"the {what} would get {lowest} vertices at the lowest level (at least "
            f"{LEAST_VERTICES} needed) and {highest} at the highest (at most {MOST_VERTICES} "
            "allowed): change baseline.base, baseline.levels or style.scale."
        )


def choose_patch(level: Level, size: int, random: torch.Generator) -> tuple[Patch, Patch]:
    """About ``size`` faces around a random face (or all, if there are fewer), and the innermost of
    them."""
    centre = int(torch.randint(len(level.faces), (1,), generator=random))
    if len(level.faces) <= size:
        whole = Patch.of(level)
        return whole, whole
    middle = level.base[level.faces].mean(1)
    chosen = (middle - middle[centre]).square().sum(1).topk(size, largest=False).indices
    return Patch.of(level, chosen), Patch.of(level, chosen[: round(INNER * size)])


def _below(
    scene: TextureScene, networks: nn.ModuleList, number: int, random: torch.Generator | None
) -> Float[Tensor, "vertices 3"]:
    """The exemplar's texture generated by the levels below ``number``, upsampled; without
    ``random``, from the fixed noise."""
    texture = torch.zeros_like(scene.exemplar[0].base)
    for below in range(number):
        texture = _detailed(scene, networks, below, scene.exemplar[below], texture, random)
        texture = upsample(scene.exemplar[below + 1], texture)
    return texture


def _detailed(
    scene: TextureScene,
    networks: nn.ModuleList,
    number: int,
    level: Level,
    texture: Float[Tensor, "vertices 3"],
    random: torch.Generator | None,
) -> Float[Tensor, "vertices 3"]:
    unit = _unit(scene.fields[number])
    seen = texture / unit
    if random is not None:
        seen = seen + _noise(texture, number, random)
    elif number == 0:
        seen = seen + _fixed_noise(scene, texture)
    generator: nn.Module = networks[number]["generator"]  # type: ignore[index]
    return texture + unit * generator(Patch.of(level), seen)


def _unit(texture: Tensor) -> Tensor:
    """RMS of a texture, which normalises the networks' displacements."""
    return texture.square().sum(1).mean().sqrt().clamp(min=1e-9)


def _noise(like: Tensor, number: int, random: torch.Generator) -> Tensor:
    return NOISE[min(number, 1)] * torch.randn(like.shape, generator=random).to(like)


def _fixed_noise(scene: TextureScene, like: Tensor) -> Tensor:
    return _noise(like, 0, step_generator(scene.subject.settings.optim.seed, 0, stream=RECALL))


def fit_exemplar(
    style: meshes.Mesh, base: int, levels: int, device: torch.device
) -> tuple[list[Level], list[Float[Tensor, "vertices 3"]]]:
    """The style with subdivision connectivity, and its texture per level, in radii of the style.

    An analytic style is a sphere with its relief. For any other mesh, the smoothed surface is
    resampled and subdivided, and the texture is the offset to the mesh itself; no optimisation is
    needed.
    """
    frame = meshes.normalisation(style.vertices)
    if style.carrier is None and style.name in shapes.RELIEFS:
        radius = 1 / frame.scale
        points, faces = shapes.icosphere(base)

        def onto(points: np.ndarray) -> np.ndarray:
            return radius * points / np.linalg.norm(points, axis=1, keepdims=True)

        built = pyramid(onto(points), faces, levels, onto, device)
        finest = built[-1].base.double().cpu().numpy()
        height = shapes.relief(style.name, finest)
        texture = (height - height.mean())[:, None] * finest
    else:
        vertices = frame.apply(style.vertices)
        smooth = smoother(vertices, style.faces, SMOOTH_LENGTH)(vertices)
        coarse, project = _resampled(style.name, smooth, style.faces, base)
        built = pyramid(*coarse, levels, lambda points: project(points)[0], device)
        finest = built[-1].base.double().cpu().numpy()
        _, face, weights = project(finest)
        texture = np.einsum("vk,vkx->vx", weights, (vertices - smooth)[style.faces[face]])
    fields = [torch.from_numpy(texture).float().to(device)]
    for level in reversed(built[1:]):
        fields.insert(0, restrict(level, fields[0]))
    return built, fields


def _resampled(
    name: str, vertices: np.ndarray, faces: np.ndarray, count: int
) -> tuple[tuple[np.ndarray, np.ndarray], Project]:
    """Resample a surface to about ``count`` uniform vertices, and project points onto it: returns
    the points, their faces and barycentric weights."""
    import gpytoolbox

    triangles = faces.astype(np.int32)

    def project(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        _, face, weights = gpytoolbox.squared_distance(points, vertices, F=triangles, use_cpp=True)
        nearest = np.einsum("vk,vkx->vx", weights, vertices[faces[face]])
        return nearest, face, weights

    return meshes.resample(meshes.Mesh(name, vertices, faces), count), project


def _area(vertices: Tensor, faces: Tensor) -> Tensor:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return torch.linalg.cross(b - a, c - a).norm(dim=1).sum() / 2
