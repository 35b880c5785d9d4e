"""Renderers on a CUDA device: the conformance body, and the CPU's pictures."""

import pytest
import torch

from styleexp.method.pictures import resized
from styleexp.renderers.base import Shading
from styleexp.renderers.moderngl_deferred import ModernGLDeferred
from styleexp.renderers.soft_raster import SoftRaster, boxes, contour
from styleexp.renderers.soft_raster.culling import FacePairs
from styleexp.testing import NotApplicable, rendering
from styleexp.testing import renderers as testing
from tests.helpers.needed import available

pytestmark = pytest.mark.usefixtures("gpu")


SLOW = (testing.gradient_of_scale, testing.gradient_of_smooth_field)
"""Of a fine render, which takes long; gradients are compared with the CPU's below."""
MANY = (testing.watertight, testing.watertight_on_pixel_centres)
"""Of hundreds of renders, each slow when simulated."""


@pytest.mark.parametrize(
    "check", [c for c in testing.CHECKS if c not in SLOW + MANY], ids=lambda check: check.__name__
)
def test_conformance(check):
    assert rendering.devices(SoftRaster()) == ["cpu", "cuda"]
    with rendering.on("cuda"):
        try:
            check(SoftRaster())
        except NotApplicable as reason:
            pytest.skip(str(reason))


class Boxes(SoftRaster):
    """The GPU's rasteriser, on the CPU."""

    def find_visible(self, projected):
        pairs = projected.pairs
        crossing = torch.zeros_like(pairs.chosen) if pairs.crossing is None else pairs.crossing
        given = projected.points, projected.corners, FacePairs(pairs.chosen, crossing)
        return boxes.rasterise(*given, projected.near, projected.resolution)


@pytest.mark.parametrize("check", MANY, ids=lambda check: check.__name__)
def test_the_gpus_rasteriser_is_watertight(check):
    check(Boxes())


def test_check_renderer_covers_the_device(monkeypatch):
    monkeypatch.setattr(testing, "CHECKS", (testing.orientation, testing.odd_sizes))
    found = testing.check_renderer(SoftRaster())
    assert list(found) == ["orientation", "odd_sizes", "orientation (cuda)", "odd_sizes (cuda)"]

    class Flipped(SoftRaster):
        def find_visible(self, projected):
            found = super().find_visible(projected)
            return found if projected.points.device.type == "cpu" else None

    with pytest.raises(AssertionError, match="orientation \\(cuda\\)") as failure:
        testing.check_renderer(Flipped())
    assert "2 of 4 checks failed" in str(failure.value)


def seen(device, normals="smooth", outlines=True, distance=1.0, level=3, renderer=None):
    """Outputs of a render, and the gradient."""
    renderer = renderer or SoftRaster()
    vertices, faces = rendering.bumpy_sphere(level)
    moved = vertices.to(device).requires_grad_()
    cameras = rendering.cameras_around(3, focal=2.2 * distance)
    lights = torch.tensor([[0.5, 0.2, 0.4], [0.0, -0.4, 0.6]])[:, None].expand(2, 3, 3)
    shading = Shading(normals=normals, outlines=outlines, light=lights)
    out = renderer.render(moved, faces.to(device), cameras, shading, (100, 80))
    weights = torch.linspace(0, 1, out.image.shape[1]).to(device)[:, None, None]
    total = (out.image.square() * weights).sum()
    total = total + out.coverage.sum() if outlines else total
    (gradient,) = torch.autograd.grad(total, moved)
    found = (out.image, out.coverage, out.face_ids, out.depth, gradient)
    return [each.detach().cpu() for each in found]


@pytest.mark.parametrize("normals", ["flat", "smooth"])
@pytest.mark.parametrize("outlines", [False, True])
@pytest.mark.parametrize("level", [0, 3])
def test_pictures_and_gradients_are_those_of_the_cpu(normals, outlines, level):
    given = (normals, outlines, 1.0, level)
    expected, found = seen("cpu", *given), seen("cuda", *given)
    assert (expected[2] != found[2]).float().mean() < 1e-4
    for one, other in zip(expected[:2], found[:2], strict=True):
        assert ((one - other).abs() > 1e-3).float().mean() < 1e-3
    assert (expected[4] - found[4]).norm() < 0.01 * expected[4].norm()


def test_opengl_finds_what_it_finds_for_the_cpu():
    renderer = available(ModernGLDeferred)
    expected, found = (seen(device, renderer=renderer) for device in ("cpu", "cuda"))
    assert (expected[2] != found[2]).float().mean() < 1e-4
    assert ((expected[0] - found[0]).abs() > 1e-3).float().mean() < 1e-3
    assert (expected[4] - found[4]).norm() < 0.01 * expected[4].norm()


def test_portions_change_nothing(monkeypatch):
    whole = seen("cuda", distance=0.4)
    monkeypatch.setattr(boxes, "AT_ONCE", 300)
    monkeypatch.setattr(contour, "MOST_CROSSINGS", 40)
    for one, other in zip(whole[:4], seen("cuda", distance=0.4)[:4], strict=True):
        assert torch.equal(one, other)


def test_faces_across_the_near_plane_are_cut():
    """A floor that passes under the camera."""
    vertices = torch.tensor([[-5.0, -0.5, -5], [5, -0.5, -5], [5, -0.5, 5], [-5, -0.5, 5]])
    faces = torch.tensor([[0, 2, 1], [0, 3, 2]])
    camera = rendering.front_camera()
    one, other = (
        SoftRaster().render(vertices.to(d), faces.to(d), camera, Shading(), (40, 40))
        for d in ("cpu", "cuda")
    )
    assert (one.face_ids >= 0).sum() > 300
    assert (one.face_ids != other.face_ids.cpu()).sum() == 0


def test_the_host_waits_as_often_for_many_views_and_never_backward(gpu):
    if gpu is None:
        pytest.skip("counted on the simulated device")
    waits = []
    for count in (1, 8):
        vertices, faces = rendering.bumpy_sphere(3)
        moved = vertices.cuda().requires_grad_()
        faces = faces.cuda()
        gpu.reset()
        cameras = rendering.cameras_around(count)
        out = SoftRaster().render(moved, faces, cameras, Shading(normals="smooth"), (64, 64))
        (out.image.square().sum() + out.coverage.sum()).backward()
        assert not any(wait.backward for wait in gpu.waits)
        waits.append(len(gpu.waits))
    assert waits[0] == waits[1]


def test_a_picture_shrinks_by_steps_to_what_it_shrinks_to_at_once():
    picture = torch.rand(2000, 1500, generator=torch.Generator().manual_seed(0))
    one, other = resized(picture, 11), resized(picture.cuda(), 11).cpu()
    assert one.shape == other.shape
    assert (one - other).abs().max() < 0.02
