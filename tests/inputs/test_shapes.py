"""The analytic shapes: sound meshes, and reliefs that are what they claim to be."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from styleexp.inputs import meshes, shapes
from styleexp.inputs.meshes.remeshing import unfit
from styleexp.system.errors import UserError


@pytest.fixture(scope="module", params=shapes.names())
def shape(request):
    return shapes.make(request.param)


def test_names_are_the_registries():
    assert shapes.names() == [*shapes.STYLES, *shapes.SOURCES]
    assert all(shapes.STYLES.values())
    assert set(shapes.STYLES) == {*shapes.RELIEFS, *shapes._MADE}
    assert not set(shapes.RELIEFS) & set(shapes._MADE)


HANDLES = {"torus": 1, "lattice": 31}
BALLS = {"wool": 81}


def test_manifold_outward_and_closed_with_the_right_handles(shape):
    faces, count = shape.faces, len(shape.vertices)
    assert shape.name in shapes.names()
    assert shape.vertices.dtype == np.float64
    assert faces.dtype == np.int64
    assert np.isfinite(shape.vertices).all()
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    forward = edges[:, 0] * count + edges[:, 1]
    backward = edges[:, 1] * count + edges[:, 0]
    assert len(np.unique(forward)) == len(forward)  # each edge once a direction: coherent ...
    np.testing.assert_array_equal(np.unique(faces), np.arange(count))
    assert unfit(shape.vertices, faces) is None
    if shape.name == "terrain":
        assert len(np.setdiff1d(forward, backward)) == 4 * (np.sqrt(count) - 1)  # one border
        assert (meshes.vertex_normals(shape.vertices, faces)[:, 1] > 0).all()
        return
    np.testing.assert_array_equal(np.sort(forward), np.sort(backward))  # ... and closed
    euler = count - len(edges) // 2 + len(faces)
    assert euler == 2 * BALLS.get(shape.name, 1) - 2 * HANDLES.get(shape.name, 0)
    a, b, c = (shape.vertices[faces[:, k]] for k in range(3))
    assert np.einsum("ij,ij->", a, np.cross(b, c)) > 0


def test_triangles_are_dense_and_even(shape):
    low, high = (35_000, 45_000) if shape.name in shapes.STYLES else (10_000, 40_000)
    assert low < len(shape.vertices) < high
    corners = shape.vertices[shape.faces]
    if shape.name in shapes.RELIEFS:  # steep flanks stretch triangles: judge them on the sphere
        corners = corners / np.linalg.norm(corners, axis=2, keepdims=True)
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    quality = 2 * area / (np.sqrt(3) * longest**2)  # 1 for an equilateral triangle
    assert np.median(quality) > (0.5 if shape.name == "terrain" else 0.7)  # halves of squares
    # Steep walls again; and the ball inside the wool, which nobody sees, is as dense as a tuft.
    uneven = shape.name in ("knit", "weave", "terrain", "wool")
    assert area.max() < (15 if uneven else 3) * area.mean()


def test_made_again_it_is_the_same_even_in_another_process(shape):
    again = shapes.make(shape.name)
    np.testing.assert_array_equal(again.vertices, shape.vertices)
    np.testing.assert_array_equal(again.faces, shape.faces)


@pytest.mark.slow
def test_critter_is_the_same_in_another_process():
    code = (
        "import hashlib; from styleexp.inputs import shapes; m = shapes.make('critter', 3000);"
        "print(hashlib.sha256(m.vertices.tobytes() + m.faces.tobytes()).hexdigest())"
    )
    runs = {subprocess.check_output([sys.executable, "-c", code]) for _ in range(2)}
    assert len(runs) == 1


def test_a_changed_copy_does_not_change_the_next_one():
    for name in ("critter", "sphere"):
        first = shapes.make(name, 2000)
        kept = first.vertices.copy()
        first.vertices[:] = 0
        np.testing.assert_array_equal(shapes.make(name, 2000).vertices, kept)


@pytest.mark.parametrize("name", shapes.RELIEFS)
def test_relief_is_the_height_of_the_mesh(name):
    mesh = shapes.make(name, detail=2_500)
    radius = np.linalg.norm(mesh.vertices, axis=1)
    np.testing.assert_allclose(1 + shapes.relief(name, mesh.vertices), radius, atol=1e-9)
    # Only the direction counts, also for many points and for none.
    np.testing.assert_allclose(
        shapes.relief(name, 3 * mesh.vertices), shapes.relief(name, mesh.vertices), atol=1e-9
    )
    assert shapes.relief(name, np.zeros((0, 3))).shape == (0,)


@pytest.mark.parametrize("name", shapes.RELIEFS)
def test_relief_is_visible_and_moderate(name):
    directions, _ = shapes.icosphere(10_000)
    height = shapes.relief(name, directions)
    low, high = np.percentile(height, [1, 99])
    assert 0.025 < high - low < 0.14
    assert abs(np.median(height)) < 0.09
    # No style is a copy of another: their heights are uncorrelated.
    for other in shapes.RELIEFS:
        if other != name:
            assert abs(np.corrcoef(height, shapes.relief(other, directions))[0, 1]) < 0.5


def test_stripes_depend_on_latitude_only():
    angle = np.linspace(0, 2 * np.pi, 50)
    for y in (-0.7, 0.1, 0.95):
        ring = np.stack([np.cos(angle), np.full(50, y / np.sqrt(1 - y * y)), np.sin(angle)], 1)
        assert np.ptp(shapes.relief("stripe", ring)) < 1e-9


def test_large_waves_are_longer_than_small_ones():
    angle = np.linspace(0, 2 * np.pi, 4000)
    circle = np.stack([np.cos(angle), 0.2 * np.sin(angle), np.sin(angle)], 1)
    crossings = {
        name: (np.diff(np.sign(shapes.relief(name, circle))) != 0).sum()
        for name in ("wave_small", "wave_large")
    }
    assert crossings["wave_small"] > 1.5 * crossings["wave_large"] > 0


def test_buckyball_has_twelve_pentagons_and_twenty_hexagons():
    planes = shapes._truncated_icosahedron()
    distance = 1 / np.linalg.norm(planes, axis=1)
    assert (np.isclose(distance, distance.max())).sum() == 12
    assert (np.isclose(distance, distance.min())).sum() == 20


def test_unknown_names_are_explained():
    with pytest.raises(UserError, match="did you mean 'stripe'"):
        shapes.make("stripes")
    with pytest.raises(UserError, match="unknown style on a sphere 'wool'"):
        shapes.relief("wool", np.ones((1, 3)))
