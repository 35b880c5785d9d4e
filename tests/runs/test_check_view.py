"""The check view: pyrender, in a process of its own, against the renderers of this package."""

from __future__ import annotations

import json
import subprocess
import sys
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

import styleexp
from styleexp.inputs import meshes, shapes
from styleexp.renderers.moderngl_deferred import ModernGLDeferred
from styleexp.renderers.soft_raster import SoftRaster
from styleexp.runs import previews, pyrender_view
from styleexp.system.errors import UserError
from tests.helpers import warm
from tests.helpers.needed import available

ELEVATIONS, AZIMUTHS = [15.0, -30.0], [35.0, 190.0]
SMOKE = ["source=torus", "style=bubble", "method=robust", "profile=smoke", "encoder=vgg19_random"]


@pytest.fixture(scope="module", params=previews.CHECK_PLATFORMS)
def platform(request):
    available(lambda: previews.check_available(request.param))
    return request.param


@pytest.fixture(scope="module")
def any_platform():
    available(previews.check_available)


@pytest.fixture(scope="module")
def critter():
    mesh = shapes.make("critter")
    return meshes.normalisation(mesh.vertices).apply(mesh.vertices), mesh.faces


def cameras_around(vertices):
    cameras = previews.framed(torch.from_numpy(vertices).float(), ELEVATIONS, AZIMUTHS)
    return replace(
        cameras,
        focal=cameras.focal * torch.tensor([[0.8, 1.0], [0.7, 0.6]]),
        center=torch.tensor([[0.1, -0.05], [-0.2, 0.15]]),
    )


def test_silhouettes_agree(platform, critter):
    """Off-centre cameras with different focal lengths; pixel centres decide on both sides."""
    vertices, faces = critter
    cameras = cameras_around(vertices)
    drawn = previews.check_views(vertices, faces, cameras, 200, platform)
    assert drawn.platform == platform
    assert drawn.device
    assert drawn.pictures.shape == drawn.covered.shape == (2, 200, 200)
    ious, own = previews.silhouette_iou(drawn.covered, vertices, faces, cameras, SoftRaster())
    assert 0.05 < own.mean() < 0.9
    assert min(ious) > 0.999
    # It would have noticed: shifted by one pixel, mirrored, upside down.
    for wrong in (np.roll(drawn.covered, 1, 2), drawn.covered[:, :, ::-1], drawn.covered[:, ::-1]):
        assert max(previews.silhouette_iou(wrong, vertices, faces, cameras, SoftRaster())[0]) < 0.99


def test_silhouettes_of_a_real_mesh_agree(any_platform, named_mesh):
    mesh = styleexp.load_mesh(named_mesh("armadillo"))
    vertices = meshes.normalisation(mesh.vertices).apply(mesh.vertices)
    cameras = cameras_around(vertices)
    drawn = previews.check_views(vertices, mesh.faces, cameras, 300)
    for renderer in (SoftRaster(), available(ModernGLDeferred)):
        ious, _ = previews.silhouette_iou(drawn.covered, vertices, mesh.faces, cameras, renderer)
        assert min(ious) > 0.999


def test_pictures_are_lit_and_on_white(platform, critter):
    vertices, faces = critter
    drawn = previews.check_views(vertices, faces, cameras_around(vertices), 200, platform)
    assert (drawn.pictures[:, 0, 0] == 255).all()
    inside = drawn.pictures[drawn.covered].astype(float)
    assert 80 < inside.mean() < 220
    assert inside.std() > 15
    assert (inside > 250).mean() < 0.02


def test_it_runs_in_a_process_of_its_own(any_platform, critter):
    """Nothing of OpenGL is loaded here, nothing of torch there, and a live context survives."""
    renderer = available(ModernGLDeferred)
    vertices, faces = critter
    cameras = cameras_around(vertices)
    before = previews.silhouette_iou(
        np.ones((2, 50, 50), bool), vertices, faces, cameras, renderer
    )[1]
    drawn = previews.check_views(vertices, faces, cameras, 50)
    after, own = previews.silhouette_iou(drawn.covered, vertices, faces, cameras, renderer)
    assert min(after) > 0.99
    assert np.array_equal(own, before)
    assert not {"pyrender", "OpenGL"} & set(sys.modules)
    code = (
        "import sys, styleexp.runs.pyrender_view\n"
        "heavy = {'torch', 'styleexp.renderers', 'styleexp.runs.previews'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_what_fails_there_is_an_error_here(critter, monkeypatch):
    vertices, faces = critter
    cameras = cameras_around(vertices)
    with pytest.raises(UserError, match="libosmesa6"):
        previews.check_views(vertices, faces, cameras, 50, "wayland")
    monkeypatch.setattr(previews, "CHECK_TIMEOUT", 0.01)
    with pytest.raises(UserError, match="no picture after"):
        previews.check_views(vertices, faces, cameras, 50)
    monkeypatch.setattr(previews.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match="pip install"):
        previews.check_views(vertices, faces, cameras, 50)


def test_a_crash_there_is_an_error_here(critter, monkeypatch, tmp_path):
    vertices, faces = critter
    (tmp_path / "pyrender.py").write_text("import os; os.abort()")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(UserError, match="exit code -6"):
        previews.check_views(vertices, faces, cameras_around(vertices), 50)


def command(*arguments, cwd, **environment):
    environment = warm.coarse(**environment)
    return warm.run(
        "-m", "styleexp", *SMOKE, *arguments, "hydra.run.dir=run", cwd=cwd, env=environment
    )


def test_run_with_a_check_view(any_platform, tmp_path):
    done = command("preview=pyrender", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "check view" not in done.stderr
    folder = tmp_path / "run"
    for name in ("check.png", "check.gif", "check.json"):
        assert f"run/{name}" in done.stdout
    found = json.loads((folder / "check.json").read_text())
    assert found["least_iou"] == min(view["iou"] for view in found["views"]) > 0.99
    assert [view["view"] for view in found["views"]] == [v[0] for v in previews.VIEWS]
    assert found["renderer"] == "soft_raster"
    size = found["resolution"]
    assert size == 256  # the profile's
    assert Image.open(folder / "check.png").width == 4 * size
    assert Image.open(folder / "check.gif").n_frames == 4
    with Image.open(folder / "preview.png") as preview:
        assert preview.width == 4 * 96
    record = json.loads((folder / "run.json").read_text())
    assert record["config"]["preview"]["name"] == "pyrender"


def test_disagreement_is_a_warning_and_in_the_record(any_platform, tmp_path):
    """A renderer that is wrong, here one that mirrors its pictures, is found out."""

    class Mirrored(SoftRaster):
        def render(self, *arguments):
            out = super().render(*arguments)
            return replace(out, coverage=out.coverage.flip(2))

    result, config = finished()
    written = []

    def write(name, writer):
        writer(tmp_path / name)
        written.append(tmp_path / name)
        return written[-1]

    with pytest.warns(UserWarning, match=r"IoU of 0\.\d+ with soft_raster's, .*0\.98"):
        assert previews.write_check(result, Mirrored(), config, write) == written
    assert json.loads((tmp_path / "check.json").read_text())["least_iou"] < 0.98
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        previews.write_check(result, SoftRaster(), config, write)


def finished():
    """The source itself, as the result of no steps."""
    from styleexp.config.build import prepare
    from styleexp.config.compose import compose

    config = compose(["source=critter", *SMOKE[1:], "preview=pyrender"])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        method, scene = prepare(config)
    return method.finish(scene, method.start(scene)), config


def test_without_opengl_a_run_stops_before_it_begins(tmp_path):
    (tmp_path / "pyrender.py").write_text('raise ImportError("no pyrender here")')
    done = command("preview=pyrender", cwd=tmp_path, PYTHONPATH=str(tmp_path))
    assert done.returncode == 2, done.stderr
    lines = [x for x in done.stderr.splitlines() if x.strip() and not x.startswith("warning: ")]
    assert len(lines) == 1, done.stderr
    assert "preview=builtin" in lines[0]
    assert not (tmp_path / "run" / "metrics.jsonl").exists()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["preview=pyrendr"], "unknown preview 'pyrendr'"),
        (["preview.name=pyrendr"], "preview.name"),
        (["preview=pyrender", "preview.platform=x11"], "preview.platform"),
    ],
)
def test_mistakes(arguments, expected, tmp_path):
    done = command(*arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert expected in done.stderr


def test_lights_come_from_where_they_are_said_to():
    pose = pyrender_view._towards(np.array([0.0, 0.0, 2.0]))
    assert np.allclose(pose, np.eye(4))
    turned = pyrender_view._towards(np.array([1.0, 2.0, -1.0]))
    assert np.allclose(turned[:3, :3].T @ turned[:3, :3], np.eye(3))
    assert np.allclose(turned[:3, 2], np.array([1, 2, -1]) / 6**0.5)
