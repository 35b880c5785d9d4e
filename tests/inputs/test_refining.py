"""Edges are halved where they are too long, and all that lies on the mesh comes along."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from styleexp.config.compose import compose
from styleexp.inputs import meshes
from styleexp.inputs.meshes import refining
from styleexp.system.errors import UserError


def as_trimesh(mesh):
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def test_no_edge_is_longer_and_the_surface_stays_closed():
    ball = trimesh.creation.icosphere(1)
    ball.vertices *= [1, 2, 1]  # edges of many lengths: faces with one, two and three long ones
    mesh = meshes.from_arrays(ball.vertices, ball.faces)
    fine = as_trimesh(meshes.refine(mesh, 0.2))
    assert fine.edges_unique_length.max() <= 0.2
    assert fine.is_watertight
    assert fine.is_winding_consistent
    assert fine.volume > 0
    assert len(fine.faces) > len(mesh.faces)


def test_a_ball_becomes_rounder_and_a_box_stays_a_box():
    ball = trimesh.creation.icosphere(2)
    fine = meshes.refine(meshes.from_arrays(ball.vertices, ball.faces), 0.1)
    off = np.abs(np.linalg.norm(fine.vertices, axis=1) - 1)
    midpoints = ball.vertices[ball.edges_unique].mean(axis=1)
    assert off.max() < 0.25 * np.abs(np.linalg.norm(midpoints, axis=1) - 1).max()
    box = trimesh.creation.box()
    fine = meshes.refine(meshes.from_arrays(box.vertices, box.faces), 0.1)
    assert np.abs(fine.vertices).max() == 0.5
    assert as_trimesh(fine).area == pytest.approx(6)


def test_what_is_fine_enough_comes_back_as_it_is():
    mesh = meshes.from_arrays(np.eye(3), np.array([[0, 1, 2]]))
    assert meshes.refine(mesh, 2.0) is mesh


def test_texture_coordinates_colours_parts_and_seams_are_carried_over(tmp_path):
    """An OBJ with a seam: u goes round a tube from 0 to 1, and two groups with two materials."""
    count, rows = 12, 4
    turn = np.arange(count + 1) / count
    lines = ["mtllib tube.mtl"]
    for z in range(rows):
        lines += [f"v {np.cos(2 * np.pi * u)} {np.sin(2 * np.pi * u)} {z}" for u in turn[:-1]]
    lines += [f"vt {u} {z / rows}" for z in range(rows) for u in turn]
    for z in range(rows - 1):
        lines += [f"o part{z}", f"usemtl m{z % 2}"]
        for k in range(count):
            corners = [(k, z), (k + 1, z), (k + 1, z + 1), (k, z + 1)]
            told = [f"{c % count + r * count + 1}/{c + r * (count + 1) + 1}" for c, r in corners]
            lines.append("f " + " ".join(told))
    (tmp_path / "tube.obj").write_text("\n".join(lines))
    (tmp_path / "tube.mtl").write_text("newmtl m0\nKd 1 0 0\nnewmtl m1\nKd 0 1 0\n")
    mesh = meshes.load_mesh(tmp_path / "tube.obj")
    fine = meshes.refine(mesh, 0.3)
    assert "refined from 72 to" in fine.repairs[-1]
    assert len(fine.vertices) < len(fine.carrier.rows)  # the seam is one still

    for kind in ("obj", "glb", "ply"):
        meshes.save_mesh(fine, fine.vertices, tmp_path / f"fine.{kind}")
    read = trimesh.load(tmp_path / "fine.obj", process=False, force="scene")
    assert {"m0", "m1"} == {g.visual.material.name for g in read.geometry.values()}
    for shape in read.geometry.values():
        u, v = shape.visual.uv.T
        angle = np.arctan2(shape.vertices[:, 1], shape.vertices[:, 0]) / (2 * np.pi) % 1
        apart = np.abs(u - angle)
        # u is linear along each chord, the angle nearly so.
        assert np.minimum(apart, 1 - apart).max() < 0.01
        assert np.abs(v - shape.vertices[:, 2] / rows).max() < 1e-3


def test_what_only_the_files_own_format_holds_is_named(tmp_path):
    ball = trimesh.creation.icosphere(1)
    ball.export(tmp_path / "ball.glb")
    mesh = meshes.load_mesh(tmp_path / "ball.glb")
    assert meshes.refine(mesh, 0.2).repairs[-1].endswith(" faces")
    mesh.carrier.document.tree.update(skins=[{}], cameras=[{}], materials=[{"normalTexture": {}}])
    fine = meshes.refine(mesh, 0.2)
    assert fine.repairs[-1].endswith("without skins, cameras and normal maps")
    ball.face_attributes["quality"] = np.arange(len(ball.faces), dtype=np.float32)
    ball.export(tmp_path / "ball.ply")
    fine = meshes.refine(meshes.load_mesh(tmp_path / "ball.ply"), 0.2)
    assert fine.repairs[-1].endswith("without face properties (quality)")


def test_a_plys_numbers_and_vectors_are_carried_over_and_saved(tmp_path):
    ball = trimesh.creation.icosphere(1)
    ball.vertex_attributes["quality"] = ball.vertices[:, 1].astype(np.float32)
    ball.vertex_attributes["way"] = ball.vertices.astype(np.float32)
    ball.export(tmp_path / "ball.ply")
    mesh = meshes.load_mesh(tmp_path / "ball.ply")
    fine = meshes.refine(mesh, 0.2)
    assert not fine.repairs[-1].endswith(")")
    for end in (".ply", ".glb"):
        meshes.save_mesh(fine, fine.vertices, tmp_path / f"fine{end}")
        read = meshes.load_mesh(tmp_path / f"fine{end}").carrier.attributes
        number, vector = sorted(read.values(), key=lambda values: values.shape[1])
        assert {name.lower() for name in read} == {"quality", "way"}
        assert number.shape == (len(fine.vertices), 1)
        assert np.abs(number[:, 0] - vector[:, 1]).max() < 1e-6  # both are linear along edges


def test_too_many_faces_are_refused(monkeypatch):
    monkeypatch.setattr(refining, "MOST_FACES", 1000)
    ball = trimesh.creation.icosphere(2)
    mesh = meshes.from_arrays(ball.vertices, ball.faces)
    with pytest.raises(UserError, match="would need more than 1,000 faces"):
        meshes.refine(mesh, 0.05)


@pytest.mark.slow
def test_a_run_refines_for_its_style_and_says_so():
    from styleexp.config.build import subject_of
    from styleexp.method import refinement

    sized = ["source=sphere", "style=scales", "style.scale=2"]
    plain = subject_of(compose([*sized, "source.refine=none"]))
    fine = subject_of(compose(sized))
    assert len(fine.source.faces) > len(plain.source.faces)
    longest = as_trimesh(fine.source).edges_unique_length.max() / fine.frame.scale
    assert longest <= 1 / fine.sigma / refinement.EDGES_PER_WAVELENGTH * (1 + 1e-9)
    assert any("refined from" in note for note in fine.notes)
    assert not any("is too coarse" in note for note in fine.notes)


@pytest.mark.slow
def test_a_run_refines_to_a_number_of_faces():
    from styleexp.config.build import prepare, subject_of

    wanted = 60_000
    fine = subject_of(compose(["source=sphere", "style=scales", f"source.refine={wanted}"]))
    assert 0.7 * wanted < len(fine.source.faces) < 1.4 * wanted
    with pytest.raises(UserError, match=r"source\.refine=many is not allowed: give auto, none or"):
        prepare(compose(["source=sphere", "style=scales", "source.refine=many"]))
