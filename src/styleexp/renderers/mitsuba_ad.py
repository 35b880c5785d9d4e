"""Mitsuba 3 as a backend: projective sampling for the gradients of outlines.

Light. The shared shading is none of Mitsuba's lights: it is clamped after the sum, and its cosine
goes below zero. So surfaces emit it. Normals are computed in torch, as for all backends, and travel
with the mesh as an attribute; the integrator turns them into grey. What Mitsuba does is visibility,
interpolation and their derivatives. Of a picture's three channels the first is the intensity, the
second the coverage.

Camera. Every view's camera is moved into the vertices: off-centre axes, pixels that are not square
and crops are linear maps of camera space, under which triangles stay triangles and interpolation
stays perspective-correct. Mitsuba's own camera is at its origin and looks along +z, +x to the left.
Back faces are left out of a view's mesh, since Mitsuba would show them.

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
    from jaxtyping import Float, Int
    from torch import Tensor


class MitsubaAD(Renderer):
    """Path-space differentiable rendering on the CPU, by Mitsuba's ``direct_projective``.

    With ``Shading.outlines`` a pixel is the mean of ``spp`` samples spread over its area. Gradients
    are sampled too: ``sppc`` times a pixel for shading, and ``sppp`` times the number of pixels
    along outlines. Everything is drawn from ``seed`` anew in every call and for every view: the
    same input gives the same picture. Without outlines a pixel is what its centre sees; there is no
    noise, and gradients are those of shading alone.

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
        _mitsuba()
        self.spp, self.sppc, self.sppp, self.seed = spp, sppc, sppp, seed

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
            normals = vertex_normals(face_normals, corners, single.shape[0]).t().contiguous()
        else:
            normals = unit(face_normals).t()
        with torch.no_grad():
            front = facing(single, corners, face_normals, _eyes(cameras, single))
        light = world_light(cameras, shading, single)
        projection = _projection(cameras, resolution, single)

        seen = []
        for view in range(len(cameras)):
            kept = front[view].nonzero().view(-1)
            picture = _Picture(
                resolution,
                float(cameras.focal[view, 0]),
                cameras.near,
                shading,
                light[view].tolist(),
                (self.spp, self.sppc, self.sppp) if shading.outlines else (1, 1, 0),
                self.seed,
            )
            points = torch.addmm(projection[view, :, 3], single, projection[view, :, :3].t())
            shown = normals if shading.normals == "smooth" else normals[kept]
            seen.append(_draw(points, faces[kept], kept, shown, picture))
        if not seen:
            seen.append(_nothing(resolution, shading))
        image, coverage, face_ids, depth = (torch.stack(parts) for parts in zip(*seen, strict=True))
        count = slice(len(cameras))
        return RenderOutput(
            image[count, ..., None].to(vertices.dtype),
            coverage[count].to(vertices.dtype),
            face_ids[count],
            depth[count].to(vertices.dtype),
        )


@dataclass(frozen=True)
class _Picture:
    """What is asked for of one view, besides the mesh."""

    resolution: tuple[int, int]
    focal: float
    """NDC per unit of tangent, along x."""
    near: float
    shading: Shading
    light: list[float]
    """Direction times strength, in the frame of the normals."""
    samples: tuple[int, int, int]
    """A pixel's samples of the picture, of the shading's gradient and of the outlines'."""
    seed: int


_Seen = tuple["Tensor", "Tensor", "Tensor", "Tensor"]  # image, coverage, face ids, depth


def _draw(
    points: Float[Tensor, "vertices 3"],
    faces: Int[Tensor, "kept 3"],
    numbers: Int[Tensor, " kept"],
    normals: Float[Tensor, "n 3"],
    picture: _Picture,
) -> _Seen:
    """One view of some faces. ``points`` are those of Mitsuba's camera, ``numbers`` the faces' own,
    ``normals`` those of either the vertices or the kept faces."""
    if not len(faces):
        return _nothing(picture.resolution, picture.shading)
    mi, dr = _mitsuba()
    of = "vertex" if picture.shading.normals == "smooth" else "face"

    @dr.wrap(source="torch", target="drjit")
    def trace(points: Any, faces: Any, normals: Any) -> Any:
        mesh = mi.Mesh("mesh", vertex_count=points.shape[0], face_count=faces.shape[0])
        mesh.add_attribute(f"{of}_n", 3, dr.zeros(mi.Float, dr.width(normals.array)))
        parameters = mi.traverse(mesh)
        parameters["faces"] = mi.UInt32(faces.array)
        parameters["vertex_positions"] = points.array
        parameters[f"{of}_n"] = normals.array
        parameters.update()
        scene = mi.load_dict({"type": "scene", "mesh": mesh})
        integrator = _integrator()(mesh, f"{of}_n", picture)
        sensor = _sensor(picture)
        color = mi.render(scene, parameters, sensor, integrator, picture.seed)
        return color, *_centres(scene, picture)

    color, face, depth = trace(points.contiguous(), faces.int().contiguous(), normals.contiguous())
    face = face.long().view(picture.resolution)
    face_ids = torch.where(face < 0, -1, numbers[face.clamp_min(0)])
    return color[..., 0], color[..., 1], face_ids, depth.detach().view(picture.resolution)


def _nothing(resolution: tuple[int, int], shading: Shading) -> _Seen:
    """A view of the background."""
    return (
        torch.full(resolution, shading.background),
        torch.zeros(resolution),
        torch.full(resolution, -1),
        torch.full(resolution, math.inf),
    )


def _sensor(picture: _Picture) -> Any:
    """Mitsuba's camera, and a film that averages over the area of a pixel."""
    mi, _ = _mitsuba()
    height, width = picture.resolution
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
            "fov": math.degrees(2 * math.atan(1 / picture.focal)),
            "fov_axis": "x",
            "near_clip": picture.near,
            "film": film,
            "sampler": {"type": "multijitter", "sample_count": picture.samples[0]},
        }
    )


def _centres(scene: Any, picture: _Picture) -> tuple[Any, Any]:
    """Index of the face that each pixel's centre sees, or -1, and its depth, or infinity."""
    mi, dr = _mitsuba()
    height, width = picture.resolution
    row, column = dr.meshgrid(
        dr.arange(mi.Float, height), dr.arange(mi.Float, width), indexing="ij"
    )
    focal, near = dr.opaque(mi.Float, picture.focal), dr.opaque(mi.Float, picture.near)
    x = (1 - (2 * column + 1) / width) / focal
    y = (height - (2 * row + 1)) / width / focal
    ray = mi.Ray3f(mi.Point3f(x * near, y * near, near), mi.Vector3f(x, y, 1))
    with dr.suspend_grad():
        hit = scene.ray_intersect_preliminary(ray, coherent=True)
    face = dr.select(hit.is_valid(), mi.Int32(hit.prim_index), -1)
    return face, dr.select(hit.is_valid(), hit.t + near, dr.inf)


def _projection(
    cameras: Cameras, resolution: tuple[int, int], like: Tensor
) -> Float[Tensor, "views 3 4"]:
    """Matrices from world points ``(x, y, z, 1)`` to the space in which Mitsuba's camera stands at
    the origin, looks along +z and sees +x to the left; z is the depth."""
    height, width = resolution
    rotation, translation = cameras.rotation.to(like), cameras.translation.to(like)
    focal, center = cameras.focal.to(like)[:, :, None], cameras.center.to(like)[:, :, None]
    right, up, backward = torch.cat([rotation, translation[:, :, None]], dim=2).detach().unbind(1)
    x = right - center[:, 0] / focal[:, 0] * backward
    y = (focal[:, 1] * up - center[:, 1] * backward) / focal[:, 0] * (height / width)
    return torch.stack([-x, y, -backward], dim=1)


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
def _integrator() -> type:
    """The class of our integrator; it can be made only once Mitsuba has a variant."""
    mi, dr = _mitsuba()
    from mitsuba.ad.integrators.direct_projective import DirectProjectiveIntegrator

    class Centre:
        """In place of a sampler: the middle of every pixel."""

        def __init__(self, sampler: Any) -> None:
            self.sampler = sampler

        def sample_count(self) -> int:
            return self.sampler.sample_count()

        def next_2d(self, active: bool = True) -> Any:
            return mi.Point2f(0.5)

    class Silhouette(mi.ad.ProjectiveDetail):
        """Samples of outlines whose mesh is data, not a number compiled into the kernels."""

        def sample_primarily_visible_silhouette(self, *arguments: Any) -> Any:
            sample = super().sample_primarily_visible_silhouette(*arguments)
            sample.shape = dr.opaque(mi.ShapePtr, self.parent.mesh)
            return sample

    class Emitted(DirectProjectiveIntegrator):
        """``direct_projective`` of surfaces that emit the shared shading."""

        def __init__(self, mesh: Any, attribute: str, picture: _Picture) -> None:
            super().__init__(mi.Properties())
            _, self.sppc, self.sppp = picture.samples
            self.sppi = 0  # nothing is seen indirectly, and guiding it takes seconds and gigabytes
            self.mesh, self.attribute = mesh, attribute
            self.proj_detail = Silhouette(self)
            self.at_centre = not picture.shading.outlines
            # Opaque: numbers that change must not be compiled into the kernels.
            self.light = mi.Vector3f(*(dr.opaque(mi.Float, part) for part in picture.light))
            self.albedo = dr.opaque(mi.Float, picture.shading.albedo)
            self.ambient = dr.opaque(mi.Float, picture.shading.ambient)
            self.background = dr.opaque(mi.Float, picture.shading.background)

        def render_ad(self, scene: Any, sensor: Any, seed: Any, spp: int, mode: Any) -> Any:
            if self.sppp:
                edges, _ = self.mesh.precompute_silhouette(mi.ScalarPoint3f(0))
                if not dr.width(edges):  # which the class above takes for an error
                    self.sppp = 0
            return super().render_ad(scene, sensor, seed, spp, mode)

        def sample_rays(self, scene: Any, sensor: Any, sampler: Any) -> Any:
            if self.at_centre:
                sampler = Centre(sampler)
            return super().sample_rays(scene, sensor, sampler)

        def sample(
            self,
            mode: Any,
            scene: Any,
            sampler: Any,
            ray: Any,
            depth: Any,
            δL: Any = None,
            state_in: Any = None,
            active: Any = True,
            project: bool = False,
            si_shade: Any = None,
            **_: Any,
        ) -> tuple[Any, Any, list[Any], None]:
            with dr.resume_grad(when=mode != dr.ADMode.Primal):
                if si_shade is None:
                    hit = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
                    active = hit.is_valid() & active
                    si_shade = self.at(hit, ray, active)
                normal = self.mesh.eval_attribute_3(self.attribute, si_shade, active)
                squared = dr.squared_norm(normal)
                lit = dr.dot(normal, self.light) * dr.rsqrt(dr.select(squared > 0, squared, 1))
                intensity = dr.clip(self.albedo * (self.ambient + lit), 0, 1)
                color = mi.Color3f(
                    dr.select(active, intensity, self.background), dr.select(active, 1.0, 0.0), 0
                )
            return color, active, [], None

        def sample_radiance_difference(
            self, scene: Any, ss: Any, depth: Any, sampler: Any, wavelengths: Any, active: Any
        ) -> tuple[Any, Any]:
            primal = dr.ADMode.Primal
            ray = ss.spawn_ray(wavelengths)
            background, *_ = self.sample(primal, scene, sampler, ray, depth, active=active)
            hit = dr.zeros(mi.PreliminaryIntersection3f)
            hit.t, hit.prim_index, hit.prim_uv = 1, ss.prim_index, ss.uv
            surface = self.at(hit, mi.Ray3f(ss.p - ss.d, ss.d), active)
            foreground, *_ = self.sample(
                primal, scene, sampler, ray, depth, active=active, si_shade=surface
            )
            difference = foreground - background
            return difference, active & dr.any(difference != 0)

        def at(self, hit: Any, ray: Any, active: Any) -> Any:
            """The surface that a ray hits.

            An intersection's own method is dispatched over all meshes alive, and its kernels are
            compiled anew whenever their number changes.
            """
            return self.mesh.compute_surface_interaction(ray, hit, mi.RayFlags.All, active)

    return Emitted
