"""The relief of any style mesh: what is shape, what is relief, what is neither."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

import styleexp
from styleexp.inputs import meshes, shapes
from styleexp.method.synthesis.exemplar import measure
from styleexp.method.synthesis.shape import exemplar_of
from styleexp.system.errors import UserError

CHEAP = ("method=synthesis", "metrics.judge=none", "baseline.bank=2000")


def ranged(exemplar):
    return float(np.ptp(np.percentile(exemplar.height[exemplar.usual], [1, 99])))


def test_a_bend_is_no_relief_and_bumps_on_it_are():
    ring = shapes.make("torus", 12_000)
    assert exemplar_of(ring) is None
    angle = np.arctan2(ring.vertices[:, 0], ring.vertices[:, 2])
    bumps = 0.01 * np.sin(40 * angle) * np.sin(60 * ring.vertices[:, 1])
    normals = meshes.vertex_normals(ring.vertices, ring.faces)
    bumpy = meshes.Mesh("bumpy", ring.vertices + bumps[:, None] * normals, ring.faces)
    found = exemplar_of(bumpy)
    assert np.corrcoef(found.height, bumps)[0, 1] > 0.8


def test_an_inner_side_changes_nothing():
    scales, inner = shapes.make("scales", 20_000), trimesh.creation.icosphere(3, radius=0.8)
    faces = np.concatenate([scales.faces, inner.faces[:, ::-1] + len(scales.vertices)])
    hollow = meshes.Mesh("hollow", np.concatenate([scales.vertices, inner.vertices]), faces)
    one, other = exemplar_of(scales), exemplar_of(hollow)
    assert np.corrcoef(one.height, other.height)[0, 1] > 0.999


def test_a_lattice_is_struts_over_closed_holes():
    exemplar = exemplar_of(shapes.make("lattice", 8000))
    normalised = np.linalg.norm(exemplar.sheet.vertices, axis=1)
    assert normalised.min() > 0.7  # the shape is a ball, and not the struts
    assert 0.05 < ranged(exemplar) < 0.2


def test_a_terrain_has_a_relief_and_its_north_is_up():
    exemplar = exemplar_of(shapes.make("terrain", 6000))
    assert exemplar.up == (0.0, 0.0, -1.0)
    pattern = measure(exemplar, np.random.default_rng(0))
    assert 0.1 < pattern.wavelength < 0.5
    assert pattern.high - pattern.low > 0.05


def test_a_flat_base_is_left_out():
    """A tile of bumps, closed by walls and a flat underside."""
    box = trimesh.creation.box([2, 0.4, 2])
    for _ in range(6):
        box = box.subdivide()
    x, y, z = box.vertices.T
    bumps = 0.04 * np.sin(12 * x) * np.sin(12 * z) * (y > 0.199)
    tile = meshes.Mesh("tile", box.vertices + np.stack([0 * x, bumps, 0 * x], 1), box.faces)
    exemplar = exemplar_of(tile)
    inner = np.abs(box.vertices[:, [0, 2]]).max(axis=1) < 0.7
    assert exemplar.usual[inner & (y > 0.199)].mean() > 0.9
    assert exemplar.usual[inner & (y < -0.199)].mean() < 0.1


def test_the_length_that_parts_them_can_be_given():
    waves = shapes.make("wave_large", 6000)
    assert ranged(exemplar_of(waves, 0.1)) < 0.5 * ranged(exemplar_of(waves))


@pytest.mark.parametrize("refine", ["none", "auto"])
def test_a_smooth_style_is_noted_and_gives_the_source_back(refine):
    with pytest.warns(UserWarning, match="'sphere' has no relief, its surface"):
        result = styleexp.stylize("critter", "sphere", *CHEAP, f"source.refine={refine}")
    np.testing.assert_array_equal(result.vertices, shapes.make("critter").vertices)


def test_a_relief_length_is_of_style_meshes():
    with pytest.raises(UserError, match="the style is a picture"):
        styleexp.stylize("torus", np.random.default_rng(0).random((32, 32, 3)), *CHEAP,
                         "style.relief_length=0.3")  # fmt: skip
    with pytest.raises(UserError, match="needs method=synthesis"):
        styleexp.stylize("torus", "bubble", "method=displacement_map", "style.relief_length=0.3")
