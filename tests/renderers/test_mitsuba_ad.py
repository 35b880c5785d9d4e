"""Mitsuba as a backend: the conformance body, agreement with the default one, a missing LLVM."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import subprocess
from dataclasses import replace
from functools import cache

import pytest
import torch
from torch import Tensor

from styleexp.method.views import orbit
from styleexp.renderers import llvm
from styleexp.renderers.base import RenderOutput, Shading
from styleexp.renderers.mitsuba_ad import MitsubaAD
from styleexp.renderers.soft_raster import SoftRaster
from styleexp.system.errors import UserError
from styleexp.testing import NotApplicable, rendering
from styleexp.testing import renderers as testing
from tests.helpers import warm

for package in ("mitsuba", "drjit"):
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"needs the package {package}: extra 'mitsuba'", allow_module_level=True)

TIES = {
    "watertight_on_pixel_centres",
    "rectangle_through_pixel_centres",
    "equal_depth_goes_to_lowest_index",
}


class Hard(MitsubaAD):
    """Without outlines in any picture, declared as such."""

    capabilities = replace(MitsubaAD.capabilities, differentiable_visibility=False)

    def render(self, vertices, faces, cameras, shading, resolution):  # type: ignore[no-untyped-def]
        hard = replace(shading, outlines=False)
        return super().render(vertices, faces, cameras, hard, resolution)


@cache
def made(kind: type[MitsubaAD]) -> MitsubaAD:
    return kind()


@pytest.mark.parametrize("kind", [MitsubaAD, Hard], ids=["outlines", "hard"])
@pytest.mark.parametrize("check", testing.CHECKS, ids=lambda check: check.__name__)
def test_conformance(kind: type[MitsubaAD], check: testing.Check) -> None:
    try:
        check(made(kind))
    except NotApplicable as reason:
        assert kind is Hard or check.__name__ in TIES
        pytest.skip(str(reason))


@pytest.mark.parametrize("name", ["spot", "armadillo"])
@pytest.mark.parametrize("normals", ["smooth", "flat"])
@pytest.mark.parametrize("outlines", [True, False], ids=["outlines", "hard"])
def test_agrees_with_soft_raster(named_mesh, name: str, normals: str, outlines: bool) -> None:
    """The same pictures, and gradients that mean the same to broad deformations.

    The soft pictures differ where soft_raster looks at pixel centres and Mitsuba averages: faces
    smaller than a pixel, if they are flat, and outlines. The hard ones are equal.
    """
    from styleexp.inputs.meshes import load_mesh
    from styleexp.method.surface import normalised

    surface = normalised(load_mesh(named_mesh(name)), torch.device("cpu"))[1]
    cameras = orbit(torch.tensor([0.1, -0.4]), torch.tensor([0.4, 2.5]), 2.0, 60.0)
    shading = Shading(normals=normals, outlines=outlines)
    weight = rendering.pixel_weights(200)[:, :, None]

    def draw(renderer: MitsubaAD | SoftRaster) -> tuple[RenderOutput, Tensor]:
        moved = surface.vertices.clone().requires_grad_()
        out = renderer.render(moved, surface.faces, cameras, shading, (200, 200))
        return out, torch.autograd.grad((out.image * weight).sum(), moved)[0]

    (found, gradient), (expected, expected_gradient) = draw(made(MitsubaAD)), draw(SoftRaster())
    covered, expected_covered = found.coverage > 0.5, expected.coverage > 0.5
    either = covered | expected_covered
    assert float((covered & expected_covered).sum() / either.sum()) >= (0.99 if outlines else 0.999)
    difference = (found.image - expected.image)[..., 0].abs()[either].mean()
    assert difference <= (0.02 if outlines else 1e-4)
    same = found.face_ids == expected.face_ids
    assert same.float().mean() > 0.999
    seen = same & (found.face_ids >= 0)
    assert torch.allclose(found.depth[seen], expected.depth[seen], atol=1e-4)
    assert torch.equal(found.depth.isinf(), found.face_ids < 0)

    parts = torch.stack(
        [(_broad(surface.vertices) * g).sum((1, 2)) for g in (gradient, expected_gradient)]
    )
    cosine = torch.nn.functional.cosine_similarity(*parts, dim=0)
    assert cosine >= (0.98 if outlines else 0.9999)
    assert abs(float(parts[0].norm() / parts[1].norm()) - 1) <= (0.1 if outlines else 1e-3)


def _broad(vertices: Tensor) -> Tensor:
    """Vector fields on the vertices (fields, V, 3) that change little over the mesh."""
    x, y, z = vertices.unbind(1)
    waves = [
        torch.sin(k * x + a) * torch.cos(k * (y + 0.5 * z) + b)
        for k in (1, 2, 3)
        for a in (0, 1.6)
        for b in (0, 1.6)
    ]
    return torch.stack([wave[:, None] * axis for wave in waves for axis in torch.eye(3)])


def test_seed_decides_the_samples() -> None:
    vertices, faces = rendering.bumpy_sphere(3)
    arguments = (vertices, faces, rendering.cameras_around(1), Shading(), (40, 40))
    first, again = (made(MitsubaAD).render(*arguments).image for _ in range(2))
    assert torch.equal(first, again)
    other = MitsubaAD(seed=7).render(*arguments).image
    assert not torch.equal(first, other)
    assert (first - other).abs().mean() < 0.01


def test_any_number_of_samples() -> None:
    """Numbers that can't be spread evenly are rounded up; few samples give the same on average."""
    vertices, faces = rendering.bumpy_sphere(3)
    arguments = (faces, rendering.cameras_around(2), Shading(normals="smooth"), (30, 40))
    results = []
    for renderer in (made(MitsubaAD), MitsubaAD(spp=5, sppc=3), MitsubaAD(1, 1, 1)):
        moved = vertices.clone().requires_grad_()
        image = renderer.render(moved, *arguments).image
        (gradient,) = torch.autograd.grad(image.sum(), moved)
        results.append((image.detach(), (gradient * vertices).sum()))
    for image, growth in results[1:]:
        assert (image - results[0][0]).abs().mean() < 0.03
        assert abs(growth / results[0][1] - 1) < 0.2


def test_precision_follows_the_vertices() -> None:
    vertices, faces = rendering.bumpy_sphere(2)
    arguments = (faces, rendering.cameras_around(2), Shading(), (20, 30))
    single = made(MitsubaAD).render(vertices, *arguments)
    moved = vertices.double().requires_grad_()
    double = made(MitsubaAD).render(moved, *arguments)
    assert double.image.dtype == double.coverage.dtype == double.depth.dtype == torch.float64
    assert torch.allclose(double.image.float(), single.image)
    (gradient,) = torch.autograd.grad(double.image.sum(), moved)
    assert gradient.dtype == torch.float64
    assert not single.image.requires_grad


def test_renders_of_one_graph_keep_their_meshes() -> None:
    """Gradients are those of the mesh that was drawn, whatever was drawn since."""
    vertices, faces = rendering.bumpy_sphere(3)
    shading = Shading(normals="smooth")

    def total(moved: Tensor) -> Tensor:
        drawn = made(MitsubaAD).render(moved, faces, rendering.cameras_around(2), shading, (40, 40))
        image = drawn.image
        return (image * rendering.pixel_weights(40)[:, :, None]).sum()

    points = [(scale * vertices).requires_grad_() for scale in (1.0, 0.7)]
    apart = [torch.autograd.grad(total(moved), moved)[0] for moved in points]
    together = torch.autograd.grad(total(points[0]) + total(points[1]), points)
    for one, other in zip(apart, together, strict=True):
        assert torch.allclose(one, other, atol=1e-3 * float(one.abs().max()))


def test_mistakes_are_user_errors() -> None:
    vertices, faces = rendering.icosphere(0)
    render = made(MitsubaAD).render
    for options in ({"spp": 0}, {"sppc": 0}, {"sppp": -1}, {"seed": -1}):
        with pytest.raises(UserError, match=next(iter(options))):
            MitsubaAD(**options)
    with pytest.raises(UserError, match="smooth"):
        render(vertices, faces, rendering.front_camera(), Shading(normals="smoth"), (4, 4))
    with pytest.raises(UserError, match="device=cpu"):
        render(vertices.to("meta"), faces, rendering.front_camera(), Shading(), (4, 4))


def _command(folder, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    smoke = [
        "source=torus",
        "style=bubble",
        "method=robust",
        "profile=smoke",
        "encoder=vgg19_random",
    ]
    environment = warm.coarse(**environment)
    return warm.run(
        "-m", "styleexp", "renderer=mitsuba_ad", *smoke, *arguments, cwd=folder, env=environment
    )


@pytest.mark.parametrize("outlines", ["true", "false"])
def test_command(tmp_path, outlines: str) -> None:
    done = _command(tmp_path, f"shading.outlines={outlines}", "renderer.spp=4", "hydra.run.dir=run")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "run" / "result.glb").exists()


def test_llvm_that_is_no_llvm_is_one_sentence(tmp_path) -> None:
    """A file that is none, named in the environment: refused, and not replaced by another."""
    wrong = tmp_path / "libLLVM.so"
    wrong.write_text("no library")
    for path in (wrong, tmp_path / "missing.so"):
        done = _command(tmp_path, **{llvm.PATH: str(path)})
        assert done.returncode == 2, done.stderr
        assert "Traceback" not in done.stderr
        lines = [x for x in done.stderr.splitlines() if x.strip() and not x.startswith("warning:")]
        assert len(lines) == 1, done.stderr
        assert str(path) in lines[0]
        assert "pip install mitsuba" in lines[0]


def test_llvm_that_aborts_is_a_user_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(llvm, "_TRIAL", "import os; os.abort()")
    monkeypatch.delenv(llvm.PATH, raising=False)
    with pytest.raises(UserError, match=f"signal 6.*{llvm.PATH}"):
        llvm.prepare.__wrapped__()
    monkeypatch.setenv(llvm.PATH, "somewhere")
    with pytest.raises(UserError, match=f"'somewhere'.*unset {llvm.PATH}"):
        llvm.prepare.__wrapped__()


def test_missing_package_is_a_user_error(monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "mitsuba" else find(name)
    )
    with pytest.raises(UserError, match=r"'mitsuba'.*pip install mitsuba"):
        llvm.prepare.__wrapped__()


def test_without_the_wheel_the_system_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "files", missing)
    assert llvm.from_wheel() is None
