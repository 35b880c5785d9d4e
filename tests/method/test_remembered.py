import pytest
import torch

from styleexp.config.build import prepare
from styleexp.config.compose import compose
from styleexp.inputs import meshes, shapes
from styleexp.method import gram_cache

SMOKE = ["encoder=vgg19_random", "method=robust", "profile=smoke"]


@pytest.fixture
def made(monkeypatch, tmp_path):
    """Prepares a run with a cache of its own; counts what had to be measured."""
    monkeypatch.setenv("STYLEEXP_CACHE", str(tmp_path / "cache"))
    paths = []
    for name in ("sphere", "bubble"):
        mesh = shapes.make(name, 600)
        paths.append(tmp_path / f"{name}.obj")
        meshes.save_mesh(mesh, mesh.vertices, paths[-1])
    write, written = gram_cache._write, []
    monkeypatch.setattr(
        gram_cache, "_write", lambda path, found: written.append(path) or write(path, found)
    )

    def make(*overrides):
        written.clear()
        given = [f"source.path={paths[0]}", f"style.path={paths[1]}", *overrides]
        return prepare(compose([*SMOKE, *given]))[1], len(written)

    return make


def grams(scene):
    return [g for kind in (*scene.target(0), *scene.scales) for g in kind]


def test_the_second_run_measures_nothing_and_has_the_same_bits(made):
    first, measured = made()
    assert measured == 2
    second, measured = made("field.sigma=7", "optim.rate=1e-2")
    assert measured == 0
    assert all(map(torch.equal, grams(first), grams(second)))


@pytest.mark.slow
@pytest.mark.parametrize(
    "changed",
    [
        "optim.seed=1",
        "views.resolution=60",
        "shading.albedo=0.4",
        "encoder.activations=conv",
        "loss.erosion=1",
        "renderer.visibility_gradient=none",
        "style.scale=1.2",
    ],
)
def test_what_matters_is_measured_anew(made, changed):
    made()
    _, measured = made(changed)
    assert measured == (1 if changed.startswith("style.scale") else 2)


@pytest.mark.parametrize("damage", ["cut", "bit"])
def test_a_damaged_file_is_measured_anew(made, tmp_path, damage):
    first, _ = made()
    for file in (tmp_path / "cache" / "grams").glob("*.safetensors"):
        content = bytearray(file.read_bytes())
        content[-1] ^= 1
        file.write_bytes(content[:1000] if damage == "cut" else bytes(content))
    second, measured = made()
    assert measured == 2
    assert all(map(torch.equal, grams(first), grams(second)))


def test_only_so_many_are_kept(made, monkeypatch, tmp_path):
    monkeypatch.setattr(gram_cache, "KEPT", 3)
    for seed in range(3):
        made(f"optim.seed={seed}")
    assert len(list((tmp_path / "cache" / "grams").iterdir())) == 3


def test_a_run_needs_no_cache(made, monkeypatch, tmp_path):
    (tmp_path / "cache").write_text("not a folder")
    scene, _ = made()
    assert torch.isfinite(scene.target(0)[0][0]).all()
