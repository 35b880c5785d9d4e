"""Edges are flipped where that makes triangles less thin, and all that lies on the mesh stays."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from styleexp.inputs import assets, meshes
from styleexp.inputs.meshes import refining
from styleexp.inputs.meshes.flipping import flipped
from styleexp.inputs.meshes.mesh import Carrier


def strip(uv=None, materials=None):
    """Two flat triangles on a quad, divided along its longer diagonal."""
    points = np.array([[0, 0, 0], [2, 0.5, 0], [4, 0, 0], [2, -0.5, 0]], dtype=float)
    corners = np.array([[0, 2, 1], [0, 3, 2]])
    carrier = Carrier(corners, np.arange(4), np.zeros(2, bool), uv=uv, face_material=materials)
    return points, carrier


def pairs(carrier):
    """The edges as pairs of vertices."""
    faces = carrier.rows[carrier.corners]
    return {tuple(sorted(each)) for each in faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).tolist()}


def test_the_shorter_diagonal_is_taken():
    points, carrier = strip()
    after = flipped(points, carrier, np.inf)
    assert (1, 3) in pairs(after)
    assert (0, 2) not in pairs(after)
    normals = trimesh.Trimesh(points, after.corners, process=False).face_normals
    assert np.allclose(normals, [0, 0, 1])
    assert pairs(flipped(points, after, np.inf)) == pairs(after)


def test_but_not_over_seams_materials_and_creases():
    points, carrier = strip(materials=np.array([0, 1]))
    assert (0, 2) in pairs(flipped(points, carrier, np.inf))
    points, carrier = strip()
    bent = points.copy()
    bent[1, 2] = 0.5
    assert (0, 2) in pairs(flipped(bent, carrier, np.inf))
    # A seam: both faces have rows of their own along the diagonal.
    seam = Carrier(
        np.array([[0, 2, 1], [4, 3, 5]]), np.array([0, 1, 2, 3, 0, 2]), np.zeros(2, bool)
    )
    assert (0, 2) in pairs(flipped(points, seam, np.inf))


def test_faces_that_point_inwards_in_the_file_still_do():
    points, carrier = strip()
    turned = Carrier(carrier.corners[:, ::-1], carrier.rows, np.ones(2, bool))
    after = flipped(points, turned, np.inf)
    assert (1, 3) in pairs(after)
    normals = trimesh.Trimesh(points, after.corners, process=False).face_normals
    assert np.allclose(normals, [0, 0, -1])


def quality(mesh):
    """1 for an equilateral triangle, 0 for none at all."""
    corners = mesh.vertices[mesh.faces]
    lengths = ((corners - np.roll(corners, 1, axis=1)) ** 2).sum(axis=(1, 2))
    return 4 * np.sqrt(3) * meshes.face_areas(mesh.vertices, mesh.faces) / lengths


@pytest.fixture(scope="module")
def long_quads():
    """A cylinder of eight long quads, as in many low-poly limbs."""
    can = trimesh.creation.cylinder(0.5, 4, sections=8, cap=False)
    return meshes.from_arrays(can.vertices, can.faces)


def test_long_quads_are_divided_across_not_into_slivers(long_quads, monkeypatch):
    fine = meshes.refine(long_quads, 0.1)
    monkeypatch.setattr(refining, "NEARLY", 0.0)
    monkeypatch.setattr(refining, "flipped", lambda vertices, carrier, longest: carrier)
    plain = meshes.refine(long_quads, 0.1)
    assert len(fine.faces) < 0.7 * len(plain.faces)
    assert np.median(quality(fine)) > 1.5 * np.median(quality(plain))
    edges = fine.vertices[fine.faces] - np.roll(fine.vertices[fine.faces], 1, axis=1)
    assert np.linalg.norm(edges, axis=2).max() <= 0.1


def test_the_shipped_low_poly_mesh_keeps_its_seams_and_its_surface():
    mesh = meshes.load_mesh(assets.find("critter_low", "mesh"))
    fine = meshes.refine(mesh, 0.05)
    before, after = (
        trimesh.Trimesh(each.vertices, each.faces, process=False) for each in (mesh, fine)
    )
    assert after.is_watertight
    assert after.is_winding_consistent
    assert after.volume == pytest.approx(before.volume, rel=0.05)
    uv = fine.carrier.uv[fine.carrier.corners]
    size = 0.5 * np.abs(np.cross(uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]))
    own = mesh.carrier.uv[mesh.carrier.corners]
    assert size.sum() == pytest.approx(
        0.5 * np.abs(np.cross(own[:, 1] - own[:, 0], own[:, 2] - own[:, 0])).sum(), rel=1e-6
    )


def test_it_is_there_without_any_other_file(monkeypatch, tmp_path):
    monkeypatch.delenv("STYLEEXP_ASSETS", raising=False)
    monkeypatch.setenv("STYLEEXP_CACHE", str(tmp_path))
    path = assets.find("critter_low", "mesh")
    assert assets.sha256(path) == assets.ASSETS["critter_low"].sha256
    carrier = meshes.load_mesh(path).carrier
    assert np.ptp(carrier.uv) > 0.5
    assert carrier.materials[0].baseColorTexture.size == (512, 512)
