"""PLY and OBJ as they came: every property, colour, group, and what a format has no room for."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from styleexp.inputs import meshes
from styleexp.system.errors import UserError
from tests.helpers.corpus.writers import F, V
from tests.helpers.corpus.writers import ply as plain_ply

pytestmark = pytest.mark.usefixtures("valid_glbs")

CODES = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I",
         "float": "f", "double": "d"}  # fmt: skip


def ply_file(elements, kind="binary_little_endian", comments=()) -> bytes:
    """``elements``: for each its name and, for each property, type, name and values; a list
    property's type is (length's, entries')."""
    head = ["ply", f"format {kind} 1.0", *comments]
    body = b""
    order = ">" if "big" in kind else "<"
    for name, properties in elements:
        head.append(f"element {name} {len(properties[0][2])}")
        for each, label, _ in properties:
            each = f"list {' '.join(each)}" if isinstance(each, tuple) else each
            head.append(f"property {each} {label}")
        for row in zip(*(values for _, _, values in properties), strict=True):
            words = []
            for (each, _, _), value in zip(properties, row, strict=True):
                entries = np.atleast_1d(value).tolist()
                if isinstance(each, tuple):
                    words.append((each[0], len(entries)))
                    each = each[1]
                words += [(each, entry) for entry in entries]
            if kind == "ascii":
                body += (" ".join(f"{v!r}" for _, v in words) + "\n").encode()
            else:
                body += b"".join(struct.pack(order + CODES[t], v) for t, v in words)
    return ("\n".join([*head, "end_header"]) + "\n").encode() + body


def vertex(rng, n=42, positions=V, kind="float"):
    """A vertex element with all sorts of things."""
    x, y, z = positions.T if kind == "double" else positions.astype("f4").T.astype(float)
    color = rng.integers(0, 256, (n, 3)).T
    rest = [
        ("float", "confidence", rng.random(n).astype("f4")),
        ("int", "label", rng.integers(-(2**31), 2**31, n)),
        ("double", "quality", rng.normal(size=n)),
        ("short", "ring", rng.integers(-9, 9, n)),
        (("uchar", "float"), "weights", [rng.random(k % 4).astype("f4") for k in range(n)]),
    ]
    out = [(kind, "x", x), (kind, "y", y), (kind, "z", z)]
    out += [
        ("float", f"n{axis}", column) for axis, column in zip("xyz", V.astype("f4").T, strict=True)
    ]
    out += [("uchar", c, v) for c, v in zip(("red", "green", "blue"), color, strict=True)]
    out += [("float", c, v.astype("f4")) for c, v in zip("st", rng.random((2, n)), strict=True)]
    return ("vertex", out + rest)


def face(rng, faces=F):
    n = len(faces)
    return ("face", [
        (("uchar", "int"), "vertex_indices", list(faces)),
        ("int", "segment", rng.integers(0, 9, n)),
        *(("uchar", c, rng.integers(0, 256, n)) for c in ("red", "green", "blue", "alpha")),
        ("float", "flatness", rng.random(n).astype("f4")),
        (("uchar", "ushort"), "tags", [rng.integers(0, 9, k % 3) for k in range(n)]),
    ])  # fmt: skip


def raw(path):
    """The elements as trimesh reads them, by name and property."""
    header, read = {}, trimesh.exchange.ply
    with path.open("rb") as file:
        elements, is_ascii, _ = read._parse_header(file)
        (read._ply_ascii if is_ascii else read._ply_binary)(elements, file)
    for name, element in elements.items():
        header[name] = element["data"]
    return header


def column(data, name):
    values = data[name]
    return np.asarray(
        values["f1"] if getattr(values, "dtype", np.dtype(int)).names else values
    ).ravel()


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("precision", ["float", "double"])
def test_every_property_goes_through(tmp_path, kind, precision):
    rng = np.random.default_rng(1)
    elements = [vertex(rng, kind=precision), face(rng)]
    elements[0][1].pop()  # lists of many lengths, which trimesh doesn't read, are tried below
    elements[1][1].pop()
    path = tmp_path / "a.ply"
    path.write_bytes(ply_file(elements, kind, ["comment made by hand", "obj_info 7"]))
    mesh = meshes.load_mesh(path)
    (note,) = mesh.repairs
    for word in ("OBJ", "confidence", "label", "face colours", "segment", "GLB"):
        assert word in note
    meshes.save_mesh(mesh, mesh.vertices, tmp_path / "b.ply", displacement=np.zeros(len(V)))
    before, after = raw(path), raw(tmp_path / "b.ply")
    names = list(before["vertex"] if kind == "ascii" else before["vertex"].dtype.names)
    assert list(after["vertex"].dtype.names) == [*names, "displacement"]
    for name, given in (("vertex", elements[0][1]), ("face", elements[1][1])):
        for each, label, values in given:
            found = column(after[name], label)
            np.testing.assert_array_equal(found, np.concatenate(values) if isinstance(each, tuple)
                                          else np.asarray(values))  # fmt: skip
    head = (tmp_path / "b.ply").read_bytes().split(b"end_header")[0].decode()
    assert "comment made by hand\nobj_info 7\n" in head

    # Moved, it keeps all but positions and normals.
    meshes.save_mesh(mesh, mesh.vertices * [1, 2, 3], tmp_path / "c.ply")
    moved = raw(tmp_path / "c.ply")["vertex"]
    for _, label, values in elements[0][1]:
        if label not in {"x", "y", "z", "nx", "ny", "nz"}:
            np.testing.assert_array_equal(column(moved, label), values)
    normals = np.stack([column(moved, f"n{axis}") for axis in "xyz"], axis=1)
    points = np.stack([column(moved, axis) for axis in "xyz"], axis=1)
    np.testing.assert_allclose(points, mesh.vertices * [1, 2, 3], atol=1e-6)
    np.testing.assert_allclose(normals, meshes.vertex_normals(points, F), atol=1e-6)


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_lists_of_many_lengths_and_mixed_polygons_go_through(tmp_path, kind):
    """Ours reads what ours wrote, and both hold what was given."""
    rng = np.random.default_rng(2)
    points = np.array([(x, y, 0) for x in range(4) for y in range(2)], dtype=float)
    polygons = [(0, 2, 1), (1, 2, 4, 3), (2, 4, 5, 3), (4, 6, 7)]
    elements = [vertex(rng, len(points), points), face(rng, polygons)]
    elements[0][1][3:6] = []
    path = tmp_path / "a.ply"
    path.write_bytes(ply_file(elements, kind))
    mesh = meshes.load_mesh(path)
    assert mesh.carrier.corners.tolist() == [
        [0, 2, 1], [1, 2, 4], [4, 3, 1], [2, 4, 5], [5, 3, 2], [4, 6, 7],
    ]  # fmt: skip
    assert any("2 quads" in note for note in mesh.repairs)
    meshes.save_mesh(mesh, mesh.vertices, tmp_path / "b.ply")
    owner = [0, 1, 1, 2, 2, 3]
    for found in (mesh.carrier.ply, meshes.load_mesh(tmp_path / "b.ply").carrier.ply):
        for table, given, rows in (
            (found.vertex, elements[0][1], range(len(points))), (found.face, elements[1][1], owner),
        ):  # fmt: skip
            for each, label, values in given:
                if label == "vertex_indices":
                    continue
                wanted = [values[k] for k in rows]
                if isinstance(each, tuple):
                    assert table[label].lengths.tolist() == [len(w) for w in wanted]
                    np.testing.assert_array_equal(table[label].values, np.concatenate(wanted))
                else:
                    np.testing.assert_array_equal(table[label], wanted)


def test_vertices_that_differ_in_a_property_alone_stay_apart_and_move_together(tmp_path):
    points, faces = V[F].reshape(-1, 3), np.arange(3 * len(F)).reshape(-1, 3)
    label = np.arange(len(points))
    table = [
        ("float", axis, column) for axis, column in zip("xyz", points.astype("f4").T, strict=True)
    ]
    elements = [
        ("vertex", [*table, ("int", "label", label)]),
        ("face", [(("uchar", "int"), "vertex_index", list(faces))]),
    ]
    path = tmp_path / "a.ply"
    path.write_bytes(ply_file(elements))
    mesh = meshes.load_mesh(path)
    assert len(mesh.vertices) == len(V)
    meshes.save_mesh(mesh, mesh.vertices * 2, tmp_path / "b.ply")
    data = raw(tmp_path / "b.ply")
    np.testing.assert_array_equal(column(data["vertex"], "label"), label)
    found = np.stack([column(data["vertex"], axis) for axis in "xyz"], axis=1)
    np.testing.assert_array_equal(found, 2 * points.astype("f4"))


@pytest.mark.parametrize("names", [("s", "t"), ("u", "v"), ("texture_u", "texture_v")])
def test_texture_coordinates_together_with_colours(tmp_path, names):
    rng = np.random.default_rng(3)
    uv, color = rng.random((len(V), 2)).astype("f4"), rng.integers(0, 256, (len(V), 4))
    table = [("float", axis, column) for axis, column in zip("xyz", V.astype("f4").T, strict=True)]
    table += [
        ("uchar", c, v) for c, v in zip(("red", "green", "blue", "alpha"), color.T, strict=True)
    ]
    table += [("float", name, column) for name, column in zip(names, uv.T, strict=True)]
    elements = [("vertex", table), ("face", [(("uchar", "int"), "vertex_indices", list(F))])]
    path = tmp_path / "a.ply"
    path.write_bytes(ply_file(elements))
    mesh = meshes.load_mesh(path)
    for extension in ("ply", "glb"):
        meshes.save_mesh(mesh, mesh.vertices, tmp_path / f"b.{extension}")
        carrier = meshes.load_mesh(tmp_path / f"b.{extension}").carrier
        np.testing.assert_allclose(carrier.uv[carrier.corners], uv[F], atol=1e-6)
        np.testing.assert_array_equal(carrier.colors[carrier.corners], color[F])
    np.testing.assert_array_equal(column(raw(tmp_path / "b.ply")["vertex"], names[1]), uv[:, 1])


def test_texture_coordinates_of_corners_and_several_textures(tmp_path):
    """As MeshLab writes them."""
    rng = np.random.default_rng(4)
    uv = rng.random((len(F), 6)).astype("f4")
    for name, color in (("a b.png", "red"), ("c.png", "blue")):
        out = io.BytesIO()
        Image.new("RGB", (4, 4), color).save(out, "PNG")
        (tmp_path / name).write_bytes(out.getvalue())
    number = rng.integers(0, 2, len(F))
    table = [("float", axis, column) for axis, column in zip("xyz", V.astype("f4").T, strict=True)]
    faces = [(("uchar", "int"), "vertex_indices", list(F)), (("uchar", "float"), "texcoord", uv),
             ("int", "texnumber", number)]  # fmt: skip
    path = tmp_path / "a.ply"
    comments = ["comment TextureFile a b.png", "comment TextureFile c.png"]
    path.write_bytes(ply_file([("vertex", table), ("face", faces)], comments=comments))
    mesh = meshes.load_mesh(path)
    assert len(mesh.vertices) == len(V)
    assert [m.name for m in mesh.carrier.materials] == ["a b", "c"]
    np.testing.assert_array_equal(mesh.carrier.face_material, number)
    for extension in ("ply", "obj", "glb"):
        meshes.save_mesh(mesh, mesh.vertices * 2, tmp_path / f"b.{extension}")
    carrier = meshes.load_mesh(tmp_path / "b.ply").carrier
    np.testing.assert_array_equal(carrier.uv[carrier.corners].reshape(-1, 6), uv)
    found = {m.name for m in meshes.load_mesh(tmp_path / "b.glb").carrier.materials}
    assert found == {"a b", "c"}


def test_face_colours_stay_the_faces(tmp_path):
    rng = np.random.default_rng(5)
    color = rng.integers(0, 256, (len(F), 3))
    table = [("float", axis, column) for axis, column in zip("xyz", V.astype("f4").T, strict=True)]
    faces = [(("uchar", "int"), "vertex_indices", list(F))]
    faces += [("uchar", c, v) for c, v in zip(("red", "green", "blue"), color.T, strict=True)]
    path = tmp_path / "a.ply"
    path.write_bytes(ply_file([("vertex", table), ("face", faces)]))
    mesh = meshes.load_mesh(path)
    assert mesh.carrier.colors is None
    for extension in ("ply", "glb", "obj"):
        meshes.save_mesh(mesh, mesh.vertices * 2, tmp_path / f"b.{extension}")
    data = raw(tmp_path / "b.ply")
    assert len(data["vertex"]) == len(V)
    found = np.stack([column(data["face"], c) for c in ("red", "green", "blue")], axis=1)
    np.testing.assert_array_equal(found, color)
    shape = trimesh.load(tmp_path / "b.glb", process=False, force="mesh")
    order = np.round(shape.triangles / 2, 3).reshape(len(F), -1)
    theirs = {
        tuple(t): c for t, c in zip(order, shape.visual.vertex_colors[shape.faces], strict=True)
    }
    for corners, wanted in zip(np.round(V[F], 3).reshape(len(F), -1), color, strict=True):
        near = min(theirs, key=lambda t: np.abs(np.array(t) - corners).max())
        assert (theirs[near][:, :3] == wanted).all()


@pytest.mark.parametrize("kind", ["ushort", "float"])
def test_colours_of_other_types_keep_them(tmp_path, kind):
    rng = np.random.default_rng(6)
    color = rng.integers(0, 65536, (len(V), 3)) if kind == "ushort" else rng.random((len(V), 3))
    color = color.astype("f4") if kind == "float" else color
    table = [("float", axis, column) for axis, column in zip("xyz", V.astype("f4").T, strict=True)]
    table += [(kind, c, v) for c, v in zip(("red", "green", "blue"), color.T, strict=True)]
    path = tmp_path / "a.ply"
    faces = [(("uchar", "int"), "vertex_indices", list(F))]
    path.write_bytes(ply_file([("vertex", table), ("face", faces)]))
    mesh = meshes.load_mesh(path)
    top = 65535 if kind == "ushort" else 1
    own = mesh.carrier.colors[mesh.carrier.corners][..., :3]
    assert np.abs(own - 255 * color[F] / top).max() <= 0.5001
    meshes.save_mesh(mesh, mesh.vertices, tmp_path / "b.ply")
    np.testing.assert_array_equal(column(raw(tmp_path / "b.ply")["vertex"], "red"), color[:, 0])


def test_what_a_ply_has_besides_is_named(tmp_path):
    table = [("float", axis, column) for axis, column in zip("xyz", V.astype("f4").T, strict=True)]
    edges = ("edge", [("int", "vertex1", [0, 1]), ("int", "vertex2", [1, 2])])
    strip = ("tristrips", [(("int", "int"), "vertex_indices", [[0, 1, 2, -1, 3, 4, 5]])])
    faces = ("face", [(("uchar", "int"), "vertex_indices", list(F))])
    path = tmp_path / "a.ply"
    path.write_bytes(ply_file([("vertex", table), edges, faces]))
    assert meshes.load_mesh(path).repairs == ("left out the element 'edge' of the PLY file",)
    path.write_bytes(ply_file([("vertex", table), strip]))
    with pytest.raises(
        UserError, match="triangle strips, which are not supported: export it again"
    ):
        meshes.load_mesh(path)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ((b"float x", b"float q"), "no vertices with x, y and z"),
        ((b"float x", b"floot x"), "of the type 'floot'"),
        ((b"vertex 42", b"vertex -3"), "header that cannot be read"),
        ((b"little", b"middle"), "binary_middle"),
        ((b"list uchar", b"list char"), ""),
        ((b"list uchar", b"list float"), "in floats"),
        ((b"float y", b"float x"), "header that cannot be read"),
        ((b"vertex 42", b"vertex 99999999999999"), "ends too early"),
    ],
)
def test_bad_headers(tmp_path, change, told):
    path = tmp_path / "a.ply"
    path.write_bytes(plain_ply().replace(*change))
    if not told:
        assert len(meshes.load_mesh(path).faces) == len(F)
        return
    with pytest.raises(UserError, match=told):
        meshes.load_mesh(path)


# --------------------------------------------------------------------------------------------- OBJ


def obj_of(before: dict[int, str], lines=None) -> str:
    """The ball, with lines before some of its faces."""
    lines = lines or [f"v {x!r} {y!r} {z!r}" for x, y, z in V.tolist()]
    for k, (a, b, c) in enumerate((F + 1).tolist()):
        lines = [*lines, *before.get(k, "").splitlines(), f"f {a} {b} {c}"]
    return "\n".join(lines) + "\n"


def states(path: Path, words: str) -> list[tuple]:
    """What the lines of each word say, at each face."""
    now, out = dict.fromkeys(words.split()), []
    for line in path.read_text().splitlines():
        word, _, rest = line.partition(" ")
        if word in now:
            now[word] = rest
        elif word == "f":
            out.append(tuple(now.values()))
    return out


def test_objects_groups_and_smoothing_are_all_kept(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text(obj_of({
        3: "o hull", 5: "g left upper\ns 1", 20: "g right", 30: "o mast\ns off", 40: "g left upper",
        50: "usemtl sail", 60: "g",
    }))  # fmt: skip
    mesh = meshes.load_mesh(path)
    meshes.save_mesh(mesh, mesh.vertices, tmp_path / "b.obj")
    before = states(path, "o g s usemtl")
    after = states(tmp_path / "b.obj", "o g s usemtl")
    assert [a[1:] for a in after] == [b[1:] for b in before]
    assert [a[0] for a in after[3:]] == [b[0] for b in before[3:]]
    assert set(mesh.carrier.parts) == {"a", "hull", "mast"}
    meshes.save_mesh(mesh, mesh.vertices, tmp_path / "b.glb")
    assert set(meshes.load_mesh(tmp_path / "b.glb").carrier.parts) == {"a", "hull", "mast"}


def test_groups_alone_stay_groups_and_are_the_parts_of_other_formats(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text(obj_of({0: "g one", 40: "g two"}))
    mesh = meshes.load_mesh(path)
    meshes.save_mesh(mesh, mesh.vertices * 2, tmp_path / "b.obj")
    assert states(tmp_path / "b.obj", "o g") == states(path, "o g")
    meshes.save_mesh(mesh, mesh.vertices, tmp_path / "b.glb")
    assert set(meshes.load_mesh(tmp_path / "b.glb").carrier.parts) == {"one", "two"}


@pytest.mark.parametrize("top", [1, 255])
@pytest.mark.parametrize("weight", ["", " 1.0"])
@pytest.mark.parametrize("some", [False, True])
def test_colours_after_three_or_four_coordinates_on_all_vertices_or_some(
    tmp_path, top, weight, some
):
    rng = np.random.default_rng(7)
    color = np.round(rng.random((len(V), 3)) * top, 0 if top > 1 else 4)
    color[:, 0] = top  # so that it is told from the other range
    lines = []
    for k, (x, y, z) in enumerate(V.tolist()):
        more = f"{weight} {color[k, 0]!r} {color[k, 1]!r} {color[k, 2]!r}".replace("np.float64", "")
        more = more.replace("(", "").replace(")", "")
        lines.append(f"v {x!r} {y!r} {z!r}" + (weight if some and k % 3 == 0 else more))
    path = tmp_path / "a.obj"
    path.write_text(obj_of({}, lines))
    mesh = meshes.load_mesh(path)
    wanted = np.column_stack([color * 255 / top, np.full(len(V), 255)])
    if some:
        wanted[::3] = 255
    assert np.abs(mesh.carrier.colors[mesh.carrier.corners] - wanted[F]).max() <= 0.5001
    meshes.save_mesh(mesh, mesh.vertices, tmp_path / "b.obj")
    first = [x.split()[1:] for x in lines]
    second = [x.split()[1:] for x in (tmp_path / "b.obj").read_text().splitlines() if x[:2] == "v "]
    drop = slice(3, 4) if weight else slice(0, 0)
    for a, b in zip(first, second, strict=True):
        del a[drop]
        assert list(map(float, a)) == list(map(float, b))


def test_positions_and_coordinates_of_an_obj_keep_every_digit(tmp_path):
    rng = np.random.default_rng(8)
    points, uv = V * rng.random((len(V), 1)), rng.random((len(V), 2))
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in points.tolist()]
    lines += [f"vt {u!r} {v!r}" for u, v in uv.tolist()]
    lines += ["f " + " ".join(f"{k}/{k}" for k in f) for f in (F + 1).tolist()]
    path = tmp_path / "a.obj"
    path.write_text("\n".join(lines))
    mesh = meshes.load_mesh(path)
    meshes.save_mesh(mesh, mesh.vertices, tmp_path / "b.obj")
    back = meshes.load_mesh(tmp_path / "b.obj")
    np.testing.assert_array_equal(back.vertices, points)
    np.testing.assert_array_equal(back.carrier.uv[back.carrier.corners], uv[F])


def test_lines_and_points_of_an_obj_are_named(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text(obj_of({2: "l 1 2 3\np 4"}))
    assert meshes.load_mesh(path).repairs == (
        "left out 2 lines of points, lines and curves (l, p)",
    )
