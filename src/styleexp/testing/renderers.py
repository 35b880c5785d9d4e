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

or, all at once, ``check_renderer(MyRenderer())``. The checks run in float32 on the backend's first
device, and take about ten seconds on one CPU core for ``SoftRaster``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import torch

from styleexp.renderers.base import Cameras, Renderer, RenderOutput, Shading
from styleexp.testing import checks
from styleexp.testing.checks import NotApplicable

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from torch import Tensor

EVEN = Shading(albedo=0.25, ambient=1.0, light=(0.0, 0.0, 0.0))
"""Shading with intensity 0.25 everywhere, so that only outlines show."""


Check = Callable[[Renderer], None]


def check_renderer(renderer: Renderer) -> dict[str, str]:
    """Run every check; see `checks.run`."""
    return checks.run(CHECKS, renderer)


# What is visible


def watertight(renderer: Renderer) -> None:
    """Rendered one at a time, the faces of a jittered grid cover each pixel inside exactly once."""
    for seed in range(3):
        vertices, faces = _grid(5, seed)
        _assert_covered_once(renderer, vertices, faces)


def watertight_on_pixel_centres(renderer: Renderer) -> None:
    """`watertight`, with all vertices snapped to pixel centres and corners."""
    _need_ties(renderer)
    for seed in range(3):
        vertices, faces = _grid(5, seed)
        vertices[:, :2] = (vertices[:, :2] * 32).round() / 32  # half pixels of a 32 x 32 image
        _assert_covered_once(renderer, vertices, faces)


def rectangle_through_pixel_centres(renderer: Renderer) -> None:
    """Edges through pixel centres own exactly half of them; with reversed winding it is culled."""
    _need_ties(renderer)
    low_x, high_x, low_y, high_y = 4.5, 21.5, 6.5, 15.5
    corners = [(low_x, low_y), (low_x, high_y), (high_x, high_y), (high_x, low_y)]
    vertices = torch.tensor([[x / 16 - 1, 1 - y / 16, 0] for x, y in corners])
    expected = int((high_x - low_x) * (high_y - low_y))
    for faces in ([[0, 1, 2], [0, 2, 3]], [[1, 2, 3], [3, 0, 1]], [[2, 0, 1], [3, 0, 2]]):
        wound = torch.tensor(faces)
        for from_behind, face, count in (
            (False, wound, expected),
            (False, wound.flip(1), 0),
            (True, wound, 0),
            (True, wound.flip(1), expected),
        ):
            out = _render(renderer, vertices, face, _front_camera(from_behind), EVEN, (32, 32))
            assert int((_ids(out) >= 0).sum()) == count, (faces, from_behind, count)


def nearer_face_wins(renderer: Renderer) -> None:
    """The nearer of two overlapping faces is visible, regardless of their order."""
    near, far = _triangle(z=0.5), _triangle(z=-0.5)
    for first, second, winner in ((near, far, 0), (far, near, 1)):
        vertices = torch.cat([first, second])
        out = _render(renderer, vertices, torch.arange(6).view(2, 3), _front_camera())
        assert int(_ids(out)[0, 16, 16]) == winner
        inside = _ids(out)[0][10:20, 14:18]
        assert (inside == winner).all()


def equal_depth_goes_to_lowest_index(renderer: Renderer) -> None:
    """Of coincident faces, the first is visible."""
    _need_ties(renderer)
    faces = torch.tensor([[0, 1, 2]]).repeat(5, 1)
    ids = _ids(_render(renderer, _triangle(), faces, _front_camera()))
    assert ids.max() == 0
    assert (ids == 0).sum() > 50


def orientation(renderer: Renderer) -> None:
    """An asymmetric image is neither flipped nor mirrored: rows go down, columns right."""
    # A right angle at the top left, and one pixel at the bottom right.
    big = [(1, 1), (1, 5), (7, 1)]
    dot = [(6, 6), (6, 8), (8, 6)]
    vertices = torch.tensor([[x / 4 - 1, 1 - y / 4, 0.0] for x, y in big + dot])
    ids = _ids(
        _render(
            renderer, vertices, torch.tensor([[0, 1, 2], [3, 4, 5]]), _front_camera(), size=(8, 8)
        )
    )
    expected = [
        "........",
        ".00000..",
        ".0000...",
        ".00.....",
        ".0......",
        "........",
        "......1.",
        "........",
    ]
    # The hypotenuses pass through no pixel centres but the dot's own, and may own two of them.
    found = ["".join("." if i < 0 else str(i) for i in row) for row in ids[0].tolist()]
    found[6] = found[6].replace("11", "1.")
    found[7] = found[7].replace("1", ".")
    assert found == expected, "\n".join(found)


def crop_is_part_of_whole(renderer: Renderer) -> None:
    """A camera with off-centre ``center`` and longer ``focal`` sees a window of the whole view."""
    vertices, faces = bumpy_sphere(3)
    camera = _cameras(1, focal=2.0)
    whole = _render(renderer, vertices, faces, camera, size=(128, 128))
    top, left, height, width = 24, 40, 32, 48
    zoom = torch.tensor([[128 / width, 128 / height]])
    middle = torch.tensor([[(left + width / 2) / 64 - 1, 1 - (top + height / 2) / 64]])
    crop = replace(camera, focal=camera.focal * zoom, center=(camera.center - middle) * zoom)
    part = _render(renderer, vertices, faces, crop, size=(height, width))
    window = whole.image[:, top : top + height, left : left + width]
    difference = (part.image - window)[:, 1:-1, 1:-1].abs()  # outlines next to the frame may differ
    assert (difference > 0.01).float().mean() < 0.01, difference.mean()


def hidden_outlines_do_not_show(renderer: Renderer) -> None:
    """Geometry entirely behind a surface affects neither image nor gradient."""
    wall = torch.tensor([[-4.0, -4, 1.2], [4, -4, 0.9], [4, 4, 0.8], [-4, 4, 1.1]])
    wall_faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    behind, faces = bumpy_sphere(3)
    vertices = torch.cat([wall, 0.6 * behind]).requires_grad_()
    light = Shading(background=0.0)
    alone = _render(renderer, wall, wall_faces, _front_camera(), light)
    out = _render(renderer, vertices, torch.cat([wall_faces, faces + 4]), _front_camera(), light)
    assert torch.allclose(out.image, alone.image, atol=1e-4)
    if renderer.capabilities.differentiable_shading:
        weight = _weight(32)[:, :, None]
        (gradient,) = torch.autograd.grad((out.image * weight).sum(), vertices)
        assert gradient[4:].abs().max() < 1e-4 * gradient[:4].abs().max()


def larger_than_the_frame(renderer: Renderer) -> None:
    """Faces much larger than the image fill it, at any zoom."""
    vertices, faces = _grid(1, 0)
    for zoom in (3.0, 30.0, 3000.0):
        camera = replace(_front_camera(), focal=torch.full((1, 2), 2 * zoom))
        out = _render(renderer, vertices, faces, camera, EVEN, (70, 90))
        assert (out.coverage == 1).all(), zoom
        assert torch.allclose(out.image, torch.tensor(0.25)), zoom


def crossing_the_near_plane(renderer: Renderer) -> None:
    """Faces that extend behind the camera look like faces clipped at the near plane."""
    camera = replace(_front_camera(), near=0.25)  # at z = 2, looking along -z
    edge = 2 - camera.near
    floor = torch.tensor([[-4.0, -1, 5], [4, -1, 5], [4, -1, -3], [-4, -1, -3]])
    cut = floor.clone()
    cut[:2, 2] = edge
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    # Vary the diagonal, so that one or two corners of a face are behind the camera.
    for turn in range(4):
        ahead = floor.roll(turn, 0)
        out = _render(renderer, ahead, faces, camera)
        expected = _render(renderer, cut, faces, camera)
        assert ((out.coverage > 0.5) == (expected.coverage > 0.5)).all()
        assert (expected.coverage > 0.5).any()
        assert torch.allclose(out.image, expected.image, atol=2e-3)
        if out.depth is not None and expected.depth is not None:
            both = out.depth.isfinite() & expected.depth.isfinite()
            assert torch.allclose(out.depth[both], expected.depth[both], rtol=1e-3)
    # A triangle with one corner in front, and its front part alone.
    spike = torch.tensor([[0.1, 0.2, 0.0], [-3, -2, 4.0], [3, -2, 4.0]])
    share = (edge - spike[0, 2]) / (spike[1:, 2] - spike[0, 2])
    part = torch.cat([spike[:1], spike[:1] + share[:, None] * (spike[1:] - spike[:1])])
    for winding in ([0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 2, 1]):
        out = _render(renderer, spike, torch.tensor([winding]), camera)
        expected = _render(renderer, part, torch.tensor([winding]), camera)
        assert ((out.coverage > 0.5) != (expected.coverage > 0.5)).sum() <= 1
        assert torch.allclose(out.image, expected.image, atol=0.02)


# Interpolation and light


def depth_on_receding_quad(renderer: Renderer) -> None:
    """Ray times depth lies on the plane of a quad that recedes from the camera."""
    vertices = torch.tensor([[-1.0, -1, 1], [1, -1, 1], [1, 1, -6], [-1, 1, -6]])
    out = _render(renderer, vertices, torch.tensor([[0, 1, 2], [0, 2, 3]]), _front_camera())
    if out.depth is None:
        raise NotApplicable("returns no depth")
    rows, columns = torch.nonzero(out.depth[0].isfinite(), as_tuple=True)
    assert rows.numel() > 50
    w = out.depth[0][rows, columns]
    x, y = ((columns + 0.5) / 16 - 1) / 2 * w, (1 - (rows + 0.5) / 16) / 2 * w
    z = 2 - w
    assert torch.allclose(z, 1 - (y + 1) * 3.5, atol=2e-4)
    assert (x.abs() < 1 + 1e-4).all()


def smooth_normals_are_perspective_correct(renderer: Renderer) -> None:
    """Smooth shading matches an independent interpolation of normals over the face in space."""
    # Two receding quads that meet at a sharp edge, so that normals vary with depth.
    vertices = torch.tensor(
        [[-1, -1, 1], [0.2, -0.5, 1.2], [1, -1, 0.5], [-1, 1, -5], [0.2, 1.5, -4], [1, 1, -6.0]]
    )
    faces = torch.tensor([[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4]])
    shading = Shading(albedo=0.6, ambient=0.4, light=(0.5, 0.3, 0.2), normals="smooth")
    out = _render(renderer, vertices, faces, _front_camera(), shading)
    ids = _ids(out)[0]
    rows, columns = _interior(ids)
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
    cameras = _cameras(3, spread=0.2)
    light = torch.tensor([[0.5, 0.2, 0.1], [0.0, 0.4, 0.6], [-0.6, 0.1, -0.5]])
    shading = Shading(albedo=0.7, ambient=0.3, light=light, background=0.8)
    out = _render(renderer, vertices, faces, cameras, shading)
    corners = vertices[faces]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = torch.nn.functional.normalize(normals, dim=1)
    for view in range(3):
        lit = (normals @ cameras.rotation[view].T * light[view]).sum(1)
        expected = (0.7 * (0.3 + lit)).clamp(0, 1)
        ids = _ids(out)[view]
        rows, columns = _interior(ids)
        assert len(rows) > 20
        found = out.image[view, rows, columns, 0]
        assert torch.allclose(found, expected[ids[rows, columns]], atol=2e-3)
        assert torch.allclose(out.image[view, 0, 0, 0], torch.tensor(0.8), atol=1e-3)


def several_lights_are_several_pictures(renderer: Renderer) -> None:
    """Under several lights each channel, and its gradient, equals a render with that light."""
    vertices, faces = bumpy_sphere(1)
    cameras = _cameras(2, spread=0.2)
    lights = torch.tensor([[0.5, 0.2, 0.4], [0.0, -0.4, 0.6], [-0.6, 0.1, 0.5]])
    lights = lights[:, None].expand(3, 2, 3)
    for normals in ("flat", "smooth"):
        shading = Shading(normals=normals, background=0.3)
        together, apart = vertices.clone().requires_grad_(), vertices.clone().requires_grad_()
        resolution = (48, 48)
        lit = replace(shading, light=lights)
        out = renderer.render(together, faces, cameras, lit, resolution)
        assert out.image.shape == (2, 48, 48, 3)
        weights = torch.linspace(0, 1, out.image.numel()).view_as(out.image).sin()
        (out.image * weights).sum().backward()
        for i, light in enumerate(lights):
            one = renderer.render(apart, faces, cameras, replace(shading, light=light), resolution)
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
        out = _render(renderer, vertices, faces, _front_camera(), Shading(normals=normals))
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
        clean = _render(renderer, vertices, faces, _cameras(2), shading)
        moved = torch.cat([vertices, extra]).requires_grad_()
        out = _render(renderer, moved, torch.cat([faces, added, line]), _cameras(2), shading)
        assert torch.allclose(out.image, clean.image, atol=1e-3)
        _assert_finite(renderer, out, moved)


def camera_inside_the_mesh(renderer: Renderer) -> None:
    """Image and gradient are finite from inside the mesh, for either winding."""
    vertices, faces = bumpy_sphere(2)
    camera = replace(_cameras(2), translation=torch.tensor([[0.05, 0, 0], [0.9, 0, 0.1]]))
    for winding in (faces, faces.flip(1)):
        for normals in ("flat", "smooth"):
            moved = vertices.clone().requires_grad_()
            out = _render(renderer, moved, winding, camera, Shading(normals=normals))
            _assert_finite(renderer, out, moved)
    assert (out.coverage[0] == 1).all()  # turned inside out, the mesh surrounds the first camera


def batch_invariance(renderer: Renderer) -> None:
    """A view doesn't depend on the rest of the batch."""
    vertices, faces = bumpy_sphere(3)
    cameras = _cameras(4)
    together = _render(renderer, vertices, faces, cameras)
    for view in range(4):
        alone = _render(renderer, vertices, faces, cameras[view : view + 1])
        assert torch.allclose(alone.image[0], together.image[view], atol=1e-5)
        if alone.face_ids is not None and together.face_ids is not None:
            assert torch.equal(alone.face_ids[0], together.face_ids[view])


def face_order_invariance(renderer: Renderer) -> None:
    """The order of the faces doesn't change the image."""
    vertices, faces = bumpy_sphere(3)
    order = torch.randperm(len(faces), generator=torch.Generator().manual_seed(0))
    out = _render(renderer, vertices, faces, _cameras(2))
    shuffled = _render(renderer, vertices, faces[order], _cameras(2))
    assert torch.allclose(out.image, shuffled.image, atol=1e-4)
    if out.face_ids is not None and shuffled.face_ids is not None:
        seen = shuffled.face_ids >= 0
        assert torch.equal(seen, out.face_ids >= 0)
        assert torch.equal(order.to(seen.device)[shuffled.face_ids[seen]], out.face_ids[seen])


def odd_sizes(renderer: Renderer) -> None:
    """No faces, one face, one pixel, an image wider than high, no views."""
    none = torch.zeros(0, 3, dtype=torch.long)
    for vertices in (torch.zeros(0, 3), torch.rand(4, 3)):
        out = _render(renderer, vertices, none, _cameras(2), size=(6, 9))
        assert out.image.shape[:3] == (2, 6, 9)
        assert (out.image == 1).all()
        assert (out.coverage == 0).all()
    face = torch.tensor([[0, 1, 2]])
    hard = replace(EVEN, outlines=False)  # a pixel's area would be mostly background
    one = _render(renderer, _triangle(), face, _front_camera(), hard, (1, 1))
    assert one.coverage.shape == (1, 1, 1)
    assert abs(float(one.image[0, 0, 0, 0]) - 0.25) < 1e-3
    nothing = _render(renderer, _triangle(), face, _cameras(2)[:0])
    assert nothing.image.shape[:3] == (0, 32, 32)
    # The triangle is half as wide and high as the image, its lowest row a little narrower.
    wide = _render(renderer, _triangle(), face, _front_camera(), EVEN, (20, 60))
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
        out = _render(renderer, vertices, faces, _cameras(3, focal=1.5), shading, (48, 48))
        low, high = min(0.25, background) - 1e-5, max(0.25, background) + 1e-5
        assert ((out.image >= low) & (out.image <= high)).all()
        assert ((out.coverage >= -1e-6) & (out.coverage <= 1 + 1e-6)).all()


# Gradients


def shading_gradient(renderer: Renderer) -> None:
    """The shading gradient, with no outline in the frame, matches finite differences."""
    _need(renderer.capabilities.differentiable_shading, "shading")
    vertices, faces = bumpy_sphere(5)
    camera = replace(_cameras(1), focal=torch.full((1, 2), 12.0))
    shading = Shading(normals="smooth")
    weight = _weight(96)

    def total(moved: Tensor) -> Tensor:
        image = _render(renderer, moved, faces, camera, shading, (96, 96)).image[0, ..., 0]
        return (image * weight.to(image)).double().sum()

    field = _smooth_field(vertices)
    moved = vertices.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(total(moved), moved)
    step = 2e-3
    expected = float(total(vertices + step * field) - total(vertices - step * field)) / (2 * step)
    _assert_near(float((gradient * field).sum()), expected, 0.05)


def sphere_area(renderer: Renderer) -> None:
    """A sphere's covered area, and its derivative w.r.t. the radius, match the exact formula."""
    vertices, faces = icosphere(5)
    distance, focal, radius, size = 3.0, 2.0, 0.8, 200
    camera = replace(_front_camera(), translation=torch.tensor([[0, 0, -distance]]))
    scale = torch.tensor(radius, requires_grad=True)
    out = _render(renderer, vertices * scale, faces, camera, EVEN, (size, size))
    area = out.coverage.sum() * (2 / size) ** 2
    exact = math.pi * focal**2 * radius**2 / (distance**2 - radius**2)
    _assert_near(float(area.detach()), exact, 0.005)
    _need(renderer.capabilities.differentiable_visibility and area.requires_grad, "visibility")
    slope = 2 * math.pi * focal**2 * radius * distance**2 / (distance**2 - radius**2) ** 2
    (gradient,) = torch.autograd.grad(area, scale)
    _assert_near(float(gradient), slope, 0.02)


def rough_outline(renderer: Renderer) -> None:
    """An outline with many close edges counts once: gradient of coverage w.r.t. scale."""
    _need(renderer.capabilities.differentiable_visibility, "visibility")
    vertices, faces = icosphere(5)
    generator = torch.Generator().manual_seed(0)
    vertices = vertices * (0.9 + 0.02 * torch.rand(len(vertices), 1, generator=generator))

    def total(moved: Tensor, size: int) -> Tensor:
        out = _render(renderer, moved, faces, _cameras(1), EVEN, (size, size))
        return out.coverage.double().mean()

    scale = torch.tensor(1.0, requires_grad=True)
    area = total(vertices * scale, 100)
    _need(area.requires_grad, "visibility")
    (gradient,) = torch.autograd.grad(area, scale)
    with torch.no_grad():
        change = total(vertices * 1.01, 1000) - total(vertices * 0.99, 1000)
    _assert_near(float(gradient), float(change) / 0.02, 0.1)


def triangle_area(renderer: Renderer) -> None:
    """A triangle's covered area, and its gradient w.r.t. each corner, match the exact values."""
    size = 128
    vertices = torch.tensor(
        [[-0.63, -0.71, 0], [0.77, -0.32, 0], [-0.11, 0.68, 0]], requires_grad=True
    )
    out = _render(
        renderer, vertices, torch.tensor([[0, 1, 2]]), _front_camera(), EVEN, (size, size)
    )
    area = out.coverage.sum() * (2 / size) ** 2  # one world unit is one NDC unit
    a, b, c = vertices.detach()
    first, second = b - a, c - a
    exact = float(first[0] * second[1] - first[1] * second[0]) / 2
    _assert_near(float(area.detach()), exact, 0.01)
    _need(renderer.capabilities.differentiable_visibility and area.requires_grad, "visibility")
    (gradient,) = torch.autograd.grad(area, vertices)
    # d area / d corner is half the opposite edge, rotated outwards.
    expected = torch.stack([(b - c)[[1, 0]], (c - a)[[1, 0]], (a - b)[[1, 0]]]) * torch.tensor(
        [0.5, -0.5]
    )
    assert torch.allclose(gradient[:, :2], expected, atol=0.04), (gradient[:, :2], expected)


def gradient_of_scale(renderer: Renderer) -> None:
    """Scaling a 20k-face mesh: gradient within 10 % of an 8x supersampled render's."""
    _assert_supersampled(renderer, lambda vertices: vertices)


def gradient_of_smooth_field(renderer: Renderer) -> None:
    """Deforming a 20k-face mesh: gradient within 10 % of an 8x supersampled render's."""
    _assert_supersampled(renderer, _smooth_field)


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


# Shapes


def icosphere(
    subdivisions: int,
) -> tuple[Float[Tensor, "vertices 3"], Int[Tensor, "faces 3"]]:
    """Unit sphere of 20 * 4**subdivisions faces, counter-clockwise seen from outside."""
    golden = (1 + math.sqrt(5)) / 2
    axes = [(0, a, b * golden) for a in (-1, 1) for b in (-1, 1)]
    vertices = torch.tensor([p[i:] + p[:i] for i in range(3) for p in axes], dtype=torch.float64)
    # Three corners one edge length apart make a face.
    near = torch.cdist(vertices, vertices).sub(2).abs() < 1e-6
    faces = torch.combinations(torch.arange(12), 3)
    a, b, c = faces.unbind(1)
    faces = faces[near[a, b] & near[b, c] & near[a, c]]
    outwards = torch.linalg.det(vertices[faces]) > 0
    faces = torch.where(outwards[:, None], faces, faces.flip(1))
    for _ in range(subdivisions):
        edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(1)[0]
        edges, index = torch.unique(edges, dim=0, return_inverse=True)
        ab, bc, ca = (index + len(vertices)).view(3, -1)
        vertices = torch.cat([vertices, vertices[edges].mean(1)])
        a, b, c = faces.unbind(1)
        parts = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
        faces = torch.cat([torch.stack(part, 1) for part in parts])
    return torch.nn.functional.normalize(vertices, dim=1).float(), faces


def bumpy_sphere(
    subdivisions: int,
) -> tuple[Float[Tensor, "vertices 3"], Int[Tensor, "faces 3"]]:
    """An icosphere of radius about 1 with broad asymmetric bumps."""
    vertices, faces = icosphere(subdivisions)
    x, y, z = vertices.unbind(1)
    radius = 0.9 + 0.12 * torch.sin(4 * x + 1) * torch.cos(3 * y) + 0.06 * torch.sin(5 * z + 2 * y)
    return vertices * radius[:, None], faces


def _grid(cells: int, seed: int) -> tuple[Tensor, Tensor]:
    """A square of 2 * cells**2 faces at z = 0, with jittered inner vertices."""
    steps = torch.linspace(-0.8, 0.8, cells + 1)
    y, x = torch.meshgrid(steps, steps, indexing="ij")
    vertices = torch.stack([x, y, torch.zeros_like(x)], 2)
    generator = torch.Generator().manual_seed(seed)
    jitter = torch.rand(cells + 1, cells + 1, 2, generator=generator) - 0.5
    vertices[1:-1, 1:-1, :2] += (jitter * 0.6 / cells)[1:-1, 1:-1]
    index = torch.arange((cells + 1) ** 2).view(cells + 1, cells + 1)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = torch.stack([torch.stack([a, b, c], -1), torch.stack([a, c, d], -1)]).view(-1, 3)
    return vertices.view(-1, 3), faces


def _triangle(z: float = 0.0) -> Tensor:
    """A triangle of base and height 1, facing +z."""
    return torch.tensor([[-0.5, -0.5, z], [0.5, -0.5, z], [0.0, 0.5, z]])


# Cameras and comparisons


def _front_camera(from_behind: bool = False) -> Cameras:
    """Camera on +z (or -z), two units from the origin: world units at z = 0 are NDC units."""
    turn = torch.diag(torch.tensor([-1.0, 1, -1])) if from_behind else torch.eye(3)
    return Cameras(
        turn[None], torch.tensor([[0, 0, -2.0]]), torch.full((1, 2), 2.0), torch.zeros(1, 2)
    )


def _cameras(count: int, focal: float = 2.2, spread: float = 1.0) -> Cameras:
    """Cameras around the origin at distance 2.5 and various heights, the first in front."""
    azimuth = torch.arange(count) * (2 * math.pi / count) * spread + 0.2
    height = 0.4 * torch.sin(torch.arange(count) * 1.7 + 0.5)
    backward = torch.stack(
        [azimuth.sin() * height.cos(), height.sin(), azimuth.cos() * height.cos()], 1
    )
    right = torch.stack([azimuth.cos(), torch.zeros(count), -azimuth.sin()], 1)
    rotation = torch.stack([right, torch.linalg.cross(backward, right), backward], 1)
    translation = torch.tensor([0, 0, -2.5]).expand(count, 3)
    return Cameras(rotation, translation, torch.full((count, 2), focal), torch.zeros(count, 2))


def _render(
    renderer: Renderer,
    vertices: Tensor,
    faces: Tensor,
    cameras: Cameras,
    shading: Shading | None = None,
    size: tuple[int, int] = (32, 32),
) -> RenderOutput:
    """Render on the backend's first device, and return the result on the CPU."""
    device = renderer.capabilities.devices[0]
    out = renderer.render(
        vertices.to(device),
        faces.to(device),
        replace(
            cameras,
            rotation=cameras.rotation.to(device),
            translation=cameras.translation.to(device),
            focal=cameras.focal.to(device),
            center=cameras.center.to(device),
        ),
        shading or Shading(),
        size,
    )
    return RenderOutput(
        out.image.cpu(),
        out.coverage.cpu(),
        None if out.face_ids is None else out.face_ids.cpu().long(),
        None if out.depth is None else out.depth.cpu(),
    )


def _ids(out: RenderOutput) -> Tensor:
    if out.face_ids is None:
        raise NotApplicable("returns no face ids")
    return out.face_ids


def _need(claimed: bool, what: str) -> None:
    if not claimed:
        raise NotApplicable(f"is not differentiable w.r.t. {what}")


def _need_ties(renderer: Renderer) -> None:
    if not renderer.capabilities.decides_ties:
        raise NotApplicable("does not decide ties")


def _interior(ids: Tensor) -> tuple[Tensor, Tensor]:
    """Rows and columns of covered pixels whose eight neighbours see the same face."""
    around = ids.unfold(0, 3, 1).unfold(1, 3, 1).reshape(*(side - 2 for side in ids.shape), 9)
    same = (around == around[..., 4:5]).all(-1) & (around[..., 4] >= 0)
    rows, columns = torch.nonzero(same, as_tuple=True)
    return rows + 1, columns + 1


def _assert_covered_once(renderer: Renderer, vertices: Tensor, faces: Tensor) -> None:
    together = _ids(_render(renderer, vertices, faces, _front_camera())) >= 0
    total = torch.zeros_like(together, dtype=torch.long)
    for face in faces:
        total += _ids(_render(renderer, vertices, face[None], _front_camera())) >= 0
    assert torch.equal(total, together.long())
    assert together[0, 4:28, 4:28].all()
    assert not together[0, :3].any()


def _assert_finite(renderer: Renderer, out: RenderOutput, vertices: Tensor) -> None:
    assert out.image.isfinite().all()
    assert out.coverage.isfinite().all()
    if renderer.capabilities.differentiable_shading:
        total = (out.image * torch.linspace(0, 1, out.image.shape[1])[:, None, None]).sum()
        (gradient,) = torch.autograd.grad(total + out.coverage.sum(), vertices)
        assert gradient.isfinite().all()


def _assert_near(found: float, expected: float, relative: float) -> None:
    assert abs(found - expected) <= relative * abs(expected), f"{found}, expected {expected}"


def _weight(size: int) -> Tensor:
    """Smooth pixel weights, so that no symmetry cancels."""
    y, x = torch.meshgrid(*[torch.linspace(0, 1, size)] * 2, indexing="ij")
    return torch.cos(5 * x + 1) * torch.sin(4 * y + 0.3) + 0.7


def _smooth_field(vertices: Tensor) -> Tensor:
    x, y, z = vertices.unbind(1)
    return torch.stack([torch.sin(3 * y + 1), torch.cos(2 * z + 3 * x), torch.sin(4 * x + 2)], 1)


def _assert_supersampled(renderer: Renderer, field: Callable[[Tensor], Tensor]) -> None:
    _need(renderer.capabilities.differentiable_visibility, "visibility")
    vertices, faces = bumpy_sphere(5)
    size, camera, shading = 200, _cameras(1), Shading(normals="smooth")
    weight, direction = _weight(size), field(vertices)

    def total(moved: Tensor, finer: int) -> Tensor:
        image = _render(renderer, moved, faces, camera, shading, (size * finer,) * 2).image[..., 0]
        image = image.view(size, finer, size, finer).mean((1, 3))
        return (image * weight).double().sum()

    moved = vertices.clone().requires_grad_()
    value = total(moved, 1)
    _need(value.requires_grad, "visibility")
    (gradient,) = torch.autograd.grad(value, moved)
    step = 2e-3
    with torch.no_grad():
        change = total(vertices + step * direction, 8) - total(vertices - step * direction, 8)
    _assert_near(float((gradient * direction).sum()), float(change) / (2 * step), 0.1)


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
