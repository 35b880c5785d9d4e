"""Visibility from OpenGL, through EGL and so without a display; the rest is ``soft_raster``'s.

OpenGL draws the index of each face into an integer image, on a GPU or, with Mesa's llvmpipe, on the
CPU. Only these indices are read back, 4 bytes a pixel: OpenGL's interpolation is good to 1e-4, so
depth and barycentric coordinates are computed anew in torch, where gradients need them anyway.
(moderngl can't share images with CUDA; with a CUDA tensor, vertices go out and indices come in
through the host, and nothing else does.)
"""

from __future__ import annotations

import os
import threading
from typing import TYPE_CHECKING, Any

import torch

from styleexp.errors import UserError
from styleexp.renderers.soft_raster.deferred import DeferredRenderer, Projected
from styleexp.renderers.soft_raster.raster import Visible

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from jaxtyping import Float, Int
    from torch import Tensor

PACKAGES_REMEDY = "pip install 'styleexp[gl]'"
EGL_REMEDY = (
    "install OpenGL and EGL (Debian, Ubuntu: apt-get install libegl1 libgl1 libgl1-mesa-dri) or "
    "choose renderer=soft_raster"
)

_MARGIN = 1e-3
"""How much, relative to their depth, the depth buffer reaches beyond the nearest and farthest."""
_UNWRITTEN = -2

# Homogeneous pixels become clip coordinates with rows counted downwards, as they lie in memory.
_VERTEX = """
#version 330
uniform vec2 scale;
uniform vec2 depth;
in vec3 point;
void main() {
    gl_Position = vec4(point.xy * scale - point.z, depth.x * point.z + depth.y, point.z);
}
"""
_FACE = """
#version 330
out int id;
void main() { id = gl_PrimitiveID; }
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
    """Visibility from OpenGL; all else is ``DeferredRenderer``'s.

    Two faces at the very same depth, to about 1e-7 of the mesh's extent, count as equally near, and
    the lower index is seen. OpenGL rounds corners to 1/256 of a pixel, so a pixel centre closer to
    an edge than that may go to either side: 1 pixel in 4000 on a 40k-face mesh.

    Raises ``UserError`` where moderngl is not installed or EGL offers no OpenGL 3.3. The context is
    made once for each thread of a process; it can't be taken along into a forked process.
    """

    def __init__(self, visibility_gradient: str = "contour") -> None:
        super().__init__(visibility_gradient)
        _canvas()

    @property
    def device_name(self) -> str:
        """What OpenGL draws with: the name of a GPU, or ``llvmpipe ...`` for the CPU."""
        return str(_canvas().context.info["GL_RENDERER"])

    def find_visible(self, projected: Projected) -> Visible:
        """Draw the faces' indices; equal depth goes to the lowest."""
        ids = _canvas().draw(projected.points, projected.corners, projected)
        ids = ids.to(projected.points.device, non_blocking=True).long()
        height, width = projected.resolution
        flat = ids.view(-1)
        pixel = (flat >= 0).nonzero().view(-1)
        view = pixel // max(height * width, 1)
        face = flat.index_select(0, pixel)
        depth = projected.points.new_full(flat.shape, torch.inf)
        depth.index_copy_(0, pixel, _depth_at(projected, pixel, view, face))
        return Visible(ids, depth.view(ids.shape), pixel, view, face)


def _depth_at(
    projected: Projected,
    pixel: Int[Tensor, " n"],
    view: Int[Tensor, " n"],
    face: Int[Tensor, " n"],
) -> Float[Tensor, " n"]:
    """Depth of the faces' planes at the pixels' centres, kept within the range of their corners."""
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
    # Barycentric coordinates times a common factor; see ``InterpolateAndLight``.
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
    """An OpenGL context with its programs, and the buffers of the last size."""

    def __init__(self, context: Any) -> None:
        self.context = context
        self.largest = int(context.info["GL_MAX_TEXTURE_SIZE"])
        self.faces = context.program(vertex_shader=_VERTEX, fragment_shader=_FACE)
        nothing = context.program(vertex_shader=_EVERYWHERE, fragment_shader=_NOTHING)
        self.nothing = context.vertex_array(nothing, [])
        self._corners: tuple[Tensor, int, int] | None = None
        self._image: Any = None
        self._indices: Any = None
        self._vertices: Any = None
        self._mesh: Any = None

    def draw(
        self,
        points: Float[Tensor, "3 views vertices"],
        corners: Int[Tensor, "3 faces"],
        projected: Projected,
    ) -> Int[Tensor, "views height width"]:
        """Indices of the visible faces, int32 on the CPU, -1 on the background."""
        views, count = points.shape[1:]
        height, width = projected.resolution
        if max(height, width) > self.largest:
            raise UserError(
                f"renderer=moderngl_deferred draws images of up to {self.largest} pixels a side "
                f"here, not {height} x {width}: choose a lower resolution or renderer=soft_raster."
            )
        ids = torch.full(
            (views, height, width), _UNWRITTEN, dtype=torch.int32, pin_memory=points.is_cuda
        )
        if not corners.numel() or not ids.numel():
            return ids.fill_(-1)
        together = points.permute(1, 2, 0).to("cpu", torch.float32).contiguous().numpy()
        nearest, farthest = _depth_range(points, projected.near)
        with self.context:
            self._upload(corners, count)
            group = max(1, min(views, self.largest // height))
            self._resize(width, height * group)
            for begin in range(0, views, group):
                self._draw_group(
                    together[begin : begin + group],
                    list(zip(nearest, farthest, strict=True))[begin : begin + group],
                    projected.resolution,
                )
                part = ids[begin : begin + group]
                size = (width, height * len(part))
                self._image.read_into(part.numpy(), size, components=1, dtype="i4")
        if int(ids.min()) == _UNWRITTEN:
            raise UserError(
                "renderer=moderngl_deferred lost its OpenGL context: another library has shut EGL "
                "down in this process; use that library in a process of its own."
            )
        return ids

    def _draw_group(
        self,
        points: np.ndarray,
        ranges: list[tuple[float, float]],
        resolution: tuple[int, int],
    ) -> None:
        """Draw views below one another."""
        gl, (height, width) = self.context, resolution
        self._image.use()
        self._image.viewport = (0, 0, width, height * len(points))
        self._image.scissor = None
        self._image.clear(depth=1.0)
        # Clearing an integer image with a float colour is undefined: the background is drawn.
        gl.enable_only(gl.NOTHING)
        self.nothing.render(gl.TRIANGLES, vertices=3)
        gl.enable_only(gl.DEPTH_TEST | gl.CULL_FACE)
        gl.depth_func = "<"  # of equals, the first drawn stays
        gl.front_face = "cw"  # rows go down
        gl.cull_face = "back"
        self.faces["scale"].value = (2 / width, 2 / height)
        for view, (nearest, farthest) in enumerate(ranges):
            window = (0, view * height, width, height)
            self._image.viewport = self._image.scissor = window
            span = farthest - nearest
            self.faces["depth"].value = (
                (farthest + nearest) / span,
                -2 * farthest * nearest / span,
            )
            self._vertices.orphan()
            self._vertices.write(points[view])
            self._mesh.render(gl.TRIANGLES)
        self._image.scissor = None

    def _upload(self, corners: Tensor, count: int) -> None:
        """Bring the faces to OpenGL, unless they are the last call's."""
        indices = corners.t().to("cpu", torch.int32).contiguous()
        key = (count, len(indices))
        known = self._corners
        if known is not None and known[1:] == key and torch.equal(known[0], indices):
            return
        for buffer in (self._mesh, self._indices, self._vertices):
            if buffer is not None:
                buffer.release()
        self._indices = self.context.buffer(indices.numpy())
        self._vertices = self.context.buffer(reserve=12 * count, dynamic=True)
        self._mesh = self.context.vertex_array(
            self.faces, [(self._vertices, "3f", "point")], self._indices, 4
        )
        self._corners = (indices, *key)

    def _resize(self, width: int, height: int) -> None:
        """Make an image of at least this height and just this width, unless it is there."""
        if self._image is not None:
            if self._image.width == width and self._image.height >= height:
                return
            for part in (*self._image.color_attachments, self._image.depth_attachment, self._image):
                part.release()
        self._image = self.context.framebuffer(
            self.context.renderbuffer((width, height), 1, dtype="i4"),
            self.context.depth_renderbuffer((width, height)),
        )


def _depth_range(points: Tensor, near: float) -> tuple[list[float], list[float]]:
    """What the depth buffer is to resolve in each view: from the near plane or the nearest vertex
    behind it to the farthest vertex, so that its 24 bits count."""
    depth = points[2].nan_to_num(nan=near, posinf=near, neginf=near)
    nearest = (depth.amin(1) * (1 - _MARGIN)).clamp_min(near)
    farthest = torch.maximum(depth.amax(1), nearest) * (1 + _MARGIN)
    return nearest.tolist(), farthest.tolist()


_LOCAL = threading.local()
_OPENED_BY: set[int] = set()
"""Processes that opened EGL: this one, and those that it was forked from."""


def _canvas() -> _Canvas:
    """This thread's context: OpenGL contexts belong to one thread at a time."""
    if _OPENED_BY - {os.getpid()}:
        raise UserError(
            "renderer=moderngl_deferred can't go on in a process forked from one that has used it: "
            "start processes with multiprocessing's 'spawn'."
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
    except Exception as error:  # glcontext raises plain Exceptions
        raise UserError(
            f"renderer=moderngl_deferred can't open OpenGL through EGL ({error}): {EGL_REMEDY}."
        ) from error
    context.gc_mode = "auto"
    return context
