"""`styleexp.stylize` as a guest of somebody else's program: what it takes, and what it leaves."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import trimesh

import styleexp
from styleexp.inputs import shapes
from styleexp.system.errors import UserError

SMOKE = ("method=robust", "profile=smoke", "encoder=vgg19_random", "metrics.judge=none")
pytestmark = pytest.mark.filterwarnings("ignore")

HOST = '''
"""A Hydra application with names of its own that are ours, too."""
import random, threading
from dataclasses import dataclass

import hydra, numpy as np, torch, trimesh
from hydra.core.config_store import ConfigStore
from hydra.core.singleton import Singleton
from hydra.utils import instantiate
from omegaconf.basecontainer import BaseContainer

import styleexp

@dataclass
class Host:
    width: int = 3

ConfigStore.instance().store(name="base_config", node=Host)
ConfigStore.instance().store(group="encoder", name="vgg16", node={"mine": 1})
SMOKE = ("method=robust", "profile=smoke", "encoder=vgg19_random", "metrics.judge=none")

def state():
    return (torch.get_num_threads(), torch.get_rng_state().tolist(), random.getstate(),
            np.random.get_state()[1].tolist(), dict(Singleton._instances),
            dict(BaseContainer._resolvers), ConfigStore.instance().load("base_config.yaml").node,
            ConfigStore.instance().load("encoder/vgg16.yaml").node)

@hydra.main(version_base="1.3", config_path=None, config_name="base_config")
def main(config):
    styles, alone, together = ("bubble", "stripe"), {}, {}
    torch.manual_seed(3)
    before = state()
    for style in styles:
        alone[style] = styleexp.stylize("torus", style, *SMOKE, "threads=1").vertices
        assert state() == before
    def go(style):
        together[style] = styleexp.stylize("torus", style, *SMOKE, "threads=1").vertices
    threads = [threading.Thread(target=go, args=(style,)) for style in styles]
    [thread.start() for thread in threads]
    [thread.join() for thread in threads]
    assert all((alone[style] == together[style]).all() for style in styles)
    assert state() == before
    assert instantiate({"_target_": "collections.Counter"}) == {}
    assert hydra.compose("base_config", overrides=["width=4"]).width == 4
    print("a good guest")

main()
'''


def test_a_hydra_application_finds_everything_as_it_left_it(tmp_path):
    (tmp_path / "host.py").write_text(HOST)
    done = subprocess.run(
        [sys.executable, "host.py"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert "a good guest" in done.stdout, done.stderr


def test_threads_hold_during_the_call(monkeypatch):
    import torch

    from styleexp.method import height_maps

    seen = []
    real = height_maps.displacement
    monkeypatch.setattr(
        height_maps, "displacement", lambda *a: (seen.append(torch.get_num_threads()), real(*a))[1]
    )
    styleexp.stylize("torus", "bubble", *SMOKE, "threads=3")
    assert seen == [3]
    assert torch.get_num_threads() != 3


@pytest.fixture(scope="module")
def ball():
    return trimesh.creation.icosphere(3)


def test_a_mesh_in_memory_is_a_mesh_from_a_file(ball, tmp_path):
    # The written digits are all that the file has of it.
    ball.vertices = ball.vertices.round(4)
    ball.export(tmp_path / "ball.obj", digits=4)
    from_file = styleexp.stylize(tmp_path / "ball.obj", "bubble", *SMOKE)
    for given in (ball, (ball.vertices, ball.faces), (ball.vertices.tolist(), ball.faces.tolist())):
        result = styleexp.stylize(given, "bubble", *SMOKE)
        assert (result.vertices == from_file.vertices).all()
        assert (result.faces == ball.faces).all()
    shown = result.trimesh()
    assert (shown.vertices == result.vertices).all()
    assert (shown.vertex_attributes["displacement"] == result.displacement).all()
    result.save(tmp_path / "result.ply")
    assert len(trimesh.load(tmp_path / "result.ply").faces) == len(ball.faces)


def test_a_style_in_memory_is_a_style_from_a_file(ball, tmp_path):
    from PIL import Image

    grey = np.random.default_rng(0).integers(0, 255, (40, 50), dtype=np.uint8)
    Image.fromarray(grey).save(tmp_path / "grey.png")
    map_ = (*SMOKE, "method=displacement_map")
    from_file = styleexp.stylize(ball, tmp_path / "grey.png", *map_).vertices
    for picture in (grey, np.stack([grey] * 3, axis=-1), grey.astype(np.uint16) * 257, grey / 255):
        assert np.allclose(styleexp.stylize(ball, picture, *map_).vertices, from_file, atol=1e-7)
    style = shapes.make("bubble")
    named = styleexp.stylize(ball, "bubble", *SMOKE).vertices
    assert (styleexp.stylize(ball, style, *SMOKE).vertices == named).all()


@pytest.mark.parametrize(
    ("source", "style", "told"),
    [
        ((np.zeros((3, 2)), np.zeros((1, 3), int)), "bubble", r"the source has vertices of shape"),
        ((np.eye(3), np.zeros((1, 4), int)), "bubble", "the source has faces of shape"),
        ((np.eye(3), np.array([[0, 1, 7]])), "bubble", "refers to vertex 7"),
        ((np.full((3, 3), np.nan), np.array([[0, 1, 2]])), "bubble", "NaN"),
        (7, "bubble", "the source is a int"),
        ("torus", np.zeros((40, 40, 2)), "the style is an array of shape"),
        ("torus", np.full((40, 40), 7.0), r"outside \[0, 1\]"),
        ("torus", np.zeros((40, 40), np.int64), "picture of int64"),
        ("torus", np.zeros((4, 40)), "at least 16"),
        ("torus", "bubbel", "unknown style 'bubbel'"),
        ((iter("ab"), iter("ab")), "bubble", "not a pair of numeric arrays"),
        ((np.eye(3) * 1j, np.array([[0, 1, 2]])), "bubble", "complex"),
        ("torus", np.full((40, 40), 0.5), "a picture of uniform tone"),
        ("torus", np.full((40, 40, 3), 255, np.uint8), "a picture of uniform tone"),
    ],
)
def test_what_can_not_be_taken_is_said_in_one_sentence(source, style, told):
    with pytest.raises(UserError, match=told):
        styleexp.stylize(source, style, *SMOKE)


def test_what_a_trimesh_looks_like_is_kept(ball, tmp_path):
    from PIL import Image

    uv = ball.vertices[:, :2] / 2 + 0.5
    image = Image.fromarray(np.arange(192, dtype=np.uint8).reshape(8, 8, 3))
    painted = trimesh.visual.TextureVisuals(uv=uv, image=image)
    mesh = trimesh.Trimesh(ball.vertices, ball.faces, process=False, visual=painted)
    styleexp.stylize(mesh, "bubble", *SMOKE, "strength=0").save(tmp_path / "painted.glb")
    read = trimesh.load(tmp_path / "painted.glb", process=False, force="mesh")
    assert np.allclose(read.visual.uv, uv, atol=1e-6)
    assert (np.asarray(read.visual.material.baseColorTexture.convert("RGB")) == image).all()
    colours = np.random.default_rng(0).integers(0, 255, (len(ball.vertices), 4), dtype=np.uint8)
    mesh = trimesh.Trimesh(ball.vertices, ball.faces, process=False, vertex_colors=colours)
    styleexp.stylize(mesh, "bubble", *SMOKE, "strength=0").save(tmp_path / "coloured.ply")
    read = trimesh.load(tmp_path / "coloured.ply", process=False)
    assert (read.visual.vertex_colors == colours).all()


@pytest.mark.filterwarnings("default")
def test_what_was_left_out_is_said_and_faces_stay(ball):
    more = np.vstack([[[5.0, 5, 5]], ball.vertices]), ball.faces + 1
    with pytest.warns(UserWarning, match="left out 1 vert"):
        result = styleexp.stylize(more, "bubble", *SMOKE)
    assert len(result.faces) == len(ball.faces)


@pytest.mark.parametrize("twice", ["style=stripe", "source.path=x.obj", "style.name=stripe"])
def test_source_and_style_are_given_once(twice):
    with pytest.raises(UserError, match="are given already"):
        styleexp.stylize("torus", "bubble", twice)
    for no_override in ("strength", 7, "-m"):
        with pytest.raises(UserError, match="is not KEY=VALUE"):
            styleexp.stylize("torus", "bubble", no_override)


def test_a_wrong_override_is_said_as_on_the_command_line():
    with pytest.raises(UserError, match="did you mean optim"):
        styleexp.stylize("torus", "bubble", "optim.stps=3")
