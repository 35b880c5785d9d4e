"""Simplified meshes: fewer faces where little is lost, and all that lies on the mesh as it was."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

import styleexp.api
from styleexp.inputs import meshes
from styleexp.inputs.meshes import simplifying
from styleexp.inputs.meshes.mesh import Carrier
from styleexp.runs import exports
from styleexp.runs.bake.detail import Detail


def lathe(rings=160, around=160):
    """A tube with a seam in its texture coordinates, and two materials."""
    u, v = np.meshgrid(np.linspace(0, 1, around + 1), np.linspace(0, 1, rings + 1))
    u, v = u.ravel(), v.ravel()
    angle = 2 * np.pi * (u % 1)
    points = np.stack([np.cos(angle), 4 * v - 2, np.sin(angle)], axis=1)
    at = np.arange(len(u)).reshape(rings + 1, around + 1)
    a, b, c, d = at[:-1, :-1].ravel(), at[:-1, 1:].ravel(), at[1:, 1:].ravel(), at[1:, :-1].ravel()
    corners = np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)])
    weld = np.unique(points.round(9), axis=0, return_inverse=True)[1].ravel()
    vertices = np.zeros((weld.max() + 1, 3))
    vertices[weld] = points
    carrier = Carrier(
        corners,
        weld,
        np.zeros(len(corners), bool),
        uv=np.stack([u, v], axis=1),
        materials=tuple(trimesh.visual.material.PBRMaterial(name) for name in ("wood", "tin")),
        face_material=(v[corners].mean(axis=1) > 0.5).astype(int),
        attributes={"height": v[:, None]},
    )
    return meshes.Mesh("tube", vertices, weld[corners], carrier=carrier)


@pytest.fixture(scope="module")
def moved():
    """A tube with a relief on its lower half."""
    mesh = lathe()
    angle, y = np.arctan2(mesh.vertices[:, 2], mesh.vertices[:, 0]), mesh.vertices[:, 1]
    height = 0.05 * np.sin(8 * angle) * np.sin(9 * y) * (y < 0)
    outward = mesh.vertices * [1, 0, 1]
    return mesh, mesh.vertices + height[:, None] * outward


def test_the_surface_stays_where_it_was_and_flat_parts_lose_most(moved):
    mesh, vertices = moved
    small, kept, error = simplifying.simplified(mesh, vertices, 100, 0.002)
    assert len(small.faces) < 0.25 * len(mesh.faces)
    assert 0 < error <= 0.002
    found = Detail(vertices[kept], small.faces)
    away = found.distances(found.own(vertices)) * found.extent
    assert np.quantile(away, 0.99) < 0.004
    assert away.max() < 0.01  # the estimate isn't a bound
    lower = small.vertices[small.faces][..., 1].mean(axis=1) < 0
    assert lower.mean() > 0.75


def test_no_more_faces_are_taken_off_than_asked(moved):
    mesh, vertices = moved
    small = simplifying.simplified(mesh, vertices, 20_000, 1.0)[0]
    assert 19_000 <= len(small.faces) <= 20_000


def test_seams_materials_and_attributes_stay(moved):
    mesh, vertices = moved
    small, kept, _ = simplifying.simplified(mesh, vertices, 100, 0.002)
    assert np.array_equal(small.vertices, mesh.vertices[kept])
    carrier = small.carrier
    u, v = carrier.uv.T
    # All is where it was: the seam isn't crossed, and no material is on the other's half.
    angle = np.arctan2(*small.vertices[carrier.rows][:, [2, 0]].T)
    away = np.abs((u - angle / (2 * np.pi) + 0.5) % 1 - 0.5)
    assert away.max() < 1e-6
    assert np.ptp(u[carrier.corners], axis=1).max() < 0.5
    assert np.array_equal(carrier.face_material, v[carrier.corners].mean(axis=1) > 0.5)
    assert np.array_equal(carrier.attributes["height"][:, 0], v)
    # Both sides of the seam have the same vertices: no cracks open.
    left, right = (set(carrier.rows[u == side]) for side in (0, 1))
    assert left == right
    before = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    after = trimesh.Trimesh(vertices[kept], small.faces, process=False)
    assert after.euler_number == before.euler_number
    assert after.is_winding_consistent
    outwards = (after.face_normals * after.triangles_center)[:, [0, 2]].sum(axis=1) > 0
    assert after.area_faces[~outwards].sum() < 1e-3 * after.area  # slivers on edge


def test_it_can_be_saved_and_read_again(moved, tmp_path):
    mesh, vertices = moved
    small, kept, _ = simplifying.simplified(mesh, vertices, 100, 0.002)
    for kind in ("obj", "ply", "glb", "stl", "3mf"):
        meshes.save_mesh(small, vertices[kept], tmp_path / f"small.{kind}")
    for kind in ("obj", "ply", "glb"):
        again = meshes.load_mesh(tmp_path / f"small.{kind}")
        assert len(again.faces) == len(small.faces)
        found = again.carrier.uv[again.carrier.corners].sum(axis=1)
        assert np.allclose(np.sort(found, axis=0), np.sort(
            small.carrier.uv[small.carrier.corners].sum(axis=1), axis=0), atol=1e-6)  # fmt: skip


def test_what_is_told():
    assert "no smaller" in exports.told(900, 1000, 900, 0.0, 0.1)
    assert exports.told(1000, 1000, 9000, 0.001, 0.1).endswith("1.0% of the relief")
    assert exports.told(5000, 1000, 9000, 0.005, 0.1).endswith("1,000 would lose more than 5%")


def test_a_run_writes_it_beside_its_result(tmp_path, capsys):
    given = ("sphere", "bubble", "source.refine=none", "baseline.bank=500", "simplify=900")
    result = styleexp.stylize(*given)
    config = styleexp.api.configure(given[0], given[1], list(given[2:]))
    names = exports.write(result, config, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} >= set(names)
    small = meshes.load_mesh(tmp_path / "result_simplified.ply")
    assert len(small.faces) < len(result.faces)
    assert f"to {len(small.faces):,} faces" in capsys.readouterr().out
    whole = {tuple(each) for each in result.vertices.astype(np.float32)}
    assert {tuple(each) for each in small.vertices.astype(np.float32)} < whole


def test_a_flap_is_taken_off_so_that_the_surface_is_closed():
    faces = np.array([[0, 1, 2], [3, 4, 5], [2, 1, 0], [0, 1, 3]])
    assert simplifying._doubled(faces).tolist() == [True, False, True, False]


def test_a_sheet_with_two_sides_keeps_both():
    rows, columns = (each.ravel() for each in np.mgrid[0:20, 0:20])
    points = np.stack([rows, columns, np.zeros(400)], axis=1).astype(float)
    at = np.arange(400).reshape(20, 20)
    a, b, c, d = (each.ravel() for each in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
    front = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    sheet = meshes.from_arrays(points, np.concatenate([front, front[:, ::-1]]))
    small = simplifying.simplified(sheet, sheet.vertices, 100, 0.01)[0]
    assert len(small.faces) > 0
