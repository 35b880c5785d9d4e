"""The methods compared against: the same command, the same folder, and what each is for."""

import json
import math
import textwrap

import numpy as np
import pytest
import torch

import styleexp
from styleexp.config import build
from styleexp.config.compose import compose
from styleexp.inputs import meshes, shapes
from styleexp.inputs.style import Style
from styleexp.method.base import Scene
from styleexp.method.baselines.face_gan import Critic, Generator, Patch, gradient_penalty
from styleexp.method.baselines.geometric_textures import choose_patch, fit_exemplar
from styleexp.method.baselines.options import DisplacementMapConfig
from styleexp.method.baselines.pyramid import adjacency, pyramid, restrict, upsample
from styleexp.method.fields import VertexField
from styleexp.method.paper import PaperLoop
from styleexp.method.synthesis.method import Synthesis
from styleexp.system.errors import UserError
from tests.helpers import warm

SMOKE = ("profile=smoke", "encoder=vgg19_random")
FOLDER = {"run.json", "status.json", "metrics.json", "preview.png", "turntable.gif", "result.ply",
          "result.obj", "result.glb"}  # fmt: skip
STEPPED = {"metrics.jsonl", "checkpoint.safetensors"}
pytestmark = pytest.mark.filterwarnings("ignore:the encoder 'vgg19_random'")


def command(*arguments, cwd, **variables):
    return warm.run("-m", "styleexp", *arguments, cwd=cwd, env=warm.coarse(**variables))


def run(*overrides):
    method, scene = build.prepare(compose([*SMOKE, *overrides]))
    state = method.start(scene)
    steps = list(method.optimise(scene, state))
    return method.finish(scene, state), steps


# ---------------------------------------------------------------------------------------- choosing


def test_synthesis_is_the_default_and_without_a_baseline_the_method_is_the_papers():
    assert isinstance(build.method_of(compose([])), Synthesis)
    smoke = compose([*SMOKE, "method=robust"])
    assert isinstance(build.method_of(smoke), PaperLoop)


def test_a_baseline_from_python(tmp_path):
    result = styleexp.stylize("sphere", "stripe", "method=displacement_map", "strength=0.5")
    assert np.ptp(result.displacement) == pytest.approx(0.06 * 0.5, rel=0.2)  # the bands are 0.06
    result.save(tmp_path / "out.ply")
    assert len(styleexp.load_mesh(tmp_path / "out.ply").vertices) == len(result.vertices)


PLUGIN = """
    from dataclasses import dataclass
    from styleexp.plugins.spec import Spec

    @dataclass
    class Config:
        name: str = "inflate"
        amount: float = 0.1

    def build(options):
        import torch
        from styleexp.method.base import Method, displaced

        class Inflate(Method):
            def finish(self, scene, state):
                subject = scene.subject
                height = torch.full_like(subject.areas, options.amount)
                return displaced(subject, height)

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
    found = {p.name for p in (tmp_path / "run").iterdir()}
    assert found >= FOLDER
    assert not found & STEPPED
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
    field, points = VertexField(5, 0.1), torch.rand(5, 3)
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


def test_displacement_map_writes_the_same_folder_and_needs_no_encoder(tmp_path):
    done = command(
        "method=displacement_map", "source=sphere", "style=stripe", "profile=smoke",
        "encoder=vgg19", "hydra.run.dir=run", cwd=tmp_path, STYLEEXP_CACHE=tmp_path / "none",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = {p.name for p in (tmp_path / "run").iterdir()}
    assert found >= FOLDER
    assert not found & STEPPED


@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_displacement_map_is_as_large_as_style_scale_says_and_as_high_as_the_relief(scale):
    result, steps = run(
        "method=displacement_map", "source=sphere", "style=stripe", f"style.scale={scale}"
    )
    assert steps == []
    vertices = result.subject.source.vertices
    around = (np.abs(vertices[:, 1]) < 0.4) & (np.abs(vertices[:, 0]) > 0.8)
    order = np.argsort(vertices[around, 1])
    heights, y = result.displacement[around][order], vertices[around, 1][order]
    smooth = np.interp(np.linspace(-0.4, 0.4, 400), y, heights)
    crossings = (np.diff(np.sign(smooth - smooth.mean())) != 0).sum()
    assert crossings == pytest.approx(2 * 0.8 / (scale * math.pi / 14), abs=2.5)
    weighted = (result.displacement * result.subject.areas.numpy()).sum()
    assert weighted == pytest.approx(0, abs=1e-4)
    half = np.subtract(*np.percentile(result.displacement, [99, 1])) / 2
    assert half == pytest.approx(result.subject.relief, rel=0.15)


def test_displacement_map_of_a_picture_raises_what_is_bright():
    ramp = np.zeros((64, 64, 3), np.float32)
    ramp[:32] = 1.0
    from dataclasses import replace

    from styleexp.method.pictures import picture_height

    config = compose(["source=sphere", "style=bubble", "method=displacement_map"])
    method, scene = build.prepare(config)
    heights = picture_height(config.style, ramp)
    subject = replace(scene.subject, style=Style.of(ramp), heights=heights)
    result = method.finish(Scene(subject), None)
    half = subject.unit * math.sqrt(4 * math.pi) / 2  # y = 0 is the tile's top, bright, border
    assert half > 1
    assert np.ptp(result.displacement) < 1e-6  # all of the sphere is under the bright half
    small = replace(subject, unit=0.25)
    result = method.finish(Scene(small), None)
    front = np.abs(result.subject.source.vertices[:, 0]) > 0.9
    y = result.subject.source.vertices[front, 1]
    tile = 0.25 * math.sqrt(4 * math.pi)
    bright = np.abs(y) < 0.4 * tile
    assert result.displacement[front][bright].min() > 0


@pytest.mark.parametrize("key", ["height=2", "patch=0", "sharpness=0.5"])
def test_displacement_map_refuses_what_has_no_meaning(key):
    name, value = key.split("=")
    with pytest.raises(UserError, match=rf"baseline\.{name}"):
        build.prepare(compose(["method=displacement_map", f"baseline.{key}"]))
    assert float(value) != getattr(DisplacementMapConfig(), name)


# ------------------------------------------------------------------------------ geometric textures

CPU = torch.device("cpu")
SMALL = ("baseline.base=60", "baseline.levels=2", "baseline.patch=200", "baseline.width=8",
         "baseline.depth=1", "baseline.critic_steps=1")  # fmt: skip


def onto_sphere(points):
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def sphere(levels=1):
    return pyramid(*shapes.icosphere(60), levels, onto_sphere, CPU)


def test_adjacency_is_across_each_edge():
    faces = np.array([[0, 1, 2], [2, 1, 3]])
    neighbours, opposite = adjacency(faces, 4)
    assert neighbours.tolist() == [[0, 1, 0], [0, 1, 1]]  # edge 1-2 is shared, the rest is border
    assert opposite.tolist() == [[2, 3, 1], [0, 2, 1]]


def test_levels_are_subdivisions_on_the_surface_and_values_go_up_and_down():
    coarse, fine = sphere(2)
    assert len(fine.faces) == 4 * len(coarse.faces)
    torch.testing.assert_close(fine.base.norm(dim=1), torch.ones(len(fine.base)))
    assert (fine.neighbours != torch.arange(len(fine.faces))[:, None]).all()  # it is closed
    halved = upsample(fine, coarse.base)
    assert (halved - fine.base).norm(dim=1).max() < 0.1
    assert halved.norm(dim=1).min() < 0.99  # midpoints of chords
    constant = torch.full((len(fine.base), 1), 3.0)
    torch.testing.assert_close(restrict(fine, constant), torch.full((len(coarse.base), 1), 3.0))
    triple = fine.frames
    torch.testing.assert_close(
        torch.linalg.det(triple), torch.ones(len(fine.faces), 3), atol=1e-4, rtol=0
    )


@pytest.fixture
def networks():
    torch.manual_seed(0)
    generator, critic = Generator(8, 2), Critic(8, 2)
    for parameter in generator.parameters():  # trained ones don't add nothing
        torch.nn.init.normal_(parameter, std=0.3)
    return generator, critic


def test_networks_see_neither_where_a_face_starts_nor_how_the_mesh_is_turned(networks):
    generator, critic = networks
    points, faces = shapes.icosphere(60)
    field = torch.randn(len(points), 3, generator=torch.Generator().manual_seed(1))

    def both(points, faces, field):
        (level,) = pyramid(points, faces, 1, onto_sphere, CPU)
        patch = Patch.of(level)
        return generator(patch, field), critic(patch.seen(field), patch.neighbours)

    detail, score = both(points, faces, field)
    assert detail.std() > 0.01
    shifts = np.random.default_rng(2).integers(0, 3, len(faces))
    rolled = np.stack([np.roll(face, k) for face, k in zip(faces, shifts, strict=True)])
    other_detail, other_score = both(points, rolled, field)
    torch.testing.assert_close(other_detail, detail, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(other_score, score, atol=1e-5, rtol=1e-4)

    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    as_torch = torch.from_numpy(turn).float()
    other_detail, other_score = both(points @ turn.T, faces, field @ as_torch.T)
    torch.testing.assert_close(other_detail, detail @ as_torch.T, atol=1e-4, rtol=1e-3)
    torch.testing.assert_close(other_score, score, atol=1e-4, rtol=1e-3)


def test_a_patch_agrees_with_the_whole_away_from_its_rim(networks):
    generator, _ = networks
    level = sphere(2)[1]
    field = torch.randn(len(level.base), 3, generator=torch.Generator().manual_seed(1))
    centre = int((level.base[level.faces].mean(1) @ torch.tensor([0.0, 0.0, 1.0])).argmax())
    middle = level.base[level.faces].mean(1)
    near = (middle - middle[centre]).square().sum(1).topk(160, largest=False).indices
    part, whole = generator(Patch.of(level, near), field), generator(Patch.of(level), field)
    corners = level.faces[centre]
    torch.testing.assert_close(part[corners], whole[corners])
    far = level.faces[int((-middle @ middle[centre]).argmax())]
    assert (part[far] == 0).all()


def test_critic_never_sees_a_patchs_rim():
    (level,) = sphere()
    patch, inner = choose_patch(level, 60, torch.Generator().manual_seed(0))
    assert (len(patch.faces), len(inner.faces)) == (60, 30)
    assert {tuple(f) for f in inner.faces.tolist()} < {tuple(f) for f in patch.faces.tolist()}


def test_gradient_penalty_is_zero_for_a_slope_of_one():
    (level,) = sphere()
    patch = Patch.of(level)
    zeros, ones = torch.zeros(len(level.faces), 3, 18), torch.ones(len(level.faces), 3, 18)

    class Straight(torch.nn.Module):
        def __init__(self, slope):
            super().__init__()
            self.slope = slope

        def forward(self, seen, neighbours):
            return self.slope * seen[:, 0, 0]

    assert gradient_penalty(Straight(1.0), patch, ones, zeros, 0.3) == pytest.approx(0.0, abs=1e-9)
    assert gradient_penalty(Straight(3.0), patch, ones, zeros, 0.3) == pytest.approx(4.0)


def test_exemplar_of_a_mesh_file_is_the_analytic_ones():
    style = shapes.make("wave_large", detail=4000)
    levels, fields = fit_exemplar(style, 200, 2, CPU)
    finest = levels[-1].base
    heights = (fields[-1] * finest).sum(1) / finest.norm(dim=1)
    expected = shapes.relief("wave_large", finest.numpy())
    assert np.corrcoef(heights.numpy(), expected)[0, 1] > 0.999
    assert len(fields[0]) == len(levels[0].base)

    other, measured = fit_exemplar(meshes.Mesh("mine", style.vertices, style.faces), 200, 2, CPU)
    place = other[-1].base.numpy()
    heights = (measured[-1].numpy() * place).sum(1) / np.linalg.norm(place, axis=1)
    assert np.corrcoef(heights, shapes.relief("wave_large", place))[0, 1] > 0.9


def test_training_learns_to_recall_the_exemplar():
    _, steps = run(
        "method=geometric_textures", "source=sphere", "style=wave_large", *SMALL,
        "baseline.levels=1", "baseline.iterations=25", "optim.steps=4", "optim.rate=5e-3",
    )  # fmt: skip
    assert [s.level for s in steps] == [0, 0, 0, 0]
    assert steps[-1].reconstruction < 0.7  # an untrained generator has 1


def test_geometric_textures_subdivides_the_source_and_resumes_to_the_same_bits(tmp_path):
    arguments = ["method=geometric_textures", "source=critter", "style=bubble", *SMOKE, *SMALL,
                 "baseline.base=300", "baseline.iterations=2"]  # fmt: skip
    done = command(*arguments, "hydra.run.dir=run", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "doesn't have the source's own faces" in done.stdout
    folder = tmp_path / "run"
    assert {*FOLDER, "metrics.jsonl", "checkpoint.safetensors"} <= {
        p.name for p in folder.iterdir()
    }
    steps = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert [(s["step"], s["level"]) for s in steps] == [(1, 0), (2, 0), (3, 1), (4, 1)]

    result, source = styleexp.load_mesh(folder / "result.obj"), shapes.make("critter")
    assert not result.repairs  # closed, manifold, wound outward
    assert len(result.vertices) != len(source.vertices)
    np.testing.assert_allclose(np.ptp(result.vertices, axis=0), np.ptp(source.vertices, axis=0),
                               rtol=0.15)  # fmt: skip
    assert "displacement" in (folder / "result.ply").read_bytes()[:600].decode("latin-1")

    (folder / "checkpoint.previous.safetensors").replace(folder / "checkpoint.safetensors")
    before = (folder / "result.obj").read_bytes()
    (folder / "result.obj").unlink()
    done = command("resume=run", cwd=tmp_path)
    assert "resuming at step" in done.stdout, done.stderr
    assert (folder / "result.obj").read_bytes() == before


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["style=rows"], "learns from a mesh, and the style 'rows' is a picture"),
        (["style=bubble", "baseline.levels=0"], "baseline.levels=0"),
        (["style=bubble", "optim.steps=2"], "optim.steps=2 leaves a level untrained"),
        (["style=bubble", "style.scale=9"], "the source would get 1"),
        (["style=bubble", "style.scale=0.01"], "the source would get"),
        (["style=bubble", "baseline.levels=6", "baseline.base=9999"], "the style would get"),
        (["style=bubble", "source=leaf"], "'leaf' can't be resampled"),
    ],
)
def test_geometric_textures_says_what_it_can_not_take(arguments, told, tmp_path, monkeypatch):
    from PIL import Image

    rows = np.uint8(255 * (np.arange(64) // 8 % 2))[:, None].repeat(64, 1)
    Image.fromarray(rows).save(tmp_path / "rows.png")
    # Three triangles at one edge.
    (tmp_path / "leaf.obj").write_text(
        "v 0 0 0\nv 0 1 0\nv 1 0 0\nv -1 0 1\nv -1 0 -1\nf 1 2 3\nf 1 2 4\nf 1 2 5\n"
    )
    done = command(
        "method=geometric_textures", "source=sphere", *arguments, *SMOKE, "hydra.run.dir=run",
        cwd=tmp_path, STYLEEXP_ASSETS=tmp_path,
    )  # fmt: skip
    assert done.returncode == 2, done.stderr
    assert told in done.stderr
    assert "Traceback" not in done.stderr


# --------------------------------------------------------------------------------------- text2mesh


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """A folder with a small CLIP image tower of random weights."""
    transformers = pytest.importorskip("transformers")
    folder = tmp_path_factory.mktemp("clip")
    torch.manual_seed(0)
    config = transformers.CLIPVisionConfig(
        hidden_size=32, intermediate_size=64, num_hidden_layers=2, num_attention_heads=2,
        image_size=64, patch_size=16, projection_dim=16,
    )  # fmt: skip
    transformers.CLIPVisionModelWithProjection(config).save_pretrained(folder)
    return folder


def test_clip_embeds_as_its_own_preprocessing_does(clip):
    """Against transformers' image processor on a picture of CLIP's own size."""
    transformers = pytest.importorskip("transformers")
    from styleexp.encoders import clip as module

    encoder = module.load(str(clip), CPU)
    picture = torch.rand(1, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    found = encoder.embed(picture)
    assert found.norm().item() == pytest.approx(1.0)
    mean, std = torch.tensor(module.MEAN), torch.tensor(module.STD)
    given = (picture - mean.view(1, 3, 1, 1)) / std.view(1, 3, 1, 1)
    tower = transformers.CLIPVisionModelWithProjection.from_pretrained(clip)
    expected = tower(pixel_values=given).image_embeds
    torch.testing.assert_close(found, expected / expected.norm())
    assert not any(p.requires_grad for p in encoder.parameters())


def test_text2mesh_runs_with_a_picture_and_lowers_its_loss(clip, tmp_path):
    from PIL import Image

    rows = np.uint8(255 * (np.arange(64) // 8 % 2))[:, None].repeat(64, 1)
    Image.fromarray(rows).save(tmp_path / "rows.png")
    done = command(
        "method=text2mesh", f"encoder.weights={clip}", "source=sphere", "style.path=rows.png",
        "profile=smoke", "hydra.run.dir=run", cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "Loading" not in done.stderr
    folder = tmp_path / "run"
    assert {*FOLDER, "metrics.jsonl", "checkpoint.safetensors"} <= {
        p.name for p in folder.iterdir()
    }
    record = json.loads((folder / "run.json").read_text())
    assert record["config"]["loss"]["name"] == "clip"
    assert record["encoder_precision"] == "fp32"
    steps = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert all(0 < s["loss"] < 4 for s in steps)
    assert steps[-1]["rms_displacement"] > 0


def test_clip_loss_compares_directions():
    from styleexp.method.losses import ClipLoss

    loss = object.__new__(ClipLoss)
    east, north = torch.tensor([2.0, 0.0]), torch.tensor([0.0, 3.0])
    for other, expected in ((5 * east, 0.0), (north, 1.0), (-east, 2.0)):
        assert loss.distance([east], [other], []).item() == pytest.approx(expected)


def test_what_clip_lacks_is_said(clip, tmp_path):
    from safetensors.torch import load_file, save_file

    with pytest.raises(UserError, match=r"encoder\.weights=FOLDER"):
        run("method=text2mesh", "encoder=clip", "source=sphere", "style=bubble")
    weights = load_file(clip / "model.safetensors")
    del weights["visual_projection.weight"]
    (tmp_path / "config.json").write_text((clip / "config.json").read_text())
    save_file(weights, tmp_path / "model.safetensors", metadata={"format": "pt"})
    for folder, told in ((tmp_path, "visual_projection"), ("nowhere", "is not a CLIP model")):
        with pytest.raises(UserError, match=told):
            run("method=text2mesh", "encoder=clip", f"encoder.weights={folder}", "source=sphere",
                "style=bubble")  # fmt: skip
    with pytest.raises(UserError, match="use loss=clip"):
        run(
            "method=robust",
            "encoder=clip",
            f"encoder.weights={clip}",
            "source=sphere",
            "style=bubble",
        )
    with pytest.raises(UserError, match="use encoder=clip"):
        run("method=robust", "loss=clip", "source=sphere", "style=bubble")
