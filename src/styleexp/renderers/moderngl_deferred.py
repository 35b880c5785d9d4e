"""Visibility from OpenGL, headless through EGL; the rest is shared with ``soft_raster``.

OpenGL draws face indices into an integer image, on a GPU or, with Mesa's llvmpipe, on the CPU. Only
these indices are read back, 4 bytes per pixel: OpenGL's interpolation is only accurate to 1e-4, so
depth and barycentric coordinates are recomputed in torch, where gradients need them anyway.
(moderngl can't share images with CUDA; for CUDA tensors, only vertices and indices pass through the
host.)
"""

from __future__ import annotations

import os
import threading
from typing import TYPE_CHECKING, Any

import torch

from styleexp.renderers.soft_raster.deferred import DeferredRenderer, Projected
from styleexp.renderers.soft_raster.raster import Visible
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from collections.abc import Callable

    from jaxtyping import Float, Int
    from torch import Tensor

PACKAGES_REMEDY = "pip install moderngl glcontext"
EGL_REMEDY = (
    "install OpenGL and EGL (Debian, Ubuntu: apt-get install libegl1 libgl1 libgl1-mesa-dri) or "
    "choose renderer=soft_raster"
)

_MARGIN = 1e-3
"""Relative margin of the depth buffer's range beyond the nearest and farthest vertex."""
_UNWRITTEN = -2

# Convert homogeneous pixels to clip coordinates, with rows downwards as in memory.
_VERTEX = """
#version 330
uniform vec2 scale;
uniform vec2 depth;
in vec3 point;
void main() {
    gl_Position = vec4(point.xy * scale - point.z, depth.x * point.z + depth.y, point.z);
}
"""
_PAIR = """
#version 330
uniform int first;
out int id;
void main() { id = first + gl_PrimitiveID; }
"""
_EVERYWHERE = """
#version 330
void main() {
    gl_Position = vec4(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0, 0.0, 1.0);
}
"""
_NOTHING = """
#version 330
out int id;
void main() { id = -1; }
"""


class ModernGLDeferred(DeferredRenderer):
    """Visibility from OpenGL; see ``DeferredRenderer`` for the rest.

    Faces at the same depth, to about 1e-7 of the mesh's extent, are ties, and the lowest index is
    visible. OpenGL rounds corners to 1/256 of a pixel, so a pixel centre closer to an edge may go
    to either side: 1 pixel in 4000 on a 40k-face mesh.

    Raises ``UserError`` if moderngl is not installed or EGL has no OpenGL 3.3. One context is
    created per thread; it can't be used in a forked process. After a render no context is current:
    use your own in ``with context:``.
    """

    def __init__(self, visibility_gradient: str = "contour") -> None:
        super().__init__(visibility_gradient)
        _canvas()

    @property
    def device_name(self) -> str:
        """OpenGL device: the name of a GPU, or ``llvmpipe ...`` for the CPU."""
        return str(_canvas().context.info["GL_RENDERER"])

    def find_visible(self, projected: Projected) -> Visible:
        """Draw the candidate faces; ties go to the lowest index."""
        device, pairs = projected.points.device, projected.pairs
        drawn = _canvas().draw(projected).to(device, non_blocking=True)
        flat = drawn.view(-1)
        pixel = (flat >= 0).nonzero().view(-1)
        seen = flat.index_select(0, pixel)
        view, face = pairs.view.index_select(0, seen), pairs.face.index_select(0, seen)
        face_ids = pairs.face.new_full(flat.shape, -1).index_copy_(0, pixel, face)
        depth = projected.points.new_full(flat.shape, torch.inf)
        depth.index_copy_(0, pixel, _depth_at(projected, pixel, view, face))
        return Visible(face_ids.view(drawn.shape), depth.view(drawn.shape), pixel, view, face)


def _depth_at(
    projected: Projected,
    pixel: Int[Tensor, " n"],
    view: Int[Tensor, " n"],
    face: Int[Tensor, " n"],
) -> Float[Tensor, " n"]:
    """Depth of the faces' planes at pixel centres, clamped to the range of their corners."""
    height, width = projected.resolution
    count = projected.points.shape[2]
    flat = projected.points.reshape(3, -1)
    within = pixel - view * (height * width)
    row = within // width
    center_x = (within - row * width).to(flat.dtype) + 0.5
    center_y = row.to(flat.dtype) + 0.5
    first = view * count
    right, down, depths = [], [], []
    for corner in projected.corners:
        index = first + corner.index_select(0, face)
        w = flat[2].index_select(0, index)
        right.append(flat[0].index_select(0, index).addcmul_(center_x, w, value=-1))
        down.append(flat[1].index_select(0, index).addcmul_(center_y, w, value=-1))
        depths.append(w)
    # Barycentric coordinates up to a common factor; see ``NormalMatrices``.
    weights = [down[j] * right[k] - right[j] * down[k] for j, k in ((1, 2), (2, 0), (0, 1))]
    total = weights[0] + weights[1] + weights[2]
    depth = weights[0] * depths[0]
    for weight, w in zip(weights[1:], depths[1:], strict=True):
        depth.addcmul_(weight, w)
    lowest = torch.minimum(torch.minimum(depths[0], depths[1]), depths[2])
    highest = torch.maximum(torch.maximum(depths[0], depths[1]), depths[2])
    depth = torch.where(total == 0, lowest, depth / torch.where(total == 0, 1.0, total))
    return torch.clamp(depth, lowest.clamp_min(projected.near), highest)


class _Canvas:
    """An OpenGL context with its programs, buffers and image."""

    def __init__(self, context: Any) -> None:
        self.context = context
        self.largest = int(context.info["GL_MAX_TEXTURE_SIZE"])
        self.faces = context.program(vertex_shader=_VERTEX, fragment_shader=_PAIR)
        nothing = context.program(vertex_shader=_EVERYWHERE, fragment_shader=_NOTHING)
        self.nothing = context.vertex_array(nothing, [])
        self.vertices = context.buffer(reserve=12, dynamic=True)
        self.indices = context.buffer(reserve=12, dynamic=True)
        inputs = [(self.vertices, "3f", "point")]
        self.mesh = context.vertex_array(self.faces, inputs, self.indices, 4)
        self._image: Any = None

    def draw(self, projected: Projected) -> Int[Tensor, "views height width"]:
        """Visible pair per pixel: index into ``projected.pairs``, -1 on the background; int32, on
        the CPU."""
        points, pairs = projected.points, projected.pairs
        views, count = points.shape[1:]
        height, width = projected.resolution
        if max(height, width) > self.largest:
            raise UserError(
                f"renderer=moderngl_deferred can draw images of up to {self.largest} pixels per "
                f"side here, not {height} x {width}: choose a lower resolution or "
                "renderer=soft_raster."
            )
        drawn = torch.full(
            (views, height, width), _UNWRITTEN, dtype=torch.int32, pin_memory=points.is_cuda
        )
        if not pairs.face.numel() or not drawn.numel():
            return drawn.fill_(-1)
        corners = projected.corners.index_select(1, pairs.face) + pairs.view * count
        triangles = corners.t().to("cpu", torch.int32).contiguous()
        vertices = points.permute(1, 2, 0).to("cpu", torch.float32).contiguous()
        per_view = torch.bincount(pairs.view, minlength=views)
        ranges = _depth_ranges(points, projected.near)
        with self.context:
            for buffer, content in ((self.vertices, vertices), (self.indices, triangles)):
                buffer.orphan(content.numel() * 4)
                buffer.write(content.numpy())
            together = max(1, min(views, self.largest // height))
            self._resize(width, height * together)
            first = 0
            jobs = list(zip(per_view.tolist(), ranges, strict=True))
            for begin in range(0, views, together):
                some = jobs[begin : begin + together]
                first = self._draw_views(some, first, height, width)
                self._image.read_into(
                    drawn[begin : begin + together].numpy(),
                    (width, height * len(some)),
                    components=1,
                    dtype="i4",
                )
        if int(drawn.min()) == _UNWRITTEN:
            raise UserError(
                "renderer=moderngl_deferred lost its OpenGL context: another library has shut down "
                "EGL in this process; use that library in a separate process."
            )
        return drawn

    def _draw_views(
        self, jobs: list[tuple[int, tuple[float, float]]], first: int, height: int, width: int
    ) -> int:
        """Draw views, given as (faces, depth range), one below the other, starting at pair
        ``first``; return the next pair."""
        gl, image, uniforms = self.context, self._image, self.faces
        image.use()
        image.viewport = (0, 0, width, height * len(jobs))
        image.scissor = None
        image.clear(depth=1.0)
        # Clearing an integer image with a float colour is undefined, so draw the background.
        gl.enable_only(gl.NOTHING)
        self.nothing.render(gl.TRIANGLES, vertices=3)
        gl.enable_only(gl.DEPTH_TEST | gl.CULL_FACE)
        gl.depth_func = "<"  # ties keep the first face drawn
        gl.front_face = "cw"  # rows go down
        gl.cull_face = "back"
        uniforms["scale"].value = (2 / width, 2 / height)
        for view, (number, (nearest, farthest)) in enumerate(jobs):
            image.viewport = image.scissor = (0, view * height, width, height)
            span = farthest - nearest
            uniforms["depth"].value = ((farthest + nearest) / span, -2 * farthest * nearest / span)
            uniforms["first"].value = first
            if number:
                self.mesh.render(gl.TRIANGLES, vertices=3 * number, first=3 * first)
            first += number
        image.scissor = None
        return first

    def _resize(self, width: int, height: int) -> None:
        """Allocate an image of at least this height and exactly this width, unless it exists."""
        if self._image is not None:
            if self._image.width == width and self._image.height >= height:
                return
            for part in (*self._image.color_attachments, self._image.depth_attachment, self._image):
                part.release()
        self._image = self.context.framebuffer(
            self.context.renderbuffer((width, height), 1, dtype="i4"),
            self.context.depth_renderbuffer((width, height)),
        )


def _depth_ranges(points: Tensor, near: float) -> list[tuple[float, float]]:
    """Depth range of each view: from the near plane, or the nearest vertex behind it, to the
    farthest vertex, to make the best use of 24 bits."""
    depth = points[2].nan_to_num(nan=near, posinf=near, neginf=near)
    nearest = (depth.amin(1) * (1 - _MARGIN)).clamp_min(near)
    farthest = torch.maximum(depth.amax(1), nearest) * (1 + _MARGIN)
    return list(zip(nearest.tolist(), farthest.tolist(), strict=True))


_LOCAL = threading.local()
_OPENED_BY: set[int] = set()
"""IDs of processes that opened EGL: this one, and those it was forked from."""


def _canvas() -> _Canvas:
    """This thread's context; OpenGL contexts belong to one thread at a time."""
    if _OPENED_BY - {os.getpid()}:
        raise UserError(
            "renderer=moderngl_deferred can't be used in a process forked from one that has used "
            "it: start processes with multiprocessing's 'spawn'."
        )
    canvas = getattr(_LOCAL, "canvas", None)
    if canvas is None:
        canvas = _LOCAL.canvas = _Canvas(_open(_create_context()))
        _OPENED_BY.add(os.getpid())
    return canvas


def _create_context() -> Callable[..., Any]:
    try:
        import glcontext  # noqa: F401  (moderngl imports it when used)
        import moderngl
    except ImportError as error:
        raise UserError(
            f"renderer=moderngl_deferred needs a package that can't be imported ({error}): "
            f"{PACKAGES_REMEDY}."
        ) from error
    return moderngl.create_context


def _open(create_context: Callable[..., Any]) -> Any:
    try:
        context = create_context(standalone=True, backend="egl", require=330)
    except Exception as error:  # glcontext raises plain `Exception`
        reason = " ".join(str(error).split())
        raise UserError(
            f"renderer=moderngl_deferred can't open OpenGL through EGL ({reason}): {EGL_REMEDY}."
        ) from error
    context.gc_mode = "auto"
    return context
