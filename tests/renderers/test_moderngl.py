"""moderngl_deferred: the conformance body, agreement with soft_raster, and what may go wrong."""

from __future__ import annotations

import multiprocessing
import subprocess
import sys
import threading

import pytest
import torch
from torch import Tensor

import styleexp
from styleexp.inputs import meshes, shapes
from styleexp.method.views import orbit, zoom
from styleexp.renderers import moderngl_deferred
from styleexp.renderers.base import Cameras, RenderOutput, Shading
from styleexp.renderers.moderngl_deferred import ModernGLDeferred
from styleexp.renderers.soft_raster import SoftRaster
from styleexp.system.errors import UserError
from styleexp.testing import renderers as testing
from styleexp.testing import rendering
from tests.helpers import warm
from tests.helpers.needed import available

SMOKE = ["source=torus", "style=bubble", "method=robust", "profile=smoke", "encoder=vgg19_random"]


@pytest.fixture(scope="module")
def renderer():
    return available(ModernGLDeferred)


@pytest.mark.parametrize("check", testing.CHECKS, ids=lambda check: check.__name__)
def test_conformance(renderer, check):
    check(renderer)


# Agreement with soft_raster


def around() -> Cameras:
    """Views from all sides, with off-centre optical axes and a focal length for each."""
    cameras = orbit(
        torch.tensor([0.3, -0.2, 0.6, 0.1]), torch.tensor([0.2, 1.5, 2.9, 5.4]), 2.0, 60.0
    )
    stretch = torch.tensor([[1.0, 1.0], [1.2, 0.9], [0.8, 0.8], [1.5, 1.5]])
    center = torch.tensor([[0.0, 0.0], [0.1, -0.2], [-0.3, 0.2], [0.0, 0.3]])
    return Cameras(
        cameras.rotation, cameras.translation, cameras.focal * stretch, cameras.center + center
    )


def rendered(
    renderer, vertices: Tensor, faces: Tensor, cameras: Cameras, normals: str
) -> tuple[RenderOutput, Tensor]:
    """A render, and the gradient of a weighted sum of its pixels."""
    moved = vertices.clone().requires_grad_()
    out = renderer.render(moved, faces, cameras, Shading(normals=normals), (160, 200))
    weight = torch.linspace(0.5, 1.5, 200)[:, None] + torch.linspace(0, 1, 160)[:, None, None]
    (gradient,) = torch.autograd.grad((out.image * weight).sum(), moved)
    return out, gradient


def assert_agrees(renderer, vertices: Tensor, faces: Tensor, cameras: Cameras, normals: str):
    ours, our_gradient = rendered(renderer, vertices, faces, cameras, normals)
    other, gradient = rendered(SoftRaster(), vertices, faces, cameras, normals)
    assert ours.face_ids.dtype == other.face_ids.dtype
    seen, other_seen = ours.face_ids >= 0, other.face_ids >= 0
    assert other_seen.float().mean() > 0.02
    iou = (seen & other_seen).sum() / (seen | other_seen).sum()
    assert iou >= 0.999
    assert (ours.image - other.image).abs().mean() <= 1e-3
    assert (ours.coverage - other.coverage).abs().mean() <= 1e-3
    same = ours.face_ids == other.face_ids
    assert same.float().mean() >= 0.998
    both = same & seen
    assert torch.allclose(ours.depth[both], other.depth[both], rtol=1e-4)
    assert ours.depth[~seen].isinf().all()
    cosine = torch.cosine_similarity(our_gradient.flatten(), gradient.flatten(), 0)
    assert cosine > 0.99


def normalised(mesh: meshes.Mesh) -> tuple[Tensor, Tensor]:
    vertices = meshes.normalisation(mesh.vertices).apply(mesh.vertices)
    return torch.from_numpy(vertices).float(), torch.from_numpy(mesh.faces)


@pytest.mark.parametrize("normals", ["flat", "smooth"])
@pytest.mark.parametrize("shape", ["critter", "torus", "buckyball"])
def test_agrees_with_soft_raster_on_analytic_shapes(renderer, shape, normals):
    assert_agrees(renderer, *normalised(shapes.make(shape)), around(), normals)


@pytest.mark.parametrize("name", ["spot", "armadillo", "fish"])
def test_agrees_with_soft_raster_on_named_meshes(renderer, named_mesh, name):
    mesh = styleexp.load_mesh(named_mesh(name))
    assert_agrees(renderer, *normalised(mesh), around(), "smooth")


def test_agrees_with_soft_raster_close_up(renderer):
    """The camera close to the surface, parts of the mesh beside and behind it."""
    vertices, faces = normalised(shapes.make("critter"))
    cameras = orbit(torch.tensor([0.2, 0.5]), torch.tensor([0.4, 3.0]), 0.75, 50.0)
    assert_agrees(renderer, vertices, faces, cameras, "smooth")


def test_hard_outlines(renderer):
    vertices, faces = rendering.icosphere(4)
    camera = zoom(orbit(torch.zeros(1), torch.zeros(1), 3.0, 40.0), 0.9)
    out = ModernGLDeferred("none").render(vertices, faces, camera, Shading(), (64, 64))
    assert set(out.coverage.unique().tolist()) == {0.0, 1.0}
    assert torch.equal(out.coverage > 0, out.face_ids >= 0)


def test_double_precision_and_other_sizes_in_turn(renderer):
    """Buffers are reused between calls: nothing of a larger image is left over in a smaller one."""
    vertices, faces = rendering.bumpy_sphere(3)
    small, small_faces = rendering.icosphere(1)
    for size in ((90, 70), (33, 70), (120, 50), (90, 70)):
        out = renderer.render(vertices.double(), faces, around(), Shading(), size)
        assert out.image.dtype == torch.float64
        expected = SoftRaster().render(vertices.double(), faces, around(), Shading(), size)
        assert ((out.image - expected.image).abs() > 1e-3).double().mean() < 2e-3
        few = renderer.render(small * 0.1, small_faces, around()[1:2], Shading(), size)
        assert 0 < (few.face_ids >= 0).sum() < few.face_ids.numel() / 10


def test_more_views_than_fit_into_one_image(renderer, monkeypatch):
    vertices, faces = rendering.bumpy_sphere(3)
    whole = renderer.render(vertices, faces, around(), Shading(), (60, 60))
    monkeypatch.setattr(moderngl_deferred._canvas(), "largest", 130)
    parts = renderer.render(vertices, faces, around(), Shading(), (60, 60))
    assert torch.equal(whole.face_ids, parts.face_ids)
    with pytest.raises(UserError, match="131"):
        renderer.render(vertices, faces, around(), Shading(), (131, 60))


def test_nearly_equal_depths_are_told_apart(renderer):
    """Two sheets 1e-5 apart, far from the near plane: the depth buffer resolves what it must."""
    sheet = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    vertices = torch.cat([sheet, sheet + torch.tensor([0, 0, 1e-5])])
    camera = orbit(torch.zeros(1), torch.zeros(1), 3.0, 40.0)
    ids = renderer.render(vertices, faces, camera, Shading(), (40, 40)).face_ids
    assert (ids[ids >= 0] >= 2).all()


# The context


def test_one_context_for_each_thread(renderer):
    vertices, faces = rendering.bumpy_sphere(2)
    arguments = (vertices, faces, around(), Shading(), (40, 40))
    expected = renderer.render(*arguments)
    here = moderngl_deferred._canvas()
    ModernGLDeferred()
    assert moderngl_deferred._canvas() is here
    found = []
    for _ in range(2):
        thread = threading.Thread(target=lambda: found.append(renderer.render(*arguments)))
        thread.start()
        thread.join(60)
        found.append(renderer.render(*arguments))
    assert all(torch.equal(out.face_ids, expected.face_ids) for out in found)
    assert len(found) == 4


def test_another_context_in_the_same_process_lives_on(renderer):
    import moderngl

    vertices, faces = rendering.bumpy_sphere(2)
    expected = renderer.render(vertices, faces, around(), Shading(), (40, 40))
    other = moderngl.create_context(standalone=True, backend="egl")
    image = other.simple_framebuffer((8, 8))
    out = renderer.render(vertices, faces, around(), Shading(), (40, 40))
    assert torch.equal(out.face_ids, expected.face_ids)
    with other:
        image.clear(1.0, 0.0, 0.0, 1.0)
        assert image.read()[:3] == b"\xff\0\0"
        image.release()
    other.release()
    out = renderer.render(vertices, faces, around(), Shading(), (40, 40))
    assert torch.equal(out.face_ids, expected.face_ids)


def _render_in_child(pipe):
    try:
        ModernGLDeferred()
        pipe.send("rendered")
    except UserError as error:
        pipe.send(str(error))


def test_a_forked_process_is_told(renderer):
    ours, theirs = multiprocessing.Pipe()
    process = multiprocessing.get_context("fork").Process(target=_render_in_child, args=(theirs,))
    process.start()
    assert ours.poll(60)
    assert "spawn" in ours.recv()
    process.join(60)


def test_a_lost_context_is_noticed(renderer):
    """pyrender ends EGL for the whole process: that must not go by unseen."""
    from styleexp.runs import previews

    available(lambda: previews.check_available("egl"))
    code = """
import os
os.environ["PYOPENGL_PLATFORM"] = "egl"
import torch
from styleexp.testing import rendering
from styleexp.system.errors import UserError
from styleexp.renderers.base import Shading
from styleexp.renderers.moderngl_deferred import ModernGLDeferred
renderer, (vertices, faces) = ModernGLDeferred(), rendering.icosphere(2)
def covered():
    out = renderer.render(vertices, faces, rendering.cameras_around(1), Shading(), (32, 32))
    return int((out.face_ids >= 0).sum())
before = covered()
import pyrender
other = pyrender.OffscreenRenderer(16, 16)
other.delete()
try:
    print("SAME" if covered() == before else "DIFFERENT")
except UserError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "SAME" in done.stdout or "separate process" in done.stdout


# What users meet


def command(*arguments, cwd, **environment):
    environment = warm.coarse(**environment)
    return warm.run(
        "-m", "styleexp", *arguments, *SMOKE, "hydra.run.dir=run", cwd=cwd, env=environment
    )


def complaint(done):
    assert done.returncode == 2, done.stderr
    lines = [x for x in done.stderr.splitlines() if x.strip() and not x.startswith("warning: ")]
    assert len(lines) == 1, done.stderr
    return lines[0]


def test_run_with_this_renderer(renderer, tmp_path):
    done = command("renderer=moderngl_deferred", "shading.outlines=true", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "run" / "result.glb").exists()


@pytest.mark.parametrize(
    "environment",
    [
        {"__EGL_VENDOR_LIBRARY_FILENAMES": "/nonexistent.json"},
        {"GLCONTEXT_LINUX_LIBEGL": "libNoEGL.so"},
    ],
    ids=["no driver", "no library"],
)
def test_without_egl_one_sentence_names_the_remedy(renderer, tmp_path, environment):
    told = complaint(command("renderer=moderngl_deferred", cwd=tmp_path, **environment))
    assert "libegl1" in told
    assert "renderer=soft_raster" in told


@pytest.mark.parametrize("package", ["moderngl", "glcontext"])
def test_without_the_package_one_sentence_names_the_remedy(tmp_path, package):
    (tmp_path / f"{package}.py").write_text(f'raise ImportError("No module named {package}")')
    told = complaint(command("renderer=moderngl_deferred", cwd=tmp_path, PYTHONPATH=str(tmp_path)))
    assert package in told
    assert "pip install moderngl" in told
