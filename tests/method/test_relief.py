import numpy as np
import pytest

from styleexp.inputs import meshes, shapes
from styleexp.method.relief import half_range, mesh_frequency, mesh_relief, picture_frequency


def measure(mesh):
    vertices = meshes.normalisation(mesh.vertices).apply(mesh.vertices)
    normals = meshes.vertex_normals(vertices, mesh.faces)
    height = mesh_relief(vertices, mesh.faces, normals, length=0.5)
    return half_range(height), mesh_frequency(height, vertices, mesh.faces)


@pytest.mark.parametrize("name", list(shapes.RELIEFS))
def test_relief_of_the_analytic_styles_is_near_their_formula(name):
    mesh = shapes.make(name, detail=10_000)
    relief = shapes.relief(name, mesh.vertices / np.linalg.norm(mesh.vertices, axis=1)[:, None])
    assert measure(mesh)[0] == pytest.approx(np.ptp(relief) / 2, rel=0.4)


def test_a_sphere_has_next_to_none():
    assert measure(shapes.make("sphere", detail=10_000))[0] < 0.01


def test_it_does_not_depend_on_the_size_of_the_triangles():
    coarse, fine = (measure(shapes.make("wave_large", detail=n)) for n in (5_000, 20_000))
    assert coarse == pytest.approx(fine, rel=0.1)


def test_frequency_of_a_wave_on_a_plane_is_its_own():
    side = np.linspace(0, 1, 120)
    x, z = (a.ravel() for a in np.meshgrid(side, side))
    corner = (np.arange(119)[:, None] * 120 + np.arange(119)).ravel()
    upper = np.stack([corner, corner + 120, corner + 1], axis=1)
    lower = np.stack([corner + 1, corner + 120, corner + 121], axis=1)
    plane = np.stack([x, np.zeros_like(x), z], axis=1)
    wave = np.sin(2 * np.pi * 5 * x)
    found = mesh_frequency(wave, plane, np.concatenate([upper, lower]))
    assert found == pytest.approx(5, rel=0.02)
    assert picture_frequency(wave.reshape(120, 120)) == pytest.approx(5, rel=0.03)


def test_finer_styles_have_higher_frequencies():
    small, large = (measure(shapes.make(n, detail=10_000))[1] for n in ("wave_small", "wave_large"))
    assert small > 1.5 * large
