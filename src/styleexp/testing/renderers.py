"""Conformance checks for rendering backends, built in or custom.

Every check takes a ``Renderer``, states in its docstring what must hold, and raises
``AssertionError`` if it doesn't. It raises ``NotApplicable`` if the backend doesn't claim the
property, in its ``capabilities`` or by its outputs. In a test suite::

    @pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
    def test_conformance(check):
        try:
            check(MyRenderer())
        except NotApplicable as reason:
            pytest.skip(str(reason))

or, all at once, ``check_renderer(MyRenderer())``, which also runs them on CUDA if the backend
claims it and there is one. The checks run in float32, alone on the backend's first device, and take
about ten seconds on one CPU core for ``SoftRaster``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import torch

from styleexp.renderers.base import Renderer, Shading
from styleexp.testing import checks
from styleexp.testing.rendering import (
    EVEN,
    assert_finite,
    assert_near,
    assert_supersampled,
    bumpy_sphere,
    cameras_around,
    devices,
    face_ids,
    front_camera,
    icosphere,
    interior_pixels,
    need,
    on,
    one_triangle,
    pixel_weights,
    rendered,
    smooth_field,
)
from styleexp.testing.visibility import (
    crop_is_part_of_whole,
    crossing_the_near_plane,
    depth_on_receding_quad,
    equal_depth_goes_to_lowest_index,
    hidden_outlines_do_not_show,
    larger_than_the_frame,
    nearer_face_wins,
    orientation,
    rectangle_through_pixel_centres,
    watertight,
    watertight_on_pixel_centres,
)

if TYPE_CHECKING:
    from torch import Tensor


Check = Callable[[Renderer], None]


def check_renderer(renderer: Renderer) -> dict[str, str]:
    """Run every check on every device that the backend claims and this machine has; see
    `checks.run`. Outcomes on the devices after the first are named ``check (device)``."""
    return checks.run([*CHECKS, *_elsewhere(devices(renderer)[1:])], renderer)


def _elsewhere(names: list[str]) -> Iterator[Check]:
    def moved(check: Check, device: str) -> Check:
        def run(renderer: Renderer) -> None:
            with on(device):
                check(renderer)

        run.__name__ = f"{check.__name__} ({device})"
        return run

    for device in names:
        yield from (moved(check, device) for check in CHECKS)


# Interpolation and light


def smooth_normals_are_perspective_correct(renderer: Renderer) -> None:
    """Smooth shading matches an independent interpolation of normals over the face in space."""
    # Two receding quads that meet at a sharp edge, so that normals vary with depth.
    vertices = torch.tensor(
        [[-1, -1, 1], [0.2, -0.5, 1.2], [1, -1, 0.5], [-1, 1, -5], [0.2, 1.5, -4], [1, 1, -6.0]]
    )
    faces = torch.tensor([[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4]])
    shading = Shading(albedo=0.6, ambient=0.4, light=(0.5, 0.3, 0.2), normals="smooth")
    out = rendered(renderer, vertices, faces, front_camera(), shading)
    ids = face_ids(out)[0]
    rows, columns = interior_pixels(ids)
    corners = vertices.double()[faces]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    summed = torch.zeros(6, 3, dtype=torch.float64)
    for corner in range(3):
        summed.index_add_(0, faces[:, corner], normals)
    vertex_normals = torch.nn.functional.normalize(summed, dim=1)
    face = ids[rows, columns]
    eye = torch.tensor([0, 0, 2.0], dtype=torch.float64)
    ray = torch.stack(
        [((columns + 0.5) / 16 - 1) / 2, (1 - (rows + 0.5) / 16) / 2, -torch.ones(len(rows))], 1
    )
    # eye + w ray = sum of weights times corners
    weights = torch.linalg.solve((corners[face] - eye).mT, ray.double())
    normal = (weights[:, :, None] * vertex_normals[faces[face]]).sum(1)
    normal = torch.nn.functional.normalize(normal, dim=1)
    expected = 0.6 * (0.4 + normal @ torch.tensor([0.5, 0.3, 0.2], dtype=torch.float64))
    assert len(rows) > 50
    assert torch.allclose(out.image[0, rows, columns, 0].double(), expected.clamp(0, 1), atol=2e-3)


def light_moves_with_the_camera(renderer: Renderer) -> None:
    """Flat shading follows the formula; a tensor of lights sets one light per view."""
    vertices = torch.tensor([[-1, -1, 0.3], [1, -1, -0.2], [1, 1, 0.1], [-1, 1, 0.6]]) * 0.7
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    cameras = cameras_around(3, spread=0.2)
    light = torch.tensor([[0.5, 0.2, 0.1], [0.0, 0.4, 0.6], [-0.6, 0.1, -0.5]])
    shading = Shading(albedo=0.7, ambient=0.3, light=light, background=0.8)
    out = rendered(renderer, vertices, faces, cameras, shading)
    corners = vertices[faces]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = torch.nn.functional.normalize(normals, dim=1)
    for view in range(3):
        lit = (normals @ cameras.rotation[view].T * light[view]).sum(1)
        expected = (0.7 * (0.3 + lit)).clamp(0, 1)
        ids = face_ids(out)[view]
        rows, columns = interior_pixels(ids)
        assert len(rows) > 20
        found = out.image[view, rows, columns, 0]
        assert torch.allclose(found, expected[ids[rows, columns]], atol=2e-3)
        assert torch.allclose(out.image[view, 0, 0, 0], torch.tensor(0.8), atol=1e-3)


def several_lights_are_several_pictures(renderer: Renderer) -> None:
    """Under several lights each channel, and its gradient, equals a render with that light."""
    vertices, faces = bumpy_sphere(1)
    cameras = cameras_around(2, spread=0.2)
    lights = torch.tensor([[0.5, 0.2, 0.4], [0.0, -0.4, 0.6], [-0.6, 0.1, 0.5]])
    lights = lights[:, None].expand(3, 2, 3)
    for normals in ("flat", "smooth"):
        shading = Shading(normals=normals, background=0.3)
        together, apart = vertices.clone().requires_grad_(), vertices.clone().requires_grad_()
        resolution = (48, 48)
        lit = replace(shading, light=lights)
        out = rendered(renderer, together, faces, cameras, lit, resolution)
        assert out.image.shape == (2, 48, 48, 3)
        weights = torch.linspace(0, 1, out.image.numel()).view_as(out.image).sin()
        (out.image * weights).sum().backward()
        for i, light in enumerate(lights):
            alone = replace(shading, light=light)
            one = rendered(renderer, apart, faces, cameras, alone, resolution)
            channel = one.image[..., min(i, one.image.shape[-1] - 1)]
            assert torch.allclose(out.image[..., i], channel, atol=1e-5)
            (channel * weights[..., i]).sum().backward()
        if renderer.capabilities.differentiable_shading:
            assert together.grad is not None
            assert apart.grad is not None
            error = (together.grad - apart.grad).norm()
            assert error < 1e-3 * apart.grad.norm()


# Invariance and odd input


def everything_behind_the_camera(renderer: Renderer) -> None:
    """With nothing visible, the image is background and the gradient is zero."""
    vertices, faces = bumpy_sphere(1)
    vertices = (vertices + torch.tensor([0, 0, 6.0])).requires_grad_()
    for normals in ("flat", "smooth"):
        out = rendered(renderer, vertices, faces, front_camera(), Shading(normals=normals))
        assert (out.image == 1).all()
        assert (out.coverage == 0).all()
        if renderer.capabilities.differentiable_shading and out.image.requires_grad:
            (gradient,) = torch.autograd.grad(out.image.sum(), vertices)
            assert (gradient == 0).all()


def degenerate_faces(renderer: Renderer) -> None:
    """Zero-area faces give a finite image and gradient, and occlude nothing."""
    vertices, faces = bumpy_sphere(2)
    added = torch.tensor([[0, 0, 0], [5, 5, 9], [7, 8, 7]])
    extra = torch.tensor([[0, 0, 1.2], [0.1, 0.1, 1.2], [0.2, 0.2, 1.2]])  # on one line
    line = torch.arange(3)[None] + len(vertices)
    for normals in ("flat", "smooth"):
        shading = Shading(normals=normals)
        clean = rendered(renderer, vertices, faces, cameras_around(2), shading)
        moved = torch.cat([vertices, extra]).requires_grad_()
        out = rendered(renderer, moved, torch.cat([faces, added, line]), cameras_around(2), shading)
        assert torch.allclose(out.image, clean.image, atol=1e-3)
        assert_finite(renderer, out, moved)


def camera_inside_the_mesh(renderer: Renderer) -> None:
    """Image and gradient are finite from inside the mesh, for either winding."""
    vertices, faces = bumpy_sphere(2)
    camera = replace(cameras_around(2), translation=torch.tensor([[0.05, 0, 0], [0.9, 0, 0.1]]))
    for winding in (faces, faces.flip(1)):
        for normals in ("flat", "smooth"):
            moved = vertices.clone().requires_grad_()
            out = rendered(renderer, moved, winding, camera, Shading(normals=normals))
            assert_finite(renderer, out, moved)
    assert (out.coverage[0] == 1).all()  # turned inside out, the mesh surrounds the first camera


def batch_invariance(renderer: Renderer) -> None:
    """A view doesn't depend on the rest of the batch."""
    vertices, faces = bumpy_sphere(3)
    cameras = cameras_around(4)
    together = rendered(renderer, vertices, faces, cameras)
    for view in range(4):
        alone = rendered(renderer, vertices, faces, cameras[view : view + 1])
        assert torch.allclose(alone.image[0], together.image[view], atol=1e-5)
        if alone.face_ids is not None and together.face_ids is not None:
            assert torch.equal(alone.face_ids[0], together.face_ids[view])


def face_order_invariance(renderer: Renderer) -> None:
    """The order of the faces doesn't change the image."""
    vertices, faces = bumpy_sphere(3)
    order = torch.randperm(len(faces), generator=torch.Generator().manual_seed(0))
    out = rendered(renderer, vertices, faces, cameras_around(2))
    shuffled = rendered(renderer, vertices, faces[order], cameras_around(2))
    assert torch.allclose(out.image, shuffled.image, atol=1e-4)
    if out.face_ids is not None and shuffled.face_ids is not None:
        seen = shuffled.face_ids >= 0
        assert torch.equal(seen, out.face_ids >= 0)
        assert torch.equal(order.to(seen.device)[shuffled.face_ids[seen]], out.face_ids[seen])


def odd_sizes(renderer: Renderer) -> None:
    """No faces, one face, one pixel, an image wider than high, no views."""
    none = torch.zeros(0, 3, dtype=torch.long)
    for vertices in (torch.zeros(0, 3), torch.rand(4, 3)):
        out = rendered(renderer, vertices, none, cameras_around(2), size=(6, 9))
        assert out.image.shape[:3] == (2, 6, 9)
        assert (out.image == 1).all()
        assert (out.coverage == 0).all()
    face = torch.tensor([[0, 1, 2]])
    hard = replace(EVEN, outlines=False)  # a pixel's area would be mostly background
    one = rendered(renderer, one_triangle(), face, front_camera(), hard, (1, 1))
    assert one.coverage.shape == (1, 1, 1)
    assert abs(float(one.image[0, 0, 0, 0]) - 0.25) < 1e-3
    nothing = rendered(renderer, one_triangle(), face, cameras_around(2)[:0])
    assert nothing.image.shape[:3] == (0, 32, 32)
    # The triangle is half as wide and high as the image, its lowest row a little narrower.
    wide = rendered(renderer, one_triangle(), face, front_camera(), EVEN, (20, 60))
    covered = wide.coverage[0] > 0.5
    assert covered.shape == (20, 60)
    assert abs(int(covered.any(0).sum()) - 29) <= 1
    assert abs(int(covered.any(1).sum()) - 10) <= 1


def colours_stay_in_range(renderer: Renderer) -> None:
    """Anti-aliasing blends colours: no value leaves the range of surface and background."""
    generator = torch.Generator().manual_seed(0)
    center = torch.rand(300, 1, 3, generator=generator) * 2 - 1
    vertices = (center + 0.15 * torch.randn(300, 3, 3, generator=generator)).view(-1, 3)
    faces = torch.arange(900).view(300, 3)
    for background in (0.9, 0.0):
        shading = replace(EVEN, background=background)
        out = rendered(renderer, vertices, faces, cameras_around(3, focal=1.5), shading, (48, 48))
        low, high = min(0.25, background) - 1e-5, max(0.25, background) + 1e-5
        assert ((out.image >= low) & (out.image <= high)).all()
        assert ((out.coverage >= -1e-6) & (out.coverage <= 1 + 1e-6)).all()


# Gradients


def shading_gradient(renderer: Renderer) -> None:
    """The shading gradient, with no outline in the frame, matches finite differences."""
    need(renderer.capabilities.differentiable_shading, "shading")
    vertices, faces = bumpy_sphere(5)
    camera = replace(cameras_around(1), focal=torch.full((1, 2), 12.0))
    shading = Shading(normals="smooth")
    weight = pixel_weights(96)

    def total(moved: Tensor) -> Tensor:
        image = rendered(renderer, moved, faces, camera, shading, (96, 96)).image[0, ..., 0]
        return (image * weight.to(image)).double().sum()

    field = smooth_field(vertices)
    moved = vertices.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(total(moved), moved)
    step = 2e-3
    expected = float(total(vertices + step * field) - total(vertices - step * field)) / (2 * step)
    assert_near(float((gradient * field).sum()), expected, 0.05)


def sphere_area(renderer: Renderer) -> None:
    """A sphere's covered area, and its derivative w.r.t. the radius, match the exact formula."""
    vertices, faces = icosphere(5)
    distance, focal, radius, size = 3.0, 2.0, 0.8, 200
    camera = replace(front_camera(), translation=torch.tensor([[0, 0, -distance]]))
    scale = torch.tensor(radius, requires_grad=True)
    out = rendered(renderer, vertices * scale, faces, camera, EVEN, (size, size))
    area = out.coverage.sum() * (2 / size) ** 2
    exact = math.pi * focal**2 * radius**2 / (distance**2 - radius**2)
    assert_near(float(area.detach()), exact, 0.005)
    need(renderer.capabilities.differentiable_visibility and area.requires_grad, "visibility")
    slope = 2 * math.pi * focal**2 * radius * distance**2 / (distance**2 - radius**2) ** 2
    (gradient,) = torch.autograd.grad(area, scale)
    assert_near(float(gradient), slope, 0.02)


def rough_outline(renderer: Renderer) -> None:
    """An outline with many close edges counts once: gradient of coverage w.r.t. scale."""
    need(renderer.capabilities.differentiable_visibility, "visibility")
    vertices, faces = icosphere(5)
    generator = torch.Generator().manual_seed(0)
    vertices = vertices * (0.9 + 0.02 * torch.rand(len(vertices), 1, generator=generator))

    def total(moved: Tensor, size: int) -> Tensor:
        out = rendered(renderer, moved, faces, cameras_around(1), EVEN, (size, size))
        return out.coverage.double().mean()

    scale = torch.tensor(1.0, requires_grad=True)
    area = total(vertices * scale, 100)
    need(area.requires_grad, "visibility")
    (gradient,) = torch.autograd.grad(area, scale)
    with torch.no_grad():
        change = total(vertices * 1.01, 1000) - total(vertices * 0.99, 1000)
    assert_near(float(gradient), float(change) / 0.02, 0.1)


def triangle_area(renderer: Renderer) -> None:
    """A triangle's covered area, and its gradient w.r.t. each corner, match the exact values."""
    size = 128
    vertices = torch.tensor(
        [[-0.63, -0.71, 0], [0.77, -0.32, 0], [-0.11, 0.68, 0]], requires_grad=True
    )
    out = rendered(
        renderer, vertices, torch.tensor([[0, 1, 2]]), front_camera(), EVEN, (size, size)
    )
    area = out.coverage.sum() * (2 / size) ** 2  # one world unit is one NDC unit
    a, b, c = vertices.detach()
    first, second = b - a, c - a
    exact = float(first[0] * second[1] - first[1] * second[0]) / 2
    assert_near(float(area.detach()), exact, 0.01)
    need(renderer.capabilities.differentiable_visibility and area.requires_grad, "visibility")
    (gradient,) = torch.autograd.grad(area, vertices)
    # d area / d corner is half the opposite edge, rotated outwards.
    expected = torch.stack([(b - c)[[1, 0]], (c - a)[[1, 0]], (a - b)[[1, 0]]]) * torch.tensor(
        [0.5, -0.5]
    )
    assert torch.allclose(gradient[:, :2], expected, atol=0.04), (gradient[:, :2], expected)


def gradient_of_scale(renderer: Renderer) -> None:
    """Scaling a 20k-face mesh: gradient within 10 % of an 8x supersampled render's."""
    assert_supersampled(renderer, lambda vertices: vertices)


def gradient_of_smooth_field(renderer: Renderer) -> None:
    """Deforming a 20k-face mesh: gradient within 10 % of an 8x supersampled render's."""
    assert_supersampled(renderer, smooth_field)


CHECKS: tuple[Check, ...] = (
    watertight,
    watertight_on_pixel_centres,
    rectangle_through_pixel_centres,
    nearer_face_wins,
    equal_depth_goes_to_lowest_index,
    orientation,
    crop_is_part_of_whole,
    hidden_outlines_do_not_show,
    larger_than_the_frame,
    crossing_the_near_plane,
    depth_on_receding_quad,
    smooth_normals_are_perspective_correct,
    light_moves_with_the_camera,
    several_lights_are_several_pictures,
    everything_behind_the_camera,
    degenerate_faces,
    camera_inside_the_mesh,
    batch_invariance,
    face_order_invariance,
    odd_sizes,
    colours_stay_in_range,
    shading_gradient,
    sphere_area,
    rough_outline,
    triangle_area,
    gradient_of_scale,
    gradient_of_smooth_field,
)
"""All checks; each takes the renderer and raises ``AssertionError`` or ``NotApplicable``."""


def conformance_table() -> str:
    """Markdown table of every check for every registered renderer, with reasons for non-passes.

    ``python -m styleexp.testing`` prints the whole page.
    """
    from styleexp import plugins

    names, columns, reasons = [], [], []
    for choice in plugins.everything():
        if choice.kind != "renderer":
            continue
        renderer = plugins.build("renderer", choice.spec.config(name=choice.name))
        names.append(choice.name)
        outcomes = check_renderer(renderer)
        columns.append(outcomes)
        reasons += [
            f"- `{choice.name}`, {check.replace('_', ' ')}: {outcome}"
            for check, outcome in outcomes.items()
            if outcome != "passed"
        ]
    lines = ["| check | " + " | ".join(f"`{n}`" for n in names) + " |"]
    lines.append("| --- |" + " --- |" * len(names))
    for check in CHECKS:
        marks = ["yes" if c[check.__name__] == "passed" else "n/a" for c in columns]
        lines.append(f"| {check.__name__.replace('_', ' ')} | " + " | ".join(marks) + " |")
    return "\n".join([*lines, "", *reasons])
