"""Mitsuba 3 backend: ray casting, with projective sampling for gradients of outlines.

Light. Mitsuba's lights can't express the shared shading, which clamps after the sum and allows
negative cosines. So surfaces emit it. Normals are computed in torch, as for all backends;
intersections and their derivatives come from Mitsuba and Dr.Jit. An image's first channel is the
intensity, its second the coverage.

Visibility. All views share one world-space scene: rays pass through back faces, which Mitsuba would
show. Shading gradients come from intersections that move with the vertices. Outline gradients come
from the integrator ``direct_projective``, without samples of indirect visibility (``sppi: 0``;
guiding those takes seconds and gigabytes). It needs one scene per view: only the front faces, in
the space of Mitsuba's own camera, which is at the origin and looks along +z with +x to the left.
Off-centre axes, non-square pixels and crops are linear maps of that space.

Global state, set at first use and not restored: the environment variable ``DRJIT_LIBLLVM_PATH``
(see ``llvm``), the number of Dr.Jit's threads (torch's), and, in every call, Mitsuba's variant,
``llvm_ad_rgb``. Code that uses another variant must set it again after a render.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from styleexp.renderers.base import (
    Cameras,
    Capabilities,
    Renderer,
    RenderOutput,
    Shading,
    one_light_at_a_time,
)
from styleexp.renderers.mitsuba_parts import integrator, load_mitsuba, outline_gradient
from styleexp.renderers.soft_raster.culling import facing
from styleexp.renderers.soft_raster.geometry import FaceNormals, unit, vertex_normals
from styleexp.renderers.soft_raster.shading import world_light
from styleexp.system.errors import UserError, unknown_name

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from torch import Tensor


_LANES = 1 << 22  # rays traced per batch: bounds memory


class MitsubaAD(Renderer):
    """Path-space differentiable rendering on the CPU, with Mitsuba's ``direct_projective``.

    With ``Shading.outlines`` a pixel is the mean of ``spp`` samples over its area, or with one
    sample the colour at its centre. Gradients are sampled too: ``sppc`` samples per pixel for
    shading, and ``sppp`` times the number of pixels along outlines. Sampling restarts from ``seed``
    for every call and view, so equal inputs give equal images. Without outlines, pixels are
    evaluated at their centres without noise, and only shading has gradients.

    Grey images (one channel), computed in float32. ``face_ids`` and ``depth`` refer to pixel
    centres. Raises ``UserError`` if Mitsuba or a working LLVM is missing, counts or the seed are
    out of range, vertices are not on the CPU, or ``Shading.normals`` is unknown.

    As in ``soft_raster``, the gradient ignores that borders between flat-shaded faces move. Of
    coincident faces, either may be visible. Gradients are summed in arbitrary thread order, so
    their last bits vary.
    """

    capabilities = Capabilities(
        differentiable_shading=True,
        differentiable_visibility=True,
        devices=("cpu",),
        decides_ties=False,
    )

    def __init__(self, spp: int = 16, sppc: int = 4, sppp: int = 1, seed: int = 0) -> None:
        for name, count in (("spp", spp), ("sppc", sppc), ("sppp", sppp)):
            if count < 1:
                raise UserError(f"renderer.{name}={count} is too few: give at least 1.")
        if not 0 <= seed < 1 << 32:
            raise UserError(f"renderer.seed={seed} is out of range: give 0 to {(1 << 32) - 1}.")
        self.spp, self.sppc = _divisible(spp), _divisible(sppc)
        self.sppp, self.seed = sppp, seed

    @one_light_at_a_time
    def render(
        self,
        vertices: Float[Tensor, "vertices 3"],
        faces: Int[Tensor, "faces 3"],
        cameras: Cameras,
        shading: Shading,
        resolution: tuple[int, int],
    ) -> RenderOutput:
        """Render one mesh from every camera; see ``Renderer.render``."""
        if shading.normals not in ("flat", "smooth"):
            raise unknown_name("kind of normals", shading.normals, ("flat", "smooth"))
        if vertices.device.type != "cpu":
            raise UserError(
                "renderer=mitsuba_ad only works on the CPU, but the mesh is on "
                f"'{vertices.device}': use device=cpu."
            )
        single = vertices.float()
        corners = faces.t().contiguous().long()
        face_normals = FaceNormals.apply(single, corners)
        if shading.normals == "smooth":
            normals = vertex_normals(face_normals, corners, single.shape[0])
        else:
            normals = unit(face_normals)
        with torch.no_grad():
            eyes = _eyes(cameras, single)
            front = facing(single, corners, face_normals, eyes)
            light = torch.as_tensor(shading.light).expand(len(cameras), 3)
            light = world_light(cameras, light, single)
        job = _Job(faces.int(), front, eyes, cameras, light, shading, resolution)
        if not bool(front.any()):
            return job.nothing(vertices.dtype)

        spp, sppc, sppp = (self.spp, self.sppc, self.sppp) if shading.outlines else (1, 1, 0)
        attached = torch.is_grad_enabled() and vertices.requires_grad
        outlines = sppp > 0 and attached
        points = _seen_by_mitsuba(single, cameras, resolution) if outlines else single[:0]
        _, dr = load_mitsuba()

        @dr.wrap(source="torch", target="drjit")
        def trace(vertices: Any, normals: Any, points: Any) -> Any:
            world = _World(job, vertices.array, normals.array, self.seed)
            color, seen, depth = world.look(spp)
            if attached:
                color = dr.replace_grad(color, world.look_attached(sppc))
            if outlines:
                color = dr.replace_grad(
                    color, color + dr.custom(outline_gradient(), points, world, sppp)
                )
            return color, seen, depth

        color, seen, depth = trace(
            single.contiguous(), normals.t().contiguous(), points.contiguous()
        )
        shape = (len(cameras), *resolution)
        color = color.view(*shape, 2).to(vertices.dtype)
        return RenderOutput(
            color[..., :1],
            color[..., 1],
            seen.view(shape).long(),
            depth.view(shape).detach().to(vertices.dtype),
        )


@dataclass(frozen=True)
class _Job:
    """Inputs of a render except those with gradients: vertices and normals."""

    faces: Int[Tensor, "faces 3"]
    front: Bool[Tensor, "views faces"]
    """Whether the camera is on the outer side of a face."""
    eyes: Float[Tensor, "views 3"]
    cameras: Cameras
    light: Float[Tensor, "views 3"]
    """Light direction times strength, in world space."""
    shading: Shading
    resolution: tuple[int, int]

    def nothing(self, dtype: torch.dtype) -> RenderOutput:
        """Output with only the background."""
        shape = (len(self.eyes), *self.resolution)
        return RenderOutput(
            torch.full((*shape, 1), self.shading.background, dtype=dtype),
            torch.zeros(shape, dtype=dtype),
            torch.full(shape, -1),
            torch.full(shape, math.inf, dtype=dtype),
        )


@dataclass(frozen=True)
class _Rays:
    """Rays as Dr.Jit arrays, one entry per ray; directions are scaled to a depth of 1."""

    view: Any
    eye: Any
    direction: Any


class _World:
    """A mesh in Mitsuba, and its views. Holds Dr.Jit arrays."""

    def __init__(self, job: _Job, vertices: Any, normals: Any, seed: int) -> None:
        """``vertices`` and ``normals`` are flat (x, y, z, x, ...) and may carry gradients."""
        mi, dr = load_mitsuba()
        self.job, self.vertices, self.normals, self.seed = job, vertices, normals, seed
        self.faces = _array(mi.UInt32, job.faces)
        self.front = _array(mi.Bool, job.front)
        self.eyes, self.light = _array(mi.Float, job.eyes), _array(mi.Float, job.light)
        self.rotation = _array(mi.Float, job.cameras.rotation)
        self.focal = _array(mi.Float, job.cameras.focal)
        self.center = _array(mi.Float, job.cameras.center)
        # Opaque, so that changing numbers aren't compiled into the kernels.
        self.near = dr.opaque(mi.Float, job.cameras.near)
        self.albedo = dr.opaque(mi.Float, job.shading.albedo)
        self.ambient = dr.opaque(mi.Float, job.shading.ambient)
        self.background = dr.opaque(mi.Float, job.shading.background)
        with dr.suspend_grad():
            mesh = _mesh(dr.detach(vertices), self.faces)
            self.scene = mi.load_dict({"type": "scene", "mesh": mesh})

    def look(self, samples: int) -> tuple[Any, Any, Any]:
        """Colours (two channels) without gradients, and the face (or -1) and depth (or infinity) at
        pixel centres."""
        _, dr = load_mitsuba()
        parts = []
        with dr.suspend_grad():
            for views in self.portions(samples):
                rays = self.rays(views, samples)
                face, depth = self.hit(rays)
                color = self.mean(self.color(rays, face), samples)
                if samples > 1:
                    face, depth = self.hit(self.rays(views, 1))
                dr.eval(color, face, depth)
                parts.append((color, face, depth))
        color, face, depth = (dr.concat(part) for part in zip(*parts, strict=True))
        return color, face, depth

    def look_attached(self, samples: int) -> Any:
        """Colours with gradients of shading, but not of visibility."""
        _, dr = load_mitsuba()
        parts = []
        for views in self.portions(samples):
            with dr.suspend_grad():
                rays = self.rays(views, samples)
                face, _ = self.hit(rays)
                dr.eval(rays.view, rays.eye, rays.direction, face)
            parts.append(self.mean(self.color(rays, face), samples))
        return dr.concat(parts)

    def portions(self, samples: int) -> list[range]:
        """Batches of views that bound the memory."""
        height, width = self.job.resolution
        count = len(self.job.eyes)
        together = max(1, _LANES // (height * width * samples))
        return [range(i, min(i + together, count)) for i in range(0, count, together)]

    def rays(self, views: range, samples: int) -> _Rays:
        """Rays through pixel centres, or through stratified samples of each pixel."""
        mi, dr = load_mitsuba()
        height, width = self.job.resolution
        size = height * width * samples
        lane = dr.arange(mi.UInt32, len(views) * size)
        view = lane // size + dr.opaque(mi.UInt32, views.start)
        within = lane % size
        pixel = within // samples
        place = mi.Point2f(pixel % width, pixel // width)
        if samples == 1:
            place += 0.5
        else:
            sampler = mi.load_dict({"type": "multijitter", "sample_count": samples})
            sampler.set_samples_per_wavefront(samples)
            sampler.seed(self.seed, size)
            offset = sampler.next_2d()
            dr.eval(offset)  # reused for every view
            place += dr.gather(mi.Point2f, dr.ravel(offset), within)
        screen = mi.Point2f(2 * place.x / width - 1, 1 - 2 * place.y / height)
        slope = (screen - self.of(mi.Point2f, self.center, view)) / self.of(
            mi.Point2f, self.focal, view
        )
        right, up, backward = (
            dr.gather(mi.Vector3f, self.rotation, 3 * view + axis) for axis in range(3)
        )
        direction = slope.x * right + slope.y * up - backward
        return _Rays(view, self.of(mi.Point3f, self.eyes, view), direction)

    def hit(self, rays: _Rays) -> tuple[Any, Any]:
        """First front face beyond the near plane (or -1), and its depth (or infinity)."""
        mi, dr = load_mitsuba()
        number = self.job.faces.shape[0]

        def go_on(depth: Any, face: Any, active: Any) -> Any:
            ray = mi.Ray3f(rays.eye + depth * rays.direction, rays.direction)
            hit = self.scene.ray_intersect_preliminary(ray, coherent=True, active=active)
            valid = hit.is_valid() & active
            outside = dr.gather(mi.Bool, self.front, rays.view * number + hit.prim_index, valid)
            face = dr.select(valid & outside, mi.Int32(hit.prim_index), face)
            depth = dr.select(active, dr.select(valid, depth + hit.t, dr.inf), depth)
            active = valid & ~outside
            return dr.select(active, depth * _BEYOND, depth), face, active

        count = dr.width(rays.view)
        depth, face, _ = dr.while_loop(
            (self.near + dr.zeros(mi.Float, count), dr.full(mi.Int32, -1, count), mi.Bool(True)),
            lambda depth, face, active: active,
            go_on,
        )
        return face, depth

    def color(self, rays: _Rays, face: Any) -> Any:
        """Intensity and coverage of rays that hit these faces."""
        mi, dr = load_mitsuba()
        seen = face >= 0
        index = mi.UInt32(dr.maximum(face, 0))
        if self.job.shading.normals == "flat":
            normal = dr.gather(mi.Vector3f, self.normals, index, seen)
        else:
            corners = dr.gather(mi.Vector3u, self.faces, index, seen)
            a, b, c = (
                dr.gather(mi.Point3f, self.vertices, corner, seen) - rays.eye for corner in corners
            )
            # Barycentric coordinates up to a common factor, which normalisation removes.
            weights = [dr.dot(rays.direction, dr.cross(p, q)) for p, q in ((c, b), (a, c), (b, a))]
            normal = self.interpolated(corners, weights, seen)
        return self.lit(normal, rays.view, seen)

    def interpolated(self, corners: Any, weights: Any, active: Any) -> Any:
        """Interpolated normal, not normalised."""
        mi, dr = load_mitsuba()
        normals = [dr.gather(mi.Vector3f, self.normals, corner, active) for corner in corners]
        return sum(weight * normal for weight, normal in zip(weights, normals, strict=True))

    def lit(self, normal: Any, view: Any, seen: Any) -> Any:
        """Apply the shared shading; ``normal`` may have any length."""
        mi, dr = load_mitsuba()
        squared = dr.squared_norm(normal)
        scale = dr.select(squared > 0, dr.rsqrt(dr.select(squared > 0, squared, 1)), 0)
        cosine = dr.dot(normal, self.of(mi.Vector3f, self.light, view)) * scale
        intensity = dr.clip(self.albedo * (self.ambient + cosine), 0, 1)
        return mi.Vector2f(dr.select(seen, intensity, self.background), dr.select(seen, 1.0, 0.0))

    def mean(self, color: Any, samples: int) -> Any:
        """Mean over each pixel's samples, as a flat array."""
        _, dr = load_mitsuba()
        if samples > 1:
            color = dr.block_reduce(dr.ReduceOp.Add, color, samples) / samples
        return dr.ravel(color)

    def of(self, kind: Any, values: Any, view: Any) -> Any:
        """Gather each view's values."""
        _, dr = load_mitsuba()
        return dr.gather(kind, values, view)

    def outlines(self, view: int, points: Any, samples: int, grad: Any) -> Any:
        """Gradient w.r.t. one view's ``points``, through outlines only, given its colours'
        ``grad``.

        ``points`` are vertices in the space of Mitsuba's camera; all arrays are flat.
        """
        mi, dr = load_mitsuba()
        kept = self.job.front[view].nonzero().view(-1)
        if not kept.numel():
            return dr.zeros(mi.Float, dr.width(points))
        dr.enable_grad(points)
        mesh = _mesh(points, _array(mi.UInt32, self.job.faces[kept]))
        outlines = integrator()(self, mesh, view, _array(mi.UInt32, kept.int()), samples)
        image = outlines.picture(_sensor(self.job, view), self.seed)
        if image is not None:
            pair = dr.unravel(mi.Vector2f, grad)
            dr.set_grad(image, mi.TensorXf(dr.ravel(mi.Color3f(pair.x, pair.y, 0)), image.shape))
            dr.enqueue(dr.ADMode.Backward, image)
            dr.traverse(dr.ADMode.Backward)
        found = dr.grad(points)
        dr.eval(found)  # before the mesh is freed
        return found


_BEYOND = 1 + 1e-5  # depth factor at which a ray continues behind a back face


def _array(kind: Any, values: Tensor) -> Any:
    """Convert a tensor to a flat Dr.Jit array."""
    values = values.float() if values.is_floating_point() else values
    return kind(values.detach().contiguous().view(-1).numpy())


def _mesh(vertices: Any, faces: Any) -> Any:
    """Make a Mitsuba mesh from flat arrays."""
    mi, dr = load_mitsuba()
    mesh = mi.Mesh("mesh", vertex_count=dr.width(vertices) // 3, face_count=dr.width(faces) // 3)
    parameters = mi.traverse(mesh)
    parameters["faces"], parameters["vertex_positions"] = faces, vertices
    parameters.update()
    return mesh


def _divisible(samples: int) -> int:
    """Round up to a number of samples that the sampler can stratify."""
    mi, _ = load_mitsuba()
    return mi.load_dict({"type": "multijitter", "sample_count": samples}).sample_count()


def _sensor(job: _Job, view: int) -> Any:
    """Mitsuba camera with a box-filtered film."""
    mi, _ = load_mitsuba()
    height, width = job.resolution
    film = {
        "type": "hdrfilm",
        "width": width,
        "height": height,
        "pixel_format": "rgb",
        "component_format": "float32",
        "rfilter": {"type": "box"},
        "sample_border": True,
    }
    return mi.load_dict(
        {
            "type": "perspective",
            "fov": math.degrees(2 * math.atan(1 / float(job.cameras.focal[view, 0]))),
            "fov_axis": "x",
            "near_clip": job.cameras.near,
            "film": film,
        }
    )


def _seen_by_mitsuba(
    vertices: Float[Tensor, "vertices 3"], cameras: Cameras, resolution: tuple[int, int]
) -> Float[Tensor, "views vertices 3"]:
    """Transform vertices to the space of Mitsuba's camera, at the origin, looking along +z with +x
    to the left, with the field of view of ``focal``'s x axis; z is the depth."""
    height, width = resolution
    rotation, translation = cameras.rotation.to(vertices), cameras.translation.to(vertices)
    focal, center = cameras.focal.to(vertices)[:, :, None], cameras.center.to(vertices)[:, :, None]
    right, up, backward = torch.cat([rotation, translation[:, :, None]], dim=2).detach().unbind(1)
    x = right - center[:, 0] / focal[:, 0] * backward
    y = (focal[:, 1] * up - center[:, 1] * backward) / focal[:, 0] * (height / width)
    matrix = torch.stack([-x, y, -backward], dim=2)  # of rows (x, y, z, 1)
    return vertices @ matrix[:, :3] + matrix[:, 3:]


def _eyes(cameras: Cameras, like: Tensor) -> Float[Tensor, "views 3"]:
    """World positions of the cameras."""
    rotation, translation = cameras.rotation.to(like), cameras.translation.to(like)
    return -(rotation * translation[:, :, None]).sum(1)
