"""Checks of renderers: which face is seen where, and how deep."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import torch

from styleexp.renderers.base import Renderer, Shading
from styleexp.testing.checks import NotApplicable
from styleexp.testing.rendering import (
    EVEN,
    assert_covered_once,
    bent_grid,
    bumpy_sphere,
    cameras_around,
    face_ids,
    front_camera,
    need_ties,
    one_triangle,
    pixel_weights,
    rendered,
)

if TYPE_CHECKING:
    pass


Check = Callable[[Renderer], None]


def watertight(renderer: Renderer) -> None:
    """Rendered one at a time, the faces of a jittered grid cover each pixel inside exactly once."""
    for seed in range(3):
        vertices, faces = bent_grid(5, seed)
        assert_covered_once(renderer, vertices, faces)


def watertight_on_pixel_centres(renderer: Renderer) -> None:
    """`watertight`, with all vertices snapped to pixel centres and corners."""
    need_ties(renderer)
    for seed in range(3):
        vertices, faces = bent_grid(5, seed)
        vertices[:, :2] = (vertices[:, :2] * 32).round() / 32  # half pixels of a 32 x 32 image
        assert_covered_once(renderer, vertices, faces)


def rectangle_through_pixel_centres(renderer: Renderer) -> None:
    """Edges through pixel centres own exactly half of them; with reversed winding it is culled."""
    need_ties(renderer)
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
            out = rendered(renderer, vertices, face, front_camera(from_behind), EVEN, (32, 32))
            assert int((face_ids(out) >= 0).sum()) == count, (faces, from_behind, count)


def nearer_face_wins(renderer: Renderer) -> None:
    """The nearer of two overlapping faces is visible, regardless of their order."""
    near, far = one_triangle(z=0.5), one_triangle(z=-0.5)
    for first, second, winner in ((near, far, 0), (far, near, 1)):
        vertices = torch.cat([first, second])
        out = rendered(renderer, vertices, torch.arange(6).view(2, 3), front_camera())
        assert int(face_ids(out)[0, 16, 16]) == winner
        inside = face_ids(out)[0][10:20, 14:18]
        assert (inside == winner).all()


def equal_depth_goes_to_lowest_index(renderer: Renderer) -> None:
    """Of coincident faces, the first is visible."""
    need_ties(renderer)
    faces = torch.tensor([[0, 1, 2]]).repeat(5, 1)
    ids = face_ids(rendered(renderer, one_triangle(), faces, front_camera()))
    assert ids.max() == 0
    assert (ids == 0).sum() > 50


def orientation(renderer: Renderer) -> None:
    """An asymmetric image is neither flipped nor mirrored: rows go down, columns right."""
    # A right angle at the top left, and one pixel at the bottom right.
    big = [(1, 1), (1, 5), (7, 1)]
    dot = [(6, 6), (6, 8), (8, 6)]
    vertices = torch.tensor([[x / 4 - 1, 1 - y / 4, 0.0] for x, y in big + dot])
    ids = face_ids(
        rendered(
            renderer, vertices, torch.tensor([[0, 1, 2], [3, 4, 5]]), front_camera(), size=(8, 8)
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
    camera = cameras_around(1, focal=2.0)
    whole = rendered(renderer, vertices, faces, camera, size=(128, 128))
    top, left, height, width = 24, 40, 32, 48
    zoom = torch.tensor([[128 / width, 128 / height]])
    middle = torch.tensor([[(left + width / 2) / 64 - 1, 1 - (top + height / 2) / 64]])
    crop = replace(camera, focal=camera.focal * zoom, center=(camera.center - middle) * zoom)
    part = rendered(renderer, vertices, faces, crop, size=(height, width))
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
    alone = rendered(renderer, wall, wall_faces, front_camera(), light)
    out = rendered(renderer, vertices, torch.cat([wall_faces, faces + 4]), front_camera(), light)
    assert torch.allclose(out.image, alone.image, atol=1e-4)
    if renderer.capabilities.differentiable_shading:
        weight = pixel_weights(32)[:, :, None]
        (gradient,) = torch.autograd.grad((out.image * weight).sum(), vertices)
        assert gradient[4:].abs().max() < 1e-4 * gradient[:4].abs().max()


def larger_than_the_frame(renderer: Renderer) -> None:
    """Faces much larger than the image fill it, at any zoom."""
    vertices, faces = bent_grid(1, 0)
    for zoom in (3.0, 30.0, 3000.0):
        camera = replace(front_camera(), focal=torch.full((1, 2), 2 * zoom))
        out = rendered(renderer, vertices, faces, camera, EVEN, (70, 90))
        assert (out.coverage == 1).all(), zoom
        assert torch.allclose(out.image, torch.tensor(0.25)), zoom


def crossing_the_near_plane(renderer: Renderer) -> None:
    """Faces that extend behind the camera look like faces clipped at the near plane."""
    camera = replace(front_camera(), near=0.25)  # at z = 2, looking along -z
    edge = 2 - camera.near
    floor = torch.tensor([[-4.0, -1, 5], [4, -1, 5], [4, -1, -3], [-4, -1, -3]])
    cut = floor.clone()
    cut[:2, 2] = edge
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    # Vary the diagonal, so that one or two corners of a face are behind the camera.
    for turn in range(4):
        ahead = floor.roll(turn, 0)
        out = rendered(renderer, ahead, faces, camera)
        expected = rendered(renderer, cut, faces, camera)
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
        out = rendered(renderer, spike, torch.tensor([winding]), camera)
        expected = rendered(renderer, part, torch.tensor([winding]), camera)
        assert ((out.coverage > 0.5) != (expected.coverage > 0.5)).sum() <= 1
        assert torch.allclose(out.image, expected.image, atol=0.02)


def depth_on_receding_quad(renderer: Renderer) -> None:
    """Ray times depth lies on the plane of a quad that recedes from the camera."""
    vertices = torch.tensor([[-1.0, -1, 1], [1, -1, 1], [1, 1, -6], [-1, 1, -6]])
    out = rendered(renderer, vertices, torch.tensor([[0, 1, 2], [0, 2, 3]]), front_camera())
    if out.depth is None:
        raise NotApplicable("returns no depth")
    rows, columns = torch.nonzero(out.depth[0].isfinite(), as_tuple=True)
    assert rows.numel() > 50
    w = out.depth[0][rows, columns]
    x, y = ((columns + 0.5) / 16 - 1) / 2 * w, (1 - (rows + 0.5) / 16) / 2 * w
    z = 2 - w
    assert torch.allclose(z, 1 - (y + 1) * 3.5, atol=2e-4)
    assert (x.abs() < 1 + 1e-4).all()
