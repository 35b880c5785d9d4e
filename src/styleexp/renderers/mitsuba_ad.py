"""Mitsuba 3 as a backend: ray casting, and projective sampling for the gradients of outlines.

Light. The shared shading is none of Mitsuba's lights: it is clamped after the sum, and its cosine
goes below zero. So surfaces emit it. Normals are computed in torch, as for all backends; which of
them a ray sees, and its derivatives, are Mitsuba's and Dr.Jit's part. A picture's first channel is
the intensity, its second the coverage.

Visibility. One scene in the world serves all views: rays go through back faces, which Mitsuba would
show. The gradient of shading comes from intersections that move with the vertices. The gradient of
outlines is that of the integrator ``direct_projective``, with no samples of what is seen
indirectly (``sppi: 0``; guiding those takes seconds and gigabytes). It needs a scene for each view:
the front faces alone, in a space where Mitsuba's own camera, at the origin, looks along +z with +x
to the left. Off-centre axes, pixels that are not square and crops are linear maps of that space.

Global state, set at first use and not put back: the environment variable ``DRJIT_LIBLLVM_PATH``
(see ``llvm``), the number of Dr.Jit's threads, which is torch's, and, in every call, Mitsuba's
variant: ``llvm_ad_rgb``. Code that uses another variant has to set it again after a render.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import torch

from styleexp.errors import UserError, unknown_name
from styleexp.renderers import llvm
from styleexp.renderers.base import Cameras, Capabilities, Renderer, RenderOutput, Shading
from styleexp.renderers.soft_raster.geometry import FaceNormals, unit, vertex_normals
from styleexp.renderers.soft_raster.raster import facing
from styleexp.renderers.soft_raster.shading import world_light

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from torch import Tensor


_LANES = 1 << 22  # rays that are traced together: bounds the memory


class MitsubaAD(Renderer):
    """Path-space differentiable rendering on the CPU, by Mitsuba's ``direct_projective``.

    With ``Shading.outlines`` a pixel is the mean of ``spp`` samples spread over its area, or with
    one sample its centre's colour. Gradients are sampled too: ``sppc`` times a pixel for shading,
    and ``sppp`` times the number of pixels along outlines. Everything is drawn from ``seed`` anew
    in every call and for every view: the same input gives the same picture. Without outlines a
    pixel is what its centre sees; there is no noise, and gradients are those of shading alone.

    Grey images (one channel), float32 inside. ``face_ids`` and ``depth`` are what pixel centres
    see. Raises ``UserError`` where Mitsuba or a working LLVM is missing, for counts or a seed out
    of range, for vertices that are not on the CPU, and for an unknown ``Shading.normals``.

    As in ``soft_raster``, the gradient leaves out that the borders between the grey levels of flat
    shaded faces move. Where two faces lie in the same place, either may be seen. Gradients are sums
    in whatever order the threads come: their last bits vary.
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
                f"renderer=mitsuba_ad works on the CPU and the mesh is on '{vertices.device}': "
                "give device=cpu."
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
        _, dr = _mitsuba()

        @dr.wrap(source="torch", target="drjit")
        def trace(vertices: Any, normals: Any, points: Any) -> Any:
            world = _World(job, vertices.array, normals.array, self.seed)
            color, seen, depth = world.look(spp)
            if attached:
                color = dr.replace_grad(color, world.look_attached(sppc))
            if outlines:
                color = dr.replace_grad(color, color + dr.custom(_outlines(), points, world, sppp))
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
    """What is drawn, but for what carries gradients: the vertices and the normals."""

    faces: Int[Tensor, "faces 3"]
    front: Bool[Tensor, "views faces"]
    """Whether the camera is on a face's outer side."""
    eyes: Float[Tensor, "views 3"]
    cameras: Cameras
    light: Float[Tensor, "views 3"]
    """Direction times strength, in the world."""
    shading: Shading
    resolution: tuple[int, int]

    def nothing(self, dtype: torch.dtype) -> RenderOutput:
        """The background."""
        shape = (len(self.eyes), *self.resolution)
        return RenderOutput(
            torch.full((*shape, 1), self.shading.background, dtype=dtype),
            torch.zeros(shape, dtype=dtype),
            torch.full(shape, -1),
            torch.full(shape, math.inf, dtype=dtype),
        )


@dataclass(frozen=True)
class _Rays:
    """Dr.Jit arrays, one entry a ray; directions reach a depth of 1."""

    view: Any
    eye: Any
    direction: Any


class _World:
    """A mesh in Mitsuba and what cameras see of it. The arrays in it are Dr.Jit's."""

    def __init__(self, job: _Job, vertices: Any, normals: Any, seed: int) -> None:
        """``vertices`` and ``normals`` are flat (x, y, z, x, ...) and may carry gradients."""
        mi, dr = _mitsuba()
        self.job, self.vertices, self.normals, self.seed = job, vertices, normals, seed
        self.faces = _array(mi.UInt32, job.faces)
        self.front = _array(mi.Bool, job.front)
        self.eyes, self.light = _array(mi.Float, job.eyes), _array(mi.Float, job.light)
        self.rotation = _array(mi.Float, job.cameras.rotation)
        self.focal = _array(mi.Float, job.cameras.focal)
        self.center = _array(mi.Float, job.cameras.center)
        # Opaque: numbers that change must not be compiled into the kernels.
        self.near = dr.opaque(mi.Float, job.cameras.near)
        self.albedo = dr.opaque(mi.Float, job.shading.albedo)
        self.ambient = dr.opaque(mi.Float, job.shading.ambient)
        self.background = dr.opaque(mi.Float, job.shading.background)
        with dr.suspend_grad():
            mesh = _mesh(dr.detach(vertices), self.faces)
            self.scene = mi.load_dict({"type": "scene", "mesh": mesh})

    def look(self, samples: int) -> tuple[Any, Any, Any]:
        """Colours (two a pixel) without gradients, and what pixel centres see: faces, or -1, and
        depths, or infinity."""
        _, dr = _mitsuba()
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
        """Colours that carry the gradient of what rays see, not that of what they hit."""
        _, dr = _mitsuba()
        parts = []
        for views in self.portions(samples):
            with dr.suspend_grad():
                rays = self.rays(views, samples)
                face, _ = self.hit(rays)
                dr.eval(rays.view, rays.eye, rays.direction, face)
            parts.append(self.mean(self.color(rays, face), samples))
        return dr.concat(parts)

    def portions(self, samples: int) -> list[range]:
        """The views, as many at a time as memory should hold."""
        height, width = self.job.resolution
        count = len(self.job.eyes)
        together = max(1, _LANES // (height * width * samples))
        return [range(i, min(i + together, count)) for i in range(0, count, together)]

    def rays(self, views: range, samples: int) -> _Rays:
        """Through the centres of the views' pixels, or as many stratified samples of each."""
        mi, dr = _mitsuba()
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
            dr.eval(offset)  # the same for every view
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
        """The first front face beyond the near plane, or -1, and its depth, or infinity."""
        mi, dr = _mitsuba()
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
        """Intensity and coverage of rays that see these faces."""
        mi, dr = _mitsuba()
        seen = face >= 0
        index = mi.UInt32(dr.maximum(face, 0))
        if self.job.shading.normals == "flat":
            normal = dr.gather(mi.Vector3f, self.normals, index, seen)
        else:
            corners = dr.gather(mi.Vector3u, self.faces, index, seen)
            a, b, c = (
                dr.gather(mi.Point3f, self.vertices, corner, seen) - rays.eye for corner in corners
            )
            # Barycentric coordinates but for a common factor, which the unit normal is rid of.
            weights = [dr.dot(rays.direction, dr.cross(p, q)) for p, q in ((c, b), (a, c), (b, a))]
            normal = self.interpolated(corners, weights, seen)
        return self.lit(normal, rays.view, seen)

    def interpolated(self, corners: Any, weights: Any, active: Any) -> Any:
        """The direction of the normal between three vertices."""
        mi, dr = _mitsuba()
        normals = [dr.gather(mi.Vector3f, self.normals, corner, active) for corner in corners]
        return sum(weight * normal for weight, normal in zip(weights, normals, strict=True))

    def lit(self, normal: Any, view: Any, seen: Any) -> Any:
        """The shared shading; ``normal`` may have any length."""
        mi, dr = _mitsuba()
        squared = dr.squared_norm(normal)
        scale = dr.select(squared > 0, dr.rsqrt(dr.select(squared > 0, squared, 1)), 0)
        cosine = dr.dot(normal, self.of(mi.Vector3f, self.light, view)) * scale
        intensity = dr.clip(self.albedo * (self.ambient + cosine), 0, 1)
        return mi.Vector2f(dr.select(seen, intensity, self.background), dr.select(seen, 1.0, 0.0))

    def mean(self, color: Any, samples: int) -> Any:
        """Mean of each pixel's samples, flat."""
        _, dr = _mitsuba()
        if samples > 1:
            color = dr.block_reduce(dr.ReduceOp.Add, color, samples) / samples
        return dr.ravel(color)

    def of(self, kind: Any, values: Any, view: Any) -> Any:
        """The views' own values."""
        _, dr = _mitsuba()
        return dr.gather(kind, values, view)

    def outlines(self, view: int, points: Any, samples: int, grad: Any) -> Any:
        """The gradient, by one view's ``points``, of its colours' ``grad``, through outlines alone.

        ``points`` are the vertices as Mitsuba's camera sees them; all arrays are flat.
        """
        mi, dr = _mitsuba()
        kept = self.job.front[view].nonzero().view(-1)
        if not kept.numel():
            return dr.zeros(mi.Float, dr.width(points))
        dr.enable_grad(points)
        mesh = _mesh(points, _array(mi.UInt32, self.job.faces[kept]))
        integrator = _integrator()(self, mesh, view, _array(mi.UInt32, kept.int()), samples)
        image = integrator.picture(_sensor(self.job, view), self.seed)
        if image is not None:
            pair = dr.unravel(mi.Vector2f, grad)
            dr.set_grad(image, mi.TensorXf(dr.ravel(mi.Color3f(pair.x, pair.y, 0)), image.shape))
            dr.enqueue(dr.ADMode.Backward, image)
            dr.traverse(dr.ADMode.Backward)
        found = dr.grad(points)
        dr.eval(found)  # before the mesh goes
        return found


_BEYOND = 1 + 1e-5  # how far behind a back face a ray goes on, relative to its depth


def _array(kind: Any, values: Tensor) -> Any:
    """A flat Dr.Jit array of a tensor's values."""
    values = values.float() if values.is_floating_point() else values
    return kind(values.detach().contiguous().view(-1).numpy())


def _mesh(vertices: Any, faces: Any) -> Any:
    """A mesh of flat arrays."""
    mi, dr = _mitsuba()
    mesh = mi.Mesh("mesh", vertex_count=dr.width(vertices) // 3, face_count=dr.width(faces) // 3)
    parameters = mi.traverse(mesh)
    parameters["faces"], parameters["vertex_positions"] = faces, vertices
    parameters.update()
    return mesh


def _divisible(samples: int) -> int:
    """The next number of samples that the sampler can spread evenly."""
    mi, _ = _mitsuba()
    return mi.load_dict({"type": "multijitter", "sample_count": samples}).sample_count()


def _sensor(job: _Job, view: int) -> Any:
    """Mitsuba's camera, and a film that averages over the area of a pixel."""
    mi, _ = _mitsuba()
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
    """The vertices where Mitsuba's camera stands at the origin, looks along +z and sees +x to the
    left, with the x axis of ``focal`` as its field of view; z is the depth."""
    height, width = resolution
    rotation, translation = cameras.rotation.to(vertices), cameras.translation.to(vertices)
    focal, center = cameras.focal.to(vertices)[:, :, None], cameras.center.to(vertices)[:, :, None]
    right, up, backward = torch.cat([rotation, translation[:, :, None]], dim=2).detach().unbind(1)
    x = right - center[:, 0] / focal[:, 0] * backward
    y = (focal[:, 1] * up - center[:, 1] * backward) / focal[:, 0] * (height / width)
    matrix = torch.stack([-x, y, -backward], dim=2)  # of rows (x, y, z, 1)
    return vertices @ matrix[:, :3] + matrix[:, 3:]


def _eyes(cameras: Cameras, like: Tensor) -> Float[Tensor, "views 3"]:
    """Positions of the cameras in the world."""
    rotation, translation = cameras.rotation.to(like), cameras.translation.to(like)
    return -(rotation * translation[:, :, None]).sum(1)


def _mitsuba() -> tuple[Any, Any]:
    """The modules ``mitsuba``, in our variant, and ``drjit``."""
    mi, dr = _load()
    if mi.variant() != llvm.VARIANT:
        mi.set_variant(llvm.VARIANT)
    return mi, dr


@cache
def _load() -> tuple[Any, Any]:
    llvm.prepare()
    import drjit
    import mitsuba

    mitsuba.set_variant(llvm.VARIANT)
    drjit.set_thread_count(torch.get_num_threads())
    return mitsuba, drjit


@cache
def _outlines() -> type:
    """The class of an operation that gives 0 and has the gradient of outlines.

    The scenes of the views are made when the gradient is asked for, one at a time: what Dr.Jit has
    recorded doesn't keep them alive.
    """
    mi, dr = _mitsuba()
    from drjit import CustomOp

    class Gradient(CustomOp):
        def eval(self, points: Any, world: _World, samples: int) -> Any:
            self.points, self.world, self.samples = points, world, samples
            height, width = world.job.resolution
            return dr.zeros(mi.Float, points.shape[0] * height * width * 2)

        def backward(self) -> None:
            grad, views = self.grad_out(), self.points.shape[0]
            parts = []
            for view in range(views):
                points, own = (_portion(x, view, views) for x in (self.points.array, grad))
                parts.append(self.world.outlines(view, points, self.samples, own))
            self.set_grad_in("points", mi.TensorXf(dr.concat(parts), self.points.shape))

    return Gradient


def _portion(values: Any, index: int, parts: int) -> Any:
    """One of so many equal parts."""
    mi, dr = _mitsuba()
    size = dr.width(values) // parts
    first = dr.opaque(mi.UInt32, index * size)
    return dr.gather(mi.Float, values, dr.arange(mi.UInt32, size) + first)


@cache
def _integrator() -> type:
    """The class of our integrator; it can be made only once Mitsuba has a variant."""
    mi, dr = _mitsuba()
    from mitsuba.ad import ProjectiveDetail
    from mitsuba.ad.integrators.direct_projective import DirectProjectiveIntegrator

    class Silhouette(ProjectiveDetail):
        """Samples of outlines whose mesh is data, not a number compiled into the kernels."""

        def sample_primarily_visible_silhouette(self, *arguments: Any) -> Any:
            sample = super().sample_primarily_visible_silhouette(*arguments)
            sample.shape = dr.opaque(mi.ShapePtr, self.parent.mesh)
            return sample

    class Outlines(DirectProjectiveIntegrator):
        """``direct_projective`` of surfaces that emit the shared shading, outlines only."""

        def __init__(self, world: _World, mesh: Any, view: int, numbers: Any, samples: int) -> None:
            """``numbers`` are the indices in the world of the mesh's faces."""
            super().__init__(mi.Properties())
            self.sppc, self.sppp, self.sppi = 0, samples, 0
            self.proj_detail = Silhouette(self)
            self.world, self.mesh, self.numbers = world, mesh, numbers
            self.view = dr.opaque(mi.UInt32, view)
            self.scene = mi.load_dict({"type": "scene", "mesh": mesh})

        def picture(self, sensor: Any, seed: int) -> Any:
            """An image that carries the gradient of outlines; None where there are none."""
            edges, _ = self.mesh.precompute_silhouette(mi.ScalarPoint3f(0))
            if not dr.width(edges):  # an error, to the class above
                return None
            return self.render_ad(self.scene, sensor, seed, 0, dr.ADMode.Backward)

        def sample_radiance_difference(
            self, scene: Any, ss: Any, depth: Any, sampler: Any, wavelengths: Any, active: Any
        ) -> tuple[Any, Any]:
            hit = scene.ray_intersect_preliminary(ss.spawn_ray(wavelengths), active=active)
            behind = self.emitted(hit.prim_index, hit.prim_uv, hit.is_valid() & active)
            difference = self.emitted(ss.prim_index, ss.uv, active) - behind
            return difference, active & dr.any(difference != 0)

        def emitted(self, index: Any, uv: Any, seen: Any) -> Any:
            face = dr.gather(mi.UInt32, self.numbers, index, seen)
            if self.world.job.shading.normals == "flat":
                normal = dr.gather(mi.Vector3f, self.world.normals, face, seen)
            else:
                corners = dr.gather(mi.Vector3u, self.world.faces, face, seen)
                weights = (1 - uv.x - uv.y, uv.x, uv.y)
                normal = self.world.interpolated(corners, weights, seen)
            color = self.world.lit(normal, self.view, seen)
            return mi.Color3f(color.x, color.y, 0)

    return Outlines
