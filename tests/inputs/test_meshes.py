"""Real files in, real files out: what must survive, and one sentence for what cannot."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from styleexp.inputs import meshes
from styleexp.inputs.meshes.obj import triangulate
from styleexp.inputs.meshes.reading import READABLE
from styleexp.system.errors import UserError

pytestmark = pytest.mark.usefixtures("valid_glbs")

CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
# Outward quads over CUBE.
QUADS = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]


def triangles(quads=QUADS):
    return np.array([t for a, b, c, d in quads for t in ([a, b, c], [a, c, d])])


def volume(vertices, faces):
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.einsum("ij,ij->", a, np.cross(b, c)) / 6


def crosses(vertices, faces):
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def png(color) -> bytes:
    out = io.BytesIO()
    Image.new("RGB", (4, 4), color).save(out, "PNG")
    return out.getvalue()


def obj_text(vertices, faces) -> str:
    lines = [f"v {x} {y} {z}" for x, y, z in vertices]
    return "\n".join(lines + ["f " + " ".join(str(i + 1) for i in f) for f in faces]) + "\n"


def same_surface(a, b, atol=1e-6):
    np.testing.assert_allclose(a.vertices[a.faces], b.vertices[b.faces], atol=atol)


@pytest.fixture
def textured(tmp_path) -> Path:
    """A cube with quads, three parts, interleaved materials, two textures and uv seams."""
    (tmp_path / "wood grain.png").write_bytes(png("brown"))
    (tmp_path / "bump.png").write_bytes(png("grey"))
    (tmp_path / "cube.mtl").write_text(
        "newmtl wood\nKd 1 1 1\nKs 0.5 0.5 0.5\nNs 17\nmap_Kd -s 1 1 1 wood grain.png\n"
        "map_Bump -bm 0.5 bump.png\n\nnewmtl red paint\nKd 1 0 0\nd 0.5\n"
    )
    lines = ["mtllib cube.mtl", *(f"v {x} {y} {z}" for x, y, z in CUBE + 5)]
    lines += ["vt 0 0", "vt 1 0", "vt 1 1", "vt 0 0.25"]
    for k, quad in enumerate(QUADS):
        if k % 2 == 0:
            lines.append(f"o part {k // 2}")
        lines.append(f"usemtl {('wood', 'red paint')[k % 2]}")
        lines.append("f " + " ".join(f"{v + 1}/{t + 1}" for t, v in enumerate(quad)))
    path = tmp_path / "cube.obj"
    path.write_text("\n".join(lines))
    return path


def corner_uv(mesh):
    return mesh.carrier.uv[mesh.carrier.corners]


def material_names(mesh):
    materials = mesh.carrier.materials
    return [materials[k].name if k >= 0 else None for k in mesh.carrier.face_material]


def part_names(mesh):
    return [mesh.carrier.parts[k] for k in mesh.carrier.face_part]


# ------------------------------------------------------------------------------------------- basics


def test_import_is_cheap():
    code = (
        "import sys, styleexp.inputs.meshes;"
        "assert not {'torch', 'trimesh', 'scipy', 'gpytoolbox'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_normalisation_and_back():
    rng = np.random.default_rng(0)
    vertices = rng.normal(size=(50, 3)) * 3 + 100
    frame = meshes.normalisation(vertices)
    unit = frame.apply(vertices)
    np.testing.assert_allclose(unit.mean(axis=0), 0, atol=1e-12)
    assert np.linalg.norm(unit, axis=1).max() == pytest.approx(1)
    np.testing.assert_allclose(frame.invert(unit), vertices)
    with pytest.raises(UserError, match="no extent"):
        meshes.normalisation(np.ones((4, 3)))


def test_vertex_normals_are_area_weighted_and_always_finite():
    # A flat square of unequal triangles, one without area, and a vertex that no face uses.
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [5, 5, 5]], dtype=float)
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 0, 1]])
    normals = meshes.vertex_normals(vertices, faces)
    np.testing.assert_allclose(normals[:4], [[0, 0, 1]] * 4)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
    np.testing.assert_allclose(meshes.face_areas(vertices, faces), [0.5, 0.5, 0])
    for scale in (1e-30, 1e30):
        np.testing.assert_allclose(meshes.vertex_normals(vertices * scale, faces), normals)
    assert meshes.mean_edge_length(vertices, faces[:2]) == pytest.approx((4 + np.sqrt(2)) / 5)


# ------------------------------------------------------------------------------------------ formats


@pytest.mark.parametrize("extension", ["obj", "ply", "stl", "off", "glb", "gltf"])
def test_reads_what_trimesh_writes(tmp_path, extension):
    shape = trimesh.creation.icosphere(subdivisions=2)
    path = tmp_path / f"ein Kügelchen 球.{extension}"
    shape.export(path)
    mesh = meshes.load_mesh(path)
    assert mesh.name == "ein Kügelchen 球"
    assert mesh.vertices.dtype == np.float64
    assert mesh.faces.dtype == np.int64
    assert len(mesh.vertices) == len(shape.vertices)
    np.testing.assert_allclose(mesh.vertices[mesh.faces], shape.vertices[shape.faces], atol=1e-6)
    assert mesh.repairs == ()


@pytest.mark.parametrize("extension", ["ply", "obj", "glb"])
def test_trimesh_reads_what_is_written(tmp_path, extension):
    shape = trimesh.creation.icosphere(subdivisions=2)
    mesh = meshes.Mesh("ball", np.array(shape.vertices), np.array(shape.faces, dtype=np.int64))
    path = tmp_path / "new folder" / f"out.{extension}"
    meshes.save_mesh(mesh, mesh.vertices * 2, path)
    back = trimesh.load(path, process=False, force="mesh")
    np.testing.assert_allclose(back.vertices[back.faces], 2 * mesh.vertices[mesh.faces], atol=1e-6)
    assert os.listdir(path.parent) == [path.name]  # no temporary file is left


@pytest.mark.parametrize("ending", ["\n", "\r\n", "\r"])
def test_obj_line_ends_relative_indices_and_polygons(tmp_path, ending):
    hexagon = [(np.cos(a), np.sin(a), 3) for a in np.arange(6) * np.pi / 3]
    lines = ["# comment", *(f"v {x} {y} {z}" for x, y, z in CUBE), "f -8 -7 -5 -6", "f 5 7 8 \\"]
    lines += ["6", *(f"v {x} {y} {z}" for x, y, z in hexagon), "f -6 -5 -4 -3 -2 -1"]
    lines += ["f 1 3 5 # a triangle after the others", "f 1 2"]
    path = tmp_path / "a.obj"
    path.write_bytes(ending.join(lines).encode())
    mesh = meshes.load_mesh(path)
    assert len(mesh.faces) == 2 + 2 + 4 + 1
    assert "triangulated 3 quads and larger polygons" in mesh.repairs
    assert "left out 1 face with fewer than three corners" in mesh.repairs
    np.testing.assert_allclose(mesh.vertices[mesh.faces[0]], CUBE[[0, 1, 3]])
    np.testing.assert_allclose(mesh.vertices[mesh.faces[-1]], CUBE[[0, 2, 4]])
    area = meshes.face_areas(mesh.vertices, mesh.faces[4:8]).sum()
    assert area == pytest.approx(1.5 * np.sqrt(3))


def test_concave_quad_is_cut_inside():
    points = np.array([[0, 0, 0], [2, -1, 0], [0.5, 0, 0], [2, 1, 0]], dtype=float)
    for turn in range(4):
        turned = np.roll(points, turn, axis=0)
        faces, _ = triangulate(np.array([4]), turned, [])
        assert (crosses(turned, faces)[:, 2] > 0).all()


def glb_attribute(path, name, mesh=0):
    """A vertex attribute of floats, read from the file's bytes without trimesh."""
    content = path.read_bytes()
    (length,) = struct.unpack("<I", content[12:16])
    tree, binary = json.loads(content[20 : 20 + length]), content[28 + length :]
    (primitive,) = tree["meshes"][mesh]["primitives"]
    accessor = tree["accessors"][primitive["attributes"][name]]
    assert (accessor["componentType"], accessor["type"]) == (5126, "SCALAR")
    view = tree["bufferViews"][accessor["bufferView"]]
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    return np.frombuffer(binary, np.float32, accessor["count"], start)


def ply(kind: str, size: int = 3) -> bytes:
    """A strip of triangles or quads, with colours."""
    vertices = [(x, y, 0) for x in range(4) for y in range(2)]
    faces = [(0, 2, 1), (1, 2, 3), (2, 4, 3)]
    if size == 4:
        faces = [(0, 2, 3, 1), (2, 4, 5, 3), (4, 6, 7, 5)]
    head = (
        f"ply\nformat {kind} 1.0\ncomment made by hand\nelement vertex 8\nproperty float x\n"
        "property double y\nproperty float z\nproperty uchar red\nproperty uchar green\n"
        "property uchar blue\nelement face 3\nproperty uchar flag\n"
        "property list uchar int vertex_indices\nend_header\n"
    ).encode()
    if kind == "ascii":
        body = "".join(f"{x} {y} {z} {10 * k} 0 255\n" for k, (x, y, z) in enumerate(vertices))
        body += "".join(f"1 {len(f)} {' '.join(map(str, f))}\n" for f in faces)
        return head + body.encode()
    order = "<" if "little" in kind else ">"
    body = b"".join(
        struct.pack(f"{order}fdfBBB", x, y, z, 10 * k, 0, 255)
        for k, (x, y, z) in enumerate(vertices)
    )
    return head + body + b"".join(struct.pack(f"{order}BB{len(f)}i", 1, len(f), *f) for f in faces)


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("size", [3, 4])
def test_ply_keeps_order_and_colours(tmp_path, kind, size):
    path = tmp_path / "a.ply"
    path.write_bytes(ply(kind, size))
    mesh = meshes.load_mesh(path)
    expected = [[0, 2, 1], [1, 2, 3], [2, 4, 3]]
    if size == 4:
        expected = [[0, 2, 3], [3, 1, 0], [2, 4, 5], [5, 3, 2], [4, 6, 7], [7, 5, 4]]
    assert mesh.faces.tolist() == expected
    red = mesh.carrier.colors[mesh.carrier.corners][..., 0]
    np.testing.assert_array_equal(red, 10 * mesh.faces)
    for extension in ("ply", "obj", "glb"):
        out = tmp_path / f"out.{extension}"
        values = np.arange(float(len(mesh.vertices)))
        meshes.save_mesh(mesh, mesh.vertices + 1, out, displacement=values)
        back = meshes.load_mesh(out)
        assert back.faces.tolist() == mesh.faces.tolist()
        np.testing.assert_array_equal(back.carrier.colors[back.carrier.corners][..., 0], red)
    assert glb_attribute(tmp_path / "out.glb", "_DISPLACEMENT").tolist() == values.tolist()
    raw = trimesh.load(tmp_path / "out.ply", process=False).metadata["_ply_raw"]["vertex"]["data"]
    assert raw["displacement"].dtype == np.float32
    np.testing.assert_array_equal(raw["displacement"], values)


def test_off_with_comments_and_mixed_polygons(tmp_path):
    path = tmp_path / "a.off"
    lines = "OFF # cube\n\n8 6 0\n" + "\n".join(f"{x} {y} {z}" for x, y, z in CUBE)
    path.write_text(lines + "".join("\n4 " + " ".join(map(str, quad)) for quad in QUADS))
    mesh = meshes.load_mesh(path)
    quads = np.array(QUADS)
    expected = np.stack([quads[:, [0, 1, 2]], quads[:, [2, 3, 0]]], axis=1).reshape(-1, 3)
    np.testing.assert_array_equal(mesh.faces, expected)
    path.write_text(lines.replace("8 6", "8 3") + "\n4 0 1 3 2\n3 4 6 7\n4 0 4 5 1 255 0 0\n")
    assert len(meshes.load_mesh(path).faces) == 5


# -------------------------------------------------------------------------------- seams, materials


def test_obj_to_obj_keeps_everything(textured, tmp_path):
    mesh = meshes.load_mesh(textured)
    assert len(mesh.vertices) == 8  # welded across the seams
    np.testing.assert_allclose(mesh.vertices[mesh.faces], (CUBE + 5)[triangles()])
    out = tmp_path / "results" / "my cube.obj"
    meshes.save_mesh(mesh, mesh.vertices * 2, out)
    back = meshes.load_mesh(out)
    np.testing.assert_array_equal(back.faces, mesh.faces)
    np.testing.assert_allclose(back.vertices, mesh.vertices * 2)
    np.testing.assert_allclose(corner_uv(back), corner_uv(mesh))
    assert material_names(back) == ["wood"] * 2 + ["red paint"] * 2 + material_names(back)[4:]
    assert material_names(back) == material_names(mesh)  # interleaved, in order
    assert part_names(back) == part_names(mesh)
    assert {p.name for p in out.parent.iterdir()} == {
        "my cube.obj", "my cube.mtl", "my cube_wood grain.png", "my cube_bump.png",
    }  # fmt: skip
    mtl = (out.parent / "my cube.mtl").read_text()
    assert "map_Kd -s 1 1 1 my cube_wood grain.png" in mtl
    assert "map_Bump -bm 0.5 my cube_bump.png" in mtl
    assert "Ns 17" in mtl
    copied = (out.parent / "my cube_wood grain.png").read_bytes()
    assert copied == (textured.parent / "wood grain.png").read_bytes()


def test_saving_beside_the_input_leaves_its_files_alone(textured):
    before = {p: p.read_bytes() for p in textured.parent.iterdir()}
    mesh = meshes.load_mesh(textured)
    for name in ("cube_styled.obj", "cube_styled.ply", "cube_styled.glb"):
        meshes.save_mesh(mesh, mesh.vertices + 1, textured.with_name(name))
    assert all(path.read_bytes() == content for path, content in before.items())


def test_obj_to_glb_keeps_uv_textures_materials_names(textured, tmp_path):
    mesh = meshes.load_mesh(textured)
    out = tmp_path / "out.glb"
    meshes.save_mesh(mesh, mesh.vertices + 1, out)
    back = meshes.load_mesh(out)

    # glTF cannot interleave materials, so faces are grouped within each part: compare as sets.
    def key(m, shift):
        return sorted(
            (part, material, np.round(tri - shift, 5).tolist(), np.round(uv, 5).tolist())
            for part, material, tri, uv in zip(
                part_names(m), material_names(m), m.vertices[m.faces], corner_uv(m), strict=True
            )
        )

    assert key(back, 1) == key(mesh, 0)
    wood = next(m for m in back.carrier.materials if m.name == "wood")
    with Image.open(textured.parent / "wood grain.png") as image:
        np.testing.assert_array_equal(wood.baseColorTexture, image)
    red = next(m for m in back.carrier.materials if m.name == "red paint")
    assert red.baseColorFactor.tolist() == [255, 0, 0, 128]
    assert (red.alphaMode, red.metallicFactor) == ("BLEND", 0.0)
    scene = trimesh.load(out)  # and another reader agrees
    assert {"part 0", "part 1", "part 2"} <= set(scene.graph.nodes)


def test_ply_carries_uv_with_its_seams(tmp_path):
    (tmp_path / "t.png").write_bytes(png("blue"))
    (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd t.png\n")
    corners = ["f 1/1 2/2 3/3", "f 1/3 3/2 4/1"]
    vertices = ["v 0 0 0", "v 1 0 0", "v 1 1 0", "v 0 1 0"]
    (tmp_path / "a.obj").write_text(
        "\n".join(["mtllib a.mtl", *vertices, "vt 0 0", "vt 1 0", "vt 1 1", "usemtl m", *corners])
    )
    mesh = meshes.load_mesh(tmp_path / "a.obj")
    meshes.save_mesh(mesh, mesh.vertices, tmp_path / "b.ply", displacement=np.zeros(4))
    back = meshes.load_mesh(tmp_path / "b.ply")
    same_surface(back, mesh)
    assert len(back.vertices) == 4
    np.testing.assert_allclose(corner_uv(back), corner_uv(mesh))


def test_missing_material_files_are_reported_not_fatal(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text("mtllib gone.mtl\nusemtl m\n" + obj_text(CUBE, QUADS))
    assert any("gone.mtl" in note for note in meshes.load_mesh(path).repairs)
    (tmp_path / "gone.mtl").write_text("newmtl m\nmap_Kd C:\\art\\gone.png\n")
    assert any("gone.png" in note for note in meshes.load_mesh(path).repairs)
    (tmp_path / "gone.png").write_bytes(png("red"))  # found by its bare name
    assert meshes.load_mesh(path).repairs == ("triangulated 6 quads and larger polygons",)


def test_hard_edges_of_glb_survive_and_seams_stay_smooth(tmp_path):
    box = trimesh.creation.box()
    box.unmerge_vertices()
    box.vertex_normals = np.repeat(box.face_normals, 3, axis=0)
    trimesh.Scene(box).export(tmp_path / "box.glb", include_normals=True)
    ball = trimesh.creation.icosphere(subdivisions=2)
    normals = ball.vertex_normals[ball.faces]
    ball.unmerge_vertices()
    ball.vertex_normals = normals.reshape(-1, 3)
    trimesh.Scene(ball).export(tmp_path / "ball.glb", include_normals=True)
    for name, rows in (("box", 24), ("ball", 162)):
        mesh = meshes.load_mesh(tmp_path / f"{name}.glb")
        meshes.save_mesh(mesh, mesh.vertices * [1, 2, 3], tmp_path / "out.glb")
        carrier = meshes.load_mesh(tmp_path / "out.glb").carrier
        assert len(carrier.rows) == mesh.faces.size
        key = np.column_stack([carrier.rows, carrier.normals.round(4)])
        assert len(np.unique(key, axis=0)) == rows


def corner_normals(path):
    """What another reader finds: a normal for each corner of an OBJ or PLY file, (faces, 3, 3)."""
    if path.suffix == ".ply":
        read = trimesh.load(path, process=False)
        return read.vertex_normals[read.faces]
    lines = [line.split() for line in path.read_text().splitlines()]
    normals = np.array([line[1:] for line in lines if line[0] == "vn"], float)
    words = [[word.split("/") for word in line[1:]] for line in lines if line[0] == "f"]
    return normals[np.array(words)[..., 2].astype(int) - 1]


@pytest.mark.parametrize("kind", ["obj", "ply"])
@pytest.mark.parametrize("seam", [False, True])
def test_files_without_hard_edges_get_smooth_normals(tmp_path, kind, seam):
    ball = trimesh.creation.uv_sphere()
    lines = [f"v {x} {y} {z}" for x, y, z in ball.vertices]
    lines += [f"vt {x} {y}" for x, y, _ in ball.vertices] + ["vt 9 9"] if seam else []
    corner = "{0}/{0}" if seam else "{0}"
    lines += ["f " + " ".join(map(corner.format, face)) for face in (ball.faces + 1).tolist()]
    if seam:  # the last face's corners have texture coordinates of their own
        lines[-1] = re.sub(r"/\d+", f"/{len(ball.vertices) + 1}", lines[-1])
    (tmp_path / "ball.obj").write_text("\n".join(lines) + "\n")
    mesh, path = meshes.load_mesh(tmp_path / "ball.obj"), tmp_path / f"out.{kind}"
    stretched = mesh.vertices * [1, 1, 3]
    meshes.save_mesh(mesh, stretched, path)
    back = trimesh.load(path, process=False)
    assert len(back.faces) == len(mesh.faces)
    assert len(meshes.load_mesh(path).vertices) == len(mesh.vertices)
    own = meshes.vertex_normals(stretched, mesh.faces)[mesh.faces]
    np.testing.assert_allclose(corner_normals(path), own, atol=1e-4)
    # And what they are to be: the stretched sphere's.
    exact = mesh.vertices / [1, 1, 3]
    exact /= np.linalg.norm(exact, axis=1, keepdims=True)
    assert (corner_normals(path) * exact[mesh.faces]).sum(-1).min() > 0.98


def test_hard_edges_stay_hard_in_obj_and_ply(tmp_path):
    box = trimesh.creation.box()
    box.unmerge_vertices()
    box.vertex_normals = flat = np.repeat(box.face_normals, 3, axis=0)
    trimesh.Scene(box).export(tmp_path / "box.glb", include_normals=True)
    box.export(tmp_path / "box.ply", vertex_normal=True)
    for name in ("box.glb", "box.ply"):
        mesh = meshes.load_mesh(tmp_path / name)
        meshes.save_mesh(mesh, mesh.vertices * 2, tmp_path / "out.obj")
        np.testing.assert_allclose(corner_normals(tmp_path / "out.obj"), flat.reshape(-1, 3, 3))
        meshes.save_mesh(mesh, mesh.vertices * 2, tmp_path / "out.ply")
        if name == "box.ply":
            np.testing.assert_allclose(corner_normals(tmp_path / "out.ply"), flat.reshape(-1, 3, 3))
        else:  # the rows of a glTF's faces are joined, and have no room for them
            assert b"property float nx" not in (tmp_path / "out.ply").read_bytes()
    # Smoothing groups are the file's own way of saying it.
    lines = [f"v {x} {y} {z}" for x, y, z in box.vertices.tolist()]
    lines += [f"s {k}\nf {3 * k + 1} {3 * k + 2} {3 * k + 3}" for k in range(len(box.faces))]
    (tmp_path / "box.obj").write_text("\n".join(lines) + "\n")
    mesh = meshes.load_mesh(tmp_path / "box.obj")
    meshes.save_mesh(mesh, mesh.vertices * 2, tmp_path / "out.obj")
    words = (tmp_path / "out.obj").read_text().split()
    assert "vn" not in words
    assert words.count("s") == 12


# --------------------------------------------------------------------------------------------- glTF


@pytest.fixture
def scene(tmp_path) -> Path:
    """Two nodes show one ball, a third a textured cube, the last a mirrored one with colours."""
    ball = trimesh.creation.icosphere(subdivisions=1)
    cube = trimesh.creation.box()
    cube.unmerge_vertices()
    uv = np.random.default_rng(0).random((len(cube.vertices), 2))
    image = Image.open(io.BytesIO(png("green")))
    material = trimesh.visual.material.PBRMaterial(
        name="leaf", baseColorTexture=image, roughnessFactor=0.3, metallicFactor=0.7
    )
    cube.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    cone = trimesh.creation.cone(1, 2, sections=8)
    cone.visual = trimesh.visual.ColorVisuals(
        cone, vertex_colors=[[9, 99, 199, 255]] * len(cone.vertices)
    )
    result = trimesh.Scene()
    move = trimesh.transformations.translation_matrix
    turn = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])
    result.add_geometry(ball, node_name="left", geom_name="ball", transform=move([-3, 0, 0]))
    result.graph.update("right", geometry="ball", matrix=move([3, 0, 0]) @ np.diag([2, 2, 2, 1]))
    result.add_geometry(cube, node_name="box", geom_name="crate", transform=turn)
    result.add_geometry(cone, node_name="hat", geom_name="cone",
                        transform=move([0, 5, 0]) @ np.diag([-1, 1, 1, 1]))  # fmt: skip
    path = tmp_path / "scene.glb"
    result.export(path)
    return path


def test_glb_scene_is_joined_in_world_space_and_written_back(scene, tmp_path):
    mesh = meshes.load_mesh(scene)
    original = trimesh.load(scene)
    assert set(mesh.carrier.parts) == {"left", "right", "box", "hat"}
    assert not any("pointed inwards" in note for note in mesh.repairs)  # mirrored, not inverted
    for node in mesh.carrier.parts:
        faces = mesh.faces[np.array(part_names(mesh)) == node]
        matrix, name = original.graph[node]
        shape = original.geometry[name].copy().apply_transform(matrix)
        assert volume(mesh.vertices, faces) == pytest.approx(abs(shape.volume), rel=1e-5)
        low, high = shape.bounds
        np.testing.assert_allclose(mesh.vertices[faces].reshape(-1, 3).min(axis=0), low, atol=1e-5)
        np.testing.assert_allclose(mesh.vertices[faces].reshape(-1, 3).max(axis=0), high, atol=1e-5)

    moved = mesh.vertices + 0.05 * np.sin(7 * mesh.vertices[:, ::-1])
    out = tmp_path / "out.glb"
    meshes.save_mesh(mesh, moved, out)
    back = meshes.load_mesh(out)
    np.testing.assert_array_equal(back.faces, mesh.faces)
    np.testing.assert_allclose(back.vertices, moved, atol=2e-6)
    np.testing.assert_allclose(corner_uv(back), corner_uv(mesh))
    assert part_names(back) == part_names(mesh)

    again = trimesh.load(out)
    assert {"left", "right", "box", "hat"} <= set(again.graph.nodes)
    _, crate = again.graph["box"]
    material = again.geometry[crate].visual.material
    assert (material.name, material.roughnessFactor, material.metallicFactor) == ("leaf", 0.3, 0.7)
    assert np.array(material.baseColorTexture)[0, 0, :3].tolist() == [0, 128, 0]
    _, cone = again.graph["hat"]
    assert again.geometry[cone].visual.vertex_colors[0].tolist() == [9, 99, 199, 255]
    # Transforms stay where they were: a node's mesh lies in its own frame.
    np.testing.assert_allclose(again.graph["box"][0], original.graph["box"][0], atol=1e-9)


@pytest.mark.parametrize("extension", ["obj", "ply"])
def test_glb_scene_as_other_formats(scene, tmp_path, extension):
    mesh = meshes.load_mesh(scene)
    out = tmp_path / f"out.{extension}"
    meshes.save_mesh(mesh, mesh.vertices, out)
    back = meshes.load_mesh(out)
    same_surface(back, mesh)
    used = np.array(part_names(mesh)) == "box"
    np.testing.assert_allclose(corner_uv(back)[used], corner_uv(mesh)[used], atol=1e-6)
    if extension == "obj":
        assert part_names(back) == part_names(mesh)
        assert "leaf" in material_names(back)
        assert list(back.carrier.textures) == ["out_leaf.png"]


def test_gltf_with_its_buffer_beside_it(scene, tmp_path):
    (tmp_path / "parts").mkdir()
    trimesh.load(scene).export(tmp_path / "parts" / "a.gltf")
    from_gltf, from_glb = (meshes.load_mesh(p) for p in (tmp_path / "parts" / "a.gltf", scene))
    assert sorted(from_gltf.carrier.parts) == sorted(from_glb.carrier.parts)
    meshes.save_mesh(from_gltf, from_gltf.vertices * 3, tmp_path / "b.glb")
    meshes.save_mesh(from_gltf, from_gltf.vertices * 2, tmp_path / "b.glb")  # nothing is used up
    back = meshes.load_mesh(tmp_path / "b.glb")
    np.testing.assert_allclose(back.vertices, from_gltf.vertices * 2, atol=2e-6)


# ---------------------------------------------------------------------------------------- repairs


def write_obj(path, vertices, faces):
    path.write_text(obj_text(vertices, faces))
    return path


def test_inward_mesh_is_turned_and_saved_as_it_came(tmp_path):
    inward = triangles()[:, ::-1]
    mesh = meshes.load_mesh(write_obj(tmp_path / "a.obj", CUBE, inward))
    assert volume(mesh.vertices, mesh.faces) > 0
    assert any("pointed inwards" in note for note in mesh.repairs)
    for extension in ("obj", "ply", "glb"):
        out = tmp_path / f"b.{extension}"
        meshes.save_mesh(mesh, mesh.vertices, out)
        back = trimesh.load(out, process=False, force="mesh")
        assert volume(back.vertices, back.faces) < 0


def test_one_inward_part(tmp_path):
    far = np.concatenate([CUBE, CUBE + 5])
    faces = np.concatenate([triangles(), triangles()[:, ::-1] + 8])
    mesh = meshes.load_mesh(write_obj(tmp_path / "a.obj", far, faces))
    assert any("flipped 12 faces, because" in note for note in mesh.repairs)
    np.testing.assert_array_equal(mesh.carrier.flipped, np.arange(24) // 12 == 1)
    assert volume(mesh.vertices, mesh.faces) == pytest.approx(2)


def test_disagreeing_faces_are_turned(tmp_path):
    faces = triangles()
    faces[[2, 7, 8]] = faces[[2, 7, 8]][:, ::-1]
    mesh = meshes.load_mesh(write_obj(tmp_path / "a.obj", CUBE, faces))
    assert volume(mesh.vertices, mesh.faces) == pytest.approx(1)
    np.testing.assert_array_equal(np.flatnonzero(mesh.carrier.flipped), [2, 7, 8])


def test_open_non_manifold_and_one_sided_meshes_are_accepted(tmp_path):
    fan = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]])  # three faces at one edge
    mesh = meshes.load_mesh(write_obj(tmp_path / "fan.obj", CUBE[:5], fan))
    np.testing.assert_array_equal(mesh.faces, fan)
    n = 12
    angle = np.arange(n) * 2 * np.pi / n
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    half = angle[:, None] / 2
    side, middle = np.cos(half) * circle + np.sin(half) * [0, 0, 1], 3 * circle
    points = np.concatenate([middle - side, middle + side])
    quads = [[k, k + 1, n + k + 1, n + k] for k in range(n - 1)] + [[n - 1, n, 0, 2 * n - 1]]
    band = meshes.load_mesh(write_obj(tmp_path / "band.obj", points, quads))
    assert len(band.faces) == 2 * n
    np.testing.assert_allclose(
        np.linalg.norm(meshes.vertex_normals(band.vertices, band.faces), axis=1), 1
    )


def test_degenerate_faces_stay_and_duplicates_are_welded(tmp_path):
    faces = np.concatenate([triangles(), [[0, 0, 1], [0, 8, 1]]])
    points = np.concatenate([CUBE, CUBE[:1], [[9, 9, 9]]])
    mesh = meshes.load_mesh(write_obj(tmp_path / "a.obj", points, faces))
    assert len(mesh.faces) == 14
    assert len(mesh.vertices) == 8
    assert set(mesh.repairs) == {
        "left out 1 vertex that no face uses",
        "ignored 2 degenerate faces for the normals",
    }
    assert np.isfinite(meshes.vertex_normals(mesh.vertices, mesh.faces)).all()


@pytest.mark.parametrize("scale", [1e30, 1e-30, 1e7])
def test_absurd_scales_work(tmp_path, scale):
    path = write_obj(tmp_path / "a.obj", CUBE * scale, QUADS)
    mesh = meshes.load_mesh(path)
    frame = meshes.normalisation(mesh.vertices)
    assert volume(frame.apply(mesh.vertices), mesh.faces) > 0.1
    meshes.save_mesh(mesh, mesh.vertices, tmp_path / "b.ply")
    np.testing.assert_allclose(
        meshes.load_mesh(tmp_path / "b.ply").vertices, mesh.vertices, rtol=1e-6
    )


def test_far_from_the_origin_obj_keeps_its_detail(tmp_path):
    mesh = meshes.load_mesh(write_obj(tmp_path / "a.obj", CUBE + 4e6, QUADS))
    assert any("far from the origin" in note for note in mesh.repairs)
    meshes.save_mesh(mesh, mesh.vertices + 0.01, tmp_path / "b.obj")
    back = meshes.load_mesh(tmp_path / "b.obj")
    np.testing.assert_allclose(back.vertices, mesh.vertices + 0.01, rtol=0, atol=1e-4)


# ---------------------------------------------------------------------------------------- bad input

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
PLY_HEAD = (
    "ply\nformat ascii 1.0\nelement vertex 3\n"
    "property float x\nproperty float y\nproperty float z\n"
    "element face {n}\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n"
)
GLTF_GONE = {
    "asset": {"version": "2.0"},
    "scenes": [{"nodes": [0]}],
    "nodes": [{"mesh": 0}],
    "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
    "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
    "bufferViews": [{"buffer": 0, "byteLength": 36}],
    "buffers": [{"byteLength": 36, "uri": "gone.bin"}],
}
JUNK = bytes(np.random.default_rng(3).integers(0, 256, 4000, dtype=np.uint8))

BAD = {
    "empty.obj": (b"", "is empty"),
    "blank.ply": (b"  \n\n", "is empty"),
    "points.obj": (TRIANGLE.encode(), "point cloud"),
    "points.ply": (PLY_HEAD.format(n=0).encode(), "point cloud"),
    "comment.obj": (b"# nothing here\n", "no mesh"),
    "nan.obj": (b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "NaN or infinite"),
    "inf.off": (b"OFF\n3 1 0\n0 0 inf\n1 0 0\n0 1 0\n3 0 1 2\n", "NaN or infinite"),
    "beyond.obj": (TRIANGLE.encode() + b"f 1 2 9\n", "refers to vertex 8"),
    "zero.obj": (TRIANGLE.encode() + b"f 0 1 2\n", "index 0"),
    "before.obj": (TRIANGLE.encode() + b"f -4 1 2\n", "refers to vertex -1"),
    "negative.ply": (PLY_HEAD.format(n=1).encode() + b"3 0 1 -1\n", "refers to vertex -1"),
    "short.off": (b"OFF\n3 2 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "ends too early"),
    "short.ply": (PLY_HEAD.format(n=2).encode() + b"3 0 1 2\n", "ends too early"),
    "beyond.off": (b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n", "face index outside"),
    "line.obj": (b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "degenerate"),
    "dot.obj": (b"v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n", "no extent"),
    "two.obj": (TRIANGLE.encode() + b"f 1 2\n", "three corners"),
    "flat.obj": (b"v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n", "fewer than three coordinates"),
    "words.obj": (b"v a b c\nf 1 1 1\n", "has 'a' where vertex 1"),
    "huge.obj": (b"v 0 0 0\nv 1e200 0 0\nv 0 1e200 0\nf 1 2 3\n", "scale the mesh"),
    "tiny.obj": (b"v 0 0 0\nv 1e-200 0 0\nv 0 1e-200 0\nf 1 2 3\n", "scale the mesh"),
    "unknown.xyz": (b"1 2 3\n", "supported mesh files are .obj"),
    "noextension": (b"1 2 3\n", "no extension"),
    "gone.gltf": (json.dumps(GLTF_GONE).encode(), "gone.bin"),
    "list.gltf": (b"[1, 2]", "not glTF"),
    "cut.glb": (struct.pack("<4sIII4s", b"glTF", 2, 999, 900, b"JSON") + b"{}", "ends too early"),
    "cut.ply": (ply("binary_little_endian")[:-9], "cut.ply"),
    "cut.off": (b"OFF\n3 1 0\n0 0 0\n", "ends too early"),
    "header.ply": (b"ply\nformat ascii 1.0\n", "an unterminated header"),
    **{f"junk{k}": (JUNK, "junk") for k in READABLE},
    **{f"text{k}": (b"hello, world\n" * 20, "text") for k in READABLE},
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_files_give_one_sentence(tmp_path, name):
    content, message = BAD[name]
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(UserError) as caught:
        meshes.load_mesh(path)
    text = str(caught.value)
    assert str(path) in text
    assert message in text
    assert "\n" not in text
    assert text.endswith(".")
    assert caught.value.__cause__ is None
    assert caught.value.__context__ is None or caught.value.__suppress_context__


def test_missing_file_folder_and_forbidden_file(tmp_path, monkeypatch):
    with pytest.raises(UserError, match="does not exist"):
        meshes.load_mesh(tmp_path / "nowhere.obj")
    with pytest.raises(UserError, match="is a folder"):
        meshes.load_mesh(tmp_path)

    def forbidden(self):
        raise PermissionError(13, "Permission denied")

    # The superuser may read everything, so the system's refusal is played.
    path = write_obj(tmp_path / "a.obj", CUBE, QUADS)
    monkeypatch.setattr(Path, "read_bytes", forbidden)
    with pytest.raises(UserError, match="is not readable"):
        meshes.load_mesh(path)


def test_every_truncation_of_a_good_file_is_either_read_or_explained(tmp_path, scene):
    for source in (scene.read_bytes(), ply("binary_big_endian"), ply("ascii")):
        path = tmp_path / ("cut.ply" if source.startswith(b"ply") else "cut.glb")
        for length in range(1, len(source), max(1, len(source) // 30)):
            path.write_bytes(source[:length])
            # Whatever else it raises than this fails the test.
            with contextlib.suppress(UserError):
                meshes.load_mesh(path)


def test_saving_says_what_is_wrong(tmp_path):
    mesh = meshes.load_mesh(write_obj(tmp_path / "a.obj", CUBE, QUADS))
    with pytest.raises(UserError, match=r"supported formats are \.ply, \.obj, \.glb, \.stl, \.3mf"):
        meshes.save_mesh(mesh, mesh.vertices, tmp_path / "b.fbx")
    with pytest.raises(UserError, match="diverged"):
        meshes.save_mesh(mesh, mesh.vertices * np.nan, tmp_path / "b.ply")
    with pytest.raises(ValueError, match="shape"):
        meshes.save_mesh(mesh, mesh.vertices[:3], tmp_path / "b.ply")
    with pytest.raises(UserError, match="cannot be written"):
        meshes.save_mesh(mesh, mesh.vertices, tmp_path / "a.obj" / "b.ply")
    with pytest.raises(UserError, match="save as OBJ"):
        meshes.save_mesh(mesh, mesh.vertices * 1e39, tmp_path / "b.glb")
    assert not (tmp_path / "b.glb").exists()


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    mesh = meshes.load_mesh(write_obj(tmp_path / "a.obj", CUBE, QUADS))
    out = tmp_path / "b.ply"
    meshes.save_mesh(mesh, mesh.vertices, out)
    before = out.read_bytes()

    def full(self, data):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(UserError, match="No space left"):
        meshes.save_mesh(mesh, mesh.vertices * 2, out)
    monkeypatch.undo()
    assert out.read_bytes() == before
    assert {p.name for p in tmp_path.iterdir()} == {"a.obj", "b.ply"}


# ---------------------------------------------------------------------------------------- remeshing


def test_remesh_makes_it_dense_and_says_so(textured):
    mesh = meshes.load_mesh(textured)
    dense = meshes.remesh(mesh, 2000)
    assert 1700 < len(dense.vertices) < 2300
    assert any("remeshed evenly" in n and "are not kept" in n for n in dense.repairs)
    assert dense.carrier is None
    assert volume(dense.vertices, dense.faces) == pytest.approx(1, rel=1e-6)
    assert dense.vertices.min() > 4.99  # in the input's frame
    assert dense.vertices.max() < 6.01
    assert meshes.remesh(dense, 100).faces is dense.faces
    assert "not remeshed" in meshes.remesh(dense, 100).repairs[-1]


def test_remesh_of_a_non_manifold_mesh_divides_it(tmp_path):
    fan = [[0, 1, 2], [1, 0, 3], [0, 1, 4]]
    mesh = meshes.load_mesh(write_obj(tmp_path / "fan.obj", CUBE[:5], fan))
    dense = meshes.remesh(mesh, 300)
    assert len(dense.vertices) >= 300
    assert "not manifold" in dense.repairs[-1]
    total = meshes.face_areas(dense.vertices, dense.faces).sum()
    assert total == pytest.approx(meshes.face_areas(mesh.vertices, mesh.faces).sum())
    bow_tie = np.concatenate([triangles(), triangles() + 8])
    points = np.concatenate([CUBE, CUBE + 1])  # two cubes share a corner
    mesh = meshes.load_mesh(write_obj(tmp_path / "tie.obj", points, bow_tie))
    assert "a vertex joins several sheets" in meshes.remesh(mesh, 300).repairs[-1]
