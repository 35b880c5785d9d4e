"""The style as a height map, and the field that starts there."""

import math

import numpy as np
import pytest
import torch
from PIL import Image

from styleexp.config.build import prepare
from styleexp.config.compose import compose
from styleexp.inputs import meshes, shapes
from styleexp.method import height_maps
from styleexp.method.height_maps import HeightMap, mesh_patch, triplanar
from styleexp.method.paper import displace
from tests.helpers.trying import one_encoder

SMALL = (
    "method=robust",
    "profile=smoke",
    "encoder=vgg19_random",
    "encoder.precision=fp32",
    "source=torus",
)
pytestmark = pytest.mark.filterwarnings("ignore:the encoder 'vgg19_random'")


@pytest.fixture(scope="module", autouse=True)
def encoder():
    with one_encoder("fp32"):
        yield


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


@pytest.mark.slow
def test_the_field_starts_at_the_height_map_and_learns_within_its_share():
    method, scene = prepare(compose([*SMALL, "style=bubble"]))
    state = method.start(scene)
    begun = displace(scene, state, torch.float32).detach()
    torch.testing.assert_close(begun, height_maps.displacement(scene.subject), atol=1e-6, rtol=0)
    assert np.subtract(*np.percentile(begun, [99, 1])) / 2 == pytest.approx(
        scene.subject.relief, rel=0.3
    )
    assert float((begun * scene.subject.areas).sum() / scene.subject.areas.sum()) == pytest.approx(
        0, abs=1e-6
    )
    with torch.no_grad():
        state.field.last.weight.normal_(std=100.0)  # tanh saturates: as far as the field can go
    moved = (displace(scene, state, torch.float32) - begun).abs().max().item()
    assert (
        scene.subject.bound * 0.2 < moved <= scene.subject.bound * 0.25 * 2
    )  # twice, for the mean's sake
    assert displace(scene, state, torch.float32).abs().max() <= scene.subject.bound


@pytest.mark.slow
def test_the_papers_field_starts_at_the_source_and_has_the_whole_bound():
    method, scene = prepare(compose([*SMALL, "style=bubble", "field.start=source"]))
    assert scene.base is None
    state = method.start(scene)
    assert not displace(scene, state, torch.float32).any()
    assert state.field.bound == scene.subject.bound
    assert compose(["source=torus", "style=bubble", "method=paper"]).field.start == "source"


def test_a_picture_is_a_height_map_too(tmp_path):
    rows, columns = np.mgrid[:128, :128]
    waves = np.cos(rows * np.pi / 8) * np.cos(columns * np.pi / 8)
    Image.fromarray((127.5 + 127.5 * waves).astype(np.uint8)).save(tmp_path / "waves.png")
    method, scene = prepare(compose([*SMALL, f"style.path={tmp_path}/waves.png"]))
    torch.testing.assert_close(
        displace(scene, method.start(scene), torch.float32), scene.base, atol=1e-6, rtol=0
    )
    assert scene.base.std() > 0.2 * scene.subject.relief


def test_a_style_too_coarse_for_a_height_map_is_told_and_starts_at_the_source(tmp_path):
    octahedron = np.concatenate([np.eye(3), -np.eye(3)])
    faces = [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
    mesh = meshes.Mesh("octahedron", octahedron, np.array(faces))
    meshes.save_mesh(mesh, mesh.vertices, tmp_path / "octahedron.ply")
    _, scene = prepare(compose([*SMALL, f"style.path={tmp_path}/octahedron.ply"]))
    assert scene.base is None
    assert any("'octahedron' is too coarse for a height map" in note for note in scene.notes)
