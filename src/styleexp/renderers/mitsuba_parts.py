"""Mitsuba itself for `mitsuba_ad`: its variant, and the integrators that it lacks."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

import torch

from styleexp.renderers import llvm

if TYPE_CHECKING:
    pass


def load_mitsuba() -> tuple[Any, Any]:
    """Import ``mitsuba``, set to our variant, and ``drjit``."""
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
def outline_gradient() -> type:
    """Class of a custom operation that returns 0 and has the gradient of outlines.

    The views' scenes are created one at a time in the backward pass, so that Dr.Jit's recorded
    graph doesn't keep them alive.
    """
    mi, dr = load_mitsuba()
    from drjit import CustomOp

    class Gradient(CustomOp):
        def eval(self, points: Any, world: Any, samples: int) -> Any:
            self.points, self.world, self.samples = points, world, samples
            height, width = world.job.resolution
            return dr.zeros(mi.Float, points.shape[0] * height * width * 2)

        def backward(self) -> None:
            grad, views = self.grad_out(), self.points.shape[0]
            parts = []
            for view in range(views):
                points, own = (portion(x, view, views) for x in (self.points.array, grad))
                parts.append(self.world.outlines(view, points, self.samples, own))
            self.set_grad_in("points", mi.TensorXf(dr.concat(parts), self.points.shape))

    return Gradient


def portion(values: Any, index: int, parts: int) -> Any:
    """Part ``index`` of ``parts`` equal parts."""
    mi, dr = load_mitsuba()
    size = dr.width(values) // parts
    first = dr.opaque(mi.UInt32, index * size)
    return dr.gather(mi.Float, values, dr.arange(mi.UInt32, size) + first)


@cache
def integrator() -> type:
    """Class of our integrator, which can only be defined once Mitsuba's variant is set."""
    mi, dr = load_mitsuba()
    from mitsuba.ad import ProjectiveDetail
    from mitsuba.ad.integrators.direct_projective import DirectProjectiveIntegrator

    class Silhouette(ProjectiveDetail):
        """Outline samples whose mesh is data, not a constant compiled into the kernels."""

        def sample_primarily_visible_silhouette(self, *arguments: Any) -> Any:
            sample = super().sample_primarily_visible_silhouette(*arguments)
            sample.shape = dr.opaque(mi.ShapePtr, self.parent.mesh)
            return sample

    class Outlines(DirectProjectiveIntegrator):
        """``direct_projective`` for surfaces that emit the shared shading, outlines only."""

        def __init__(self, world: Any, mesh: Any, view: int, numbers: Any, samples: int) -> None:
            """``numbers`` are the world indices of the mesh's faces."""
            super().__init__(mi.Properties())
            self.sppc, self.sppp, self.sppi = 0, samples, 0
            self.proj_detail = Silhouette(self)
            self.world, self.mesh, self.numbers = world, mesh, numbers
            self.view = dr.opaque(mi.UInt32, view)
            self.scene = mi.load_dict({"type": "scene", "mesh": mesh})

        def picture(self, sensor: Any, seed: int) -> Any:
            """Image with the gradient of outlines; None if there are none."""
            edges, _ = self.mesh.precompute_silhouette(mi.ScalarPoint3f(0))
            if not dr.width(edges):  # the base class treats this as an error
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
