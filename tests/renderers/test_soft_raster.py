"""The default renderer: the conformance body, and what only this backend promises."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from styleexp.method.views import look_at
from styleexp.renderers.base import Shading
from styleexp.renderers.soft_raster import SoftRaster
from styleexp.renderers.soft_raster.composing import Compose
from styleexp.renderers.soft_raster.contour import (
    CrossingDistance,
    Crossings,
    neighbours,
)
from styleexp.renderers.soft_raster.geometry import (
    FaceNormals,
    Project,
    SumAtVertices,
    unit,
)
from styleexp.renderers.soft_raster.raster import Visible
from styleexp.renderers.soft_raster.shading import (
    LightPixels,
    NormalMatrices,
    PickOne,
    faces_seen,
)
from styleexp.system.errors import UserError
from styleexp.testing import NotApplicable, rendering
from styleexp.testing import renderers as testing


class HardRaster(SoftRaster):
    """The variant without visibility gradients, declared as such."""

    capabilities = replace(SoftRaster.capabilities, differentiable_visibility=False)

    def __init__(self) -> None:
        super().__init__("none")


@pytest.mark.parametrize("renderer", [SoftRaster(), HardRaster()], ids=["contour", "none"])
@pytest.mark.parametrize("check", testing.CHECKS, ids=lambda check: check.__name__)
def test_conformance(renderer: SoftRaster, check: testing.Check) -> None:
    try:
        check(renderer)
    except NotApplicable as reason:
        pytest.skip(str(reason))


def test_check_renderer_reports_all_failures(monkeypatch: pytest.MonkeyPatch) -> None:
    class Upside(SoftRaster):
        def render(self, *arguments):  # type: ignore[no-untyped-def]
            out = super().render(*arguments)
            return replace(out, image=out.image.flip(1), face_ids=out.face_ids.flip(1))

    some = (testing.orientation, testing.crop_is_part_of_whole, testing.triangle_area)
    monkeypatch.setattr(testing, "CHECKS", some)
    monkeypatch.setattr(testing, "devices", lambda renderer: ["cpu"])
    with pytest.raises(AssertionError, match="2 of 3 checks failed") as failure:
        testing.check_renderer(Upside())
    assert "orientation" in str(failure.value)
    assert "crop_is_part_of_whole" in str(failure.value)
    assert testing.check_renderer(HardRaster()) == {
        "orientation": "passed",
        "crop_is_part_of_whole": "passed",
        "triangle_area": "not applicable: is not differentiable w.r.t. visibility",
    }


def test_unknown_names_are_user_errors() -> None:
    with pytest.raises(UserError, match="contour"):
        SoftRaster("countour")
    vertices, faces = rendering.icosphere(0)
    with pytest.raises(UserError, match="smooth"):
        SoftRaster().render(
            vertices, faces, rendering.front_camera(), Shading(normals="smoth"), (4, 4)
        )


def _random(*shape: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(*shape, generator=generator, dtype=torch.float64)


def test_gradcheck_project() -> None:
    vertices = _random(5, 3).requires_grad_()
    assert gradcheck(Project.apply, (vertices, _random(3, 2, 4, seed=1)))


def test_gradcheck_normals() -> None:
    corners = torch.tensor([[0, 1, 2], [1, 2, 3], [2, 4, 4]])
    vertices = _random(5, 3).requires_grad_()
    assert gradcheck(FaceNormals.apply, (vertices, corners))
    assert gradcheck(lambda v: unit(FaceNormals.apply(v, corners)), (vertices,))
    values = _random(3, 3, seed=1).requires_grad_()
    assert gradcheck(lambda v: SumAtVertices.apply(v, corners, 5), (values,))


def test_gradcheck_pick_one() -> None:
    values = _random(2, 4).requires_grad_()
    assert gradcheck(PickOne.apply, (values, torch.tensor([3, 3, 0, 7])))


def test_gradcheck_smooth_light() -> None:
    points = (_random(3, 2, 5) + torch.tensor([0, 0, 1.0])[:, None, None]).requires_grad_()
    normals = (_random(3, 5, seed=1) + 0.2).requires_grad_()
    corners = torch.tensor([[0, 1, 2, 0], [1, 2, 3, 4], [2, 4, 0, 3]])
    lights = 0.3 * _random(2, 2, 3, seed=3)
    pixel, view, face = torch.tensor([[1, 5, 4, 0], [0, 1, 1, 0], [0, 1, 2, 3]])
    nothing = torch.zeros(2, 2, 2)  # two views of 2 by 2 pixels
    visible = Visible(nothing, nothing, pixel, view, face)

    def intensity(points: Tensor, normals: Tensor) -> Tensor:
        seen = faces_seen(points, corners, visible)
        matrices = NormalMatrices.apply(points, normals, seen)
        return LightPixels.apply(matrices, seen, visible, lights, 0.4, 0.9)

    assert ((intensity(points, normals) > 0) & (intensity(points, normals) < 1)).all()
    assert gradcheck(intensity, (points, normals))


def test_gradcheck_crossing_distance() -> None:
    # Edges through the middle of rows and columns; the last reaches behind the camera.
    x = torch.tensor([0.4, 0.8, 1.1, 0.2, 0.7, 0.9], dtype=torch.float64)
    y = torch.tensor([0.1, 1.2, 0.8, 0.7, 0.2, 3.0], dtype=torch.float64)
    w = torch.tensor([1.0, 1.3, 0.8, 1.6, 1.1, -0.5], dtype=torch.float64)
    points = torch.stack([x * w, y * w, w]).view(3, 2, 3).requires_grad_()
    index = torch.zeros(4, dtype=torch.long)
    crossings = Crossings(
        inner=index,
        outer=index + 1,
        start=torch.tensor([0, 2, 1, 4]),
        end=torch.tensor([1, 3, 0, 5]),
        center=torch.tensor([[0.2, 0.6, 1.2, 0.2], [0.6, 0.3, 0.5, 0.4]], dtype=torch.float64),
        along_row=torch.tensor([True, False, True, True]),
        direction=torch.tensor([1.0, 1.0, -1.0, 1.0], dtype=torch.float64),
        view=torch.tensor([0, 0, 0, 1]),
        face=index,
    )
    distance = CrossingDistance.apply(points, crossings)
    assert ((distance > 0) & (distance < 1)).all(), distance
    assert gradcheck(lambda p: CrossingDistance.apply(p, crossings), (points,))


def test_gradcheck_compose() -> None:
    face_ids = torch.tensor([[[0, -1, 1], [2, 3, -1], [-1, 4, 5]]])
    pixel = (face_ids.view(-1) >= 0).nonzero().view(-1)
    visible = Visible(face_ids, face_ids, pixel, 0 * pixel, 0 * pixel)
    intensities = _random(2, 6).requires_grad_()
    # Pixel 4 is taken from all sides, more than once over.
    distance = torch.tensor([0.1, 0.15, 0.2, 0.05, 0.9], dtype=torch.float64, requires_grad=True)
    inner, outer = torch.tensor([4, 4, 4, 4, 0]), torch.tensor([1, 3, 5, 7, 1])

    def compose(intensities: Tensor, distance: Tensor) -> tuple[Tensor, Tensor]:
        # The outline's as on its inside: the gradient is then the forward's own.
        outline = intensities[:, [3, 3, 3, 3, 0]].detach()
        return Compose.apply(intensities, visible, 0.3, distance, outline, inner, outer)

    assert gradcheck(compose, (intensities, distance))
    image, coverage = compose(intensities, distance)
    assert (image.amax(1) <= intensities.amax(1).clamp_min(0.3)).all()
    assert (image.amin(1) >= intensities.amin(1).clamp_max(0.3)).all()
    assert (coverage >= 0).all()
    assert (coverage <= 1).all()
    assert gradcheck(
        lambda i: Compose.apply(i, visible, 0.3, None, None, None, None)[0], (intensities,)
    )


@pytest.mark.parametrize("normals", ["flat", "smooth"])
def test_gradcheck_of_shading_through_the_renderer(normals: str) -> None:
    """Hard visibility does not change under tiny steps, so the whole render is checked."""
    vertices, faces = rendering.bumpy_sphere(1)
    camera = rendering.cameras_around(2)
    assert gradcheck(
        lambda v: (
            SoftRaster("none").render(v, faces, camera, Shading(normals=normals), (9, 9)).image
        ),
        (vertices.double().requires_grad_(),),
    )


def test_double_precision_agrees_with_single() -> None:
    vertices, faces = rendering.bumpy_sphere(3)
    arguments = (faces, rendering.cameras_around(2), Shading(normals="smooth"), (64, 64))
    single = SoftRaster().render(vertices, *arguments)
    double = SoftRaster().render(vertices.double(), *arguments)
    assert double.image.dtype == double.coverage.dtype == torch.float64
    assert ((double.image - single.image).abs() > 1e-3).double().mean() < 1e-3


@pytest.mark.parametrize("normals", ["flat", "smooth"])
def test_same_input_same_bits(normals: str) -> None:
    vertices, faces = rendering.bumpy_sphere(4)

    def run() -> tuple[Tensor, Tensor]:
        moved = vertices.clone().requires_grad_()
        out = SoftRaster().render(
            moved, faces, rendering.cameras_around(3), Shading(normals=normals), (100, 100)
        )
        (gradient,) = torch.autograd.grad((out.image**2).sum() + out.coverage.sum(), moved)
        return out.image.detach(), gradient

    first, second = run(), run()
    assert torch.equal(first[0], second[0])
    assert torch.equal(first[1], second[1])


def test_the_same_pixels_in_any_portions() -> None:
    """How much the rasteriser works on at once changes nothing."""
    from styleexp.renderers.soft_raster import culling, shading

    vertices, faces = rendering.bumpy_sphere(2)
    arguments = (vertices, faces, rendering.cameras_around(2), Shading(normals="smooth"), (90, 70))
    whole = SoftRaster().render(*arguments)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(culling, "CHUNK", 500)
        patch.setattr(shading, "_AT_ONCE", 77)
        chunked = SoftRaster().render(*arguments)
    for name in ("face_ids", "depth", "image", "coverage"):
        assert torch.equal(getattr(whole, name), getattr(chunked, name)), name


def test_outlines_are_antialiased_and_hard_without() -> None:
    vertices, faces = rendering.icosphere(4)
    arguments = (vertices, faces, rendering.cameras_around(1), Shading(), (64, 64))
    soft, hard = SoftRaster().render(*arguments), SoftRaster("none").render(*arguments)
    assert set(hard.coverage.unique().tolist()) == {0.0, 1.0}
    between = (soft.coverage > 0.01) & (soft.coverage < 0.99)
    assert 60 < between.sum() < 300
    assert torch.equal(soft.face_ids, hard.face_ids)


def test_topology_follows_the_faces() -> None:
    """The remembered neighbours are those of the faces given, also if changed in place."""
    vertices, faces = rendering.bumpy_sphere(2)
    renderer, arguments = SoftRaster(), (rendering.cameras_around(1), Shading(), (40, 40))
    renderer.render(vertices, faces, *arguments)
    faces[: len(faces) // 2] = faces[0].clone()
    again = renderer.render(vertices, faces, *arguments)
    assert torch.equal(again.image, SoftRaster().render(vertices, faces, *arguments).image)


def test_neighbours_of_a_strip() -> None:
    faces = torch.tensor([[0, 1, 2], [2, 1, 3], [2, 3, 4]])
    none = 3
    expected = [[none, 0, 1], [1, none, none], [none, 2, none]]
    assert neighbours(faces, 5).tolist() == expected


def test_faces_too_small_for_float32_pass_no_gradient():
    """Found by the random renders: 1 / length^3 of their normals is infinite."""
    vertices = 1e-7 * torch.tensor([[1.5, -0.3, -2.2], [0.6, -1.1, -1.4], [0.4, 0.8, -0.7]])
    vertices.requires_grad_()
    cameras = look_at(torch.tensor([[0.0, 0.0, 0.01]]), torch.zeros(1, 3), 0.1)
    for normals in ("flat", "smooth"):
        out = SoftRaster().render(
            vertices, torch.tensor([[1, 2, 0]]), cameras, Shading(normals=normals), (8, 8)
        )
        (gradient,) = torch.autograd.grad(out.image.square().sum(), vertices)
        assert torch.isfinite(gradient).all()
