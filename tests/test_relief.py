import numpy as np
import pytest

from styleexp import meshes, shapes
from styleexp.relief import relief_height


def height_of(mesh):
    vertices = meshes.normalisation(mesh.vertices).apply(mesh.vertices)
    normals = meshes.vertex_normals(vertices, mesh.faces)
    return relief_height(vertices, mesh.faces, normals, length=0.5)


@pytest.mark.parametrize("name", list(shapes.STYLES))
def test_relief_of_the_analytic_styles_is_near_their_formula(name):
    mesh = shapes.make(name, detail=10_000)
    relief = shapes.relief(name, mesh.vertices / np.linalg.norm(mesh.vertices, axis=1)[:, None])
    assert height_of(mesh) == pytest.approx(np.ptp(relief) / 2, rel=0.4)


def test_a_sphere_has_next_to_none():
    assert height_of(shapes.make("sphere", detail=10_000)) < 0.01


def test_it_does_not_depend_on_the_size_of_the_triangles():
    coarse, fine = (height_of(shapes.make("wave_large", detail=n)) for n in (5_000, 20_000))
    assert coarse == pytest.approx(fine, rel=0.1)
