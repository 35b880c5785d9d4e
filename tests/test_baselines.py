"""The methods compared against: the same command, the same folder, and what each is for."""

import json
import math
import os
import subprocess
import sys
import textwrap

import numpy as np
import pytest
import torch

import styleexp
from styleexp import baselines, meshes, shapes
from styleexp.baselines.displacement_map import HeightMap, mesh_patch, triplanar
from styleexp.baselines.specs import DisplacementMapConfig
from styleexp.compose import compose
from styleexp.errors import UserError
from styleexp.fields import VertexField

SMOKE = ("profile=smoke", "encoder=vgg19_random")
FOLDER = {"run.json", "status.json", "preview.png", "turntable.gif", "result.ply", "result.obj",
          "result.glb"}  # fmt: skip
pytestmark = pytest.mark.filterwarnings("ignore:the encoder 'vgg19_random'")


def command(*arguments, cwd, **variables):
    return subprocess.run(
        [sys.executable, "-m", "styleexp", *map(str, arguments)],
        cwd=cwd, env={**os.environ, **variables}, capture_output=True, text=True, timeout=300,
        check=False,
    )  # fmt: skip


def run(*overrides):
    method = baselines.method(compose([*SMOKE, *overrides]))
    scene = method.prepare(compose([*SMOKE, *overrides]))
    state = method.start(scene)
    steps = list(method.optimise(scene, state))
    return method.finish(scene, state), steps


# ---------------------------------------------------------------------------------------- choosing


def test_without_a_baseline_the_method_is_the_papers():
    assert baselines.method(compose(["source=torus", "style=bubble"])) is sys.modules[
        "styleexp.stylize"
    ]  # fmt: skip


PLUGIN = """
    from dataclasses import dataclass
    from styleexp.registry import Spec

    @dataclass
    class Config:
        name: str = "inflate"
        amount: float = 0.1

    def build(options):
        from styleexp.scene import load
        from styleexp.stylize import Result

        class Inflate:
            def prepare(self, config):
                return load(config)
            def start(self, scene):
                return None
            def optimise(self, scene, state):
                return iter(())
            def finish(self, scene, state):
                height = options.amount * scene.frame.scale
                normals = scene.surface.normals.double().numpy()
                vertices = scene.source.vertices + height * normals
                return Result(scene, height + 0 * vertices[:, 0], vertices)

        return Inflate()

    SPEC = Spec("inflate", "blows it up", Config, build)
"""


def test_a_baseline_of_a_plugin_runs_and_resumes(tmp_path):
    (tmp_path / "lab.py").write_text(textwrap.dedent(PLUGIN))
    named = {"STYLEEXP_PLUGINS": "baseline=lab:SPEC"}
    done = command(
        "baseline=inflate", "baseline.amount=0.25", "source=sphere", "style=bubble", *SMOKE,
        "hydra.run.dir=run", cwd=tmp_path, **named,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert {p.name for p in (tmp_path / "run").iterdir()} - {".hydra"} == FOLDER
    record = json.loads((tmp_path / "run/run.json").read_text())
    assert record["config"]["baseline"] == {"name": "inflate", "amount": 0.25}
    assert [p["kind"] for p in record["plugins"]] == ["baseline"]
    blown = styleexp.load_mesh(tmp_path / "run/result.ply")
    np.testing.assert_allclose(np.linalg.norm(blown.vertices, axis=1), 1.25, atol=1e-3)

    (tmp_path / "run/result.ply").unlink()
    assert command("resume=run", cwd=tmp_path, **named).returncode == 0
    assert (tmp_path / "run/result.ply").exists()

    done = command("baseline=inflate", "baseline.amount=much", *SMOKE, cwd=tmp_path, **named)
    assert done.returncode == 2
    assert "amount" in done.stderr
    assert "Traceback" not in done.stderr


# ------------------------------------------------------------------------------------------ vertex


def test_vertex_field_starts_at_zero_is_bounded_and_free():
    field = VertexField(0.1)
    points = field.encode(torch.rand(5, 3))
    assert (field(points) == 0).all()
    (latent,) = field.parameters()
    assert latent.shape == (5,)
    with torch.no_grad():
        latent[2] = 1e3
    assert field(points).tolist() == pytest.approx([0, 0, 0.1, 0, 0])
    with pytest.raises(ValueError, match="5 vertices"):
        field(torch.rand(4, 3))


def test_vertex_runs_with_the_same_loss_and_resumes_to_the_same_bits(tmp_path):
    arguments = ["method=vertex", "source=torus", "style=bubble", *SMOKE]
    done = command(*arguments, "hydra.run.dir=whole", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    steps = [json.loads(x) for x in (tmp_path / "whole/metrics.jsonl").read_text().splitlines()]
    assert [s["step"] for s in steps] == [1, 2, 3, 4]
    assert steps[-1]["rms_displacement"] > 0

    # As if it had been stopped after step 2: the checkpoint of then, and nothing later.
    folder = tmp_path / "whole"
    (folder / "checkpoint.previous.safetensors").replace(folder / "checkpoint.safetensors")
    before = (folder / "result.ply").read_bytes()
    (folder / "result.ply").unlink()
    done = command("resume=whole", cwd=tmp_path)
    assert "resuming at step" in done.stdout, done.stderr
    assert (folder / "result.ply").read_bytes() == before


# -------------------------------------------------------------------------------- displacement map


def test_triplanar_is_the_tile_where_the_normal_is_an_axis():
    """Height v on the planes x = 0 and z = 0, whose up is y: bands at the same heights."""
    rows = torch.linspace(1, -1, 64)[:, None].expand(64, 64)
    tile = HeightMap(rows, 2.0)
    y = torch.linspace(-1.9, -0.1, 10)
    points = torch.stack([torch.full_like(y, 0.3), y, torch.full_like(y, -0.4)], dim=1)
    along_x, along_z = torch.eye(3)[[0]].expand(10, 3), -torch.eye(3)[[2]].expand(10, 3)
    expected = torch.linspace(1, -1, 64)[((-y / 2) * 64).long().clamp(max=63)]
    for normals in (along_x, along_z):
        torch.testing.assert_close(triplanar(tile, points, normals, 8.0), expected,
                                   atol=0.05, rtol=0)  # fmt: skip
    mirrored = points * torch.tensor([1.0, -1.0, 1.0])
    torch.testing.assert_close(
        triplanar(tile, mirrored, along_x, 8.0), triplanar(tile, points, along_x, 8.0)
    )


def test_patch_of_the_stripe_is_its_bands_at_their_own_distance():
    patch = mesh_patch(shapes.make("stripe"), 0.6)
    assert patch.std(axis=1).max() < 0.3 * patch.std()  # bands run along the rows
    profile = patch.mean(axis=1) - patch.mean()
    spectrum = np.abs(np.fft.rfft(profile * np.hanning(len(profile))))
    bands = 0.6 * math.sqrt(2) / (math.pi / 14)
    assert spectrum[1:].argmax() + 1 == pytest.approx(bands, abs=0.8)


def test_patch_of_a_mesh_file_shows_the_same_relief_as_the_analytic_style():
    style = shapes.make("bubble", detail=20_000)
    other = meshes.Mesh("of no known name", style.vertices, style.faces)
    exact, measured = mesh_patch(style, 0.5), mesh_patch(other, 0.5)
    assert np.corrcoef(exact.ravel(), measured.ravel())[0, 1] > 0.9


def test_displacement_map_writes_the_same_folder_and_needs_no_encoder(tmp_path):
    done = command(
        "method=displacement_map", "source=sphere", "style=stripe", "profile=smoke",
        "encoder=vgg19", "hydra.run.dir=run", cwd=tmp_path, STYLEEXP_CACHE=tmp_path / "none",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert {p.name for p in (tmp_path / "run").iterdir()} - {".hydra"} == FOLDER


@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_displacement_map_is_as_large_as_style_scale_says_and_as_high_as_the_relief(scale):
    result, steps = run(
        "method=displacement_map", "source=sphere", "style=stripe", f"style.scale={scale}"
    )
    assert steps == []
    vertices = result.scene.source.vertices
    around = (np.abs(vertices[:, 1]) < 0.4) & (np.abs(vertices[:, 0]) > 0.8)
    order = np.argsort(vertices[around, 1])
    heights, y = result.displacement[around][order], vertices[around, 1][order]
    smooth = np.interp(np.linspace(-0.4, 0.4, 400), y, heights)
    crossings = (np.diff(np.sign(smooth - smooth.mean())) != 0).sum()
    assert crossings == pytest.approx(2 * 0.8 / (scale * math.pi / 14), abs=2.5)
    weighted = (result.displacement * result.scene.areas.numpy()).sum()
    assert weighted == pytest.approx(0, abs=1e-4)
    half = np.subtract(*np.percentile(result.displacement, [99, 1])) / 2
    assert half == pytest.approx(result.scene.relief, rel=0.15)


def test_displacement_map_of_a_picture_raises_what_is_bright():
    ramp = np.zeros((64, 64, 3), np.float32)
    ramp[:32] = 1.0
    from dataclasses import replace

    config = compose(["source=sphere", "style=bubble", "method=displacement_map"])
    method = baselines.method(config)
    scene = replace(method.prepare(config), style=ramp)
    result = method.finish(scene, None)
    half = scene.unit * math.sqrt(4 * math.pi) / 2  # y = 0 is the tile's top, bright, border
    assert half > 1
    assert np.ptp(result.displacement) < 1e-6  # all of the sphere is under the bright half
    small = replace(scene, unit=0.25)
    result = method.finish(small, None)
    front = np.abs(result.scene.source.vertices[:, 0]) > 0.9
    y = result.scene.source.vertices[front, 1]
    tile = 0.25 * math.sqrt(4 * math.pi)
    bright = np.abs(y) < 0.4 * tile
    assert result.displacement[front][bright].min() > 0


@pytest.mark.parametrize("key", ["height=2", "patch=0", "sharpness=0.5"])
def test_displacement_map_refuses_what_has_no_meaning(key):
    name, value = key.split("=")
    with pytest.raises(UserError, match=rf"baseline\.{name}"):
        baselines.method(compose(["method=displacement_map", f"baseline.{key}"]))
    assert float(value) != getattr(DisplacementMapConfig(), name)
