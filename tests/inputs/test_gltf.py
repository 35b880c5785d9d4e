"""glTF as it came: read as others read it, and written back with nothing else changed."""

from __future__ import annotations

import copy
import io
import json
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from styleexp.inputs import meshes
from styleexp.inputs.meshes import accessors, gltf
from styleexp.system.errors import UserError
from tests.helpers import gltf_readers
from tests.helpers.corpus.writers import CUBE, F, V, glb, gltf_parts, picture
from tests.helpers.needed import available

pytestmark = pytest.mark.usefixtures("valid_glbs")

KINDS = {5120: "i1", 5121: "u1", 5122: "i2", 5123: "u2", 5125: "u4", 5126: "f4"}
TYPES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


class Builder:
    """A glTF document and its one buffer, made piece by piece."""

    def __init__(self, seed: int = 0) -> None:
        self.rng = np.random.default_rng(seed)
        self.tree = {
            "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": []}], "nodes": [],
            "meshes": [], "accessors": [], "bufferViews": [], "buffers": [{}],
        }  # fmt: skip
        self.buffer = b""

    def view(self, data: bytes, **more) -> int:
        self.buffer += bytes(-len(self.buffer) % 4)
        self.tree["bufferViews"].append(
            {"buffer": 0, "byteOffset": len(self.buffer), "byteLength": len(data), **more}
        )
        self.buffer += data
        return len(self.tree["bufferViews"]) - 1

    def accessor(self, values: np.ndarray, kind: int = 5126, odd: bool = False, **more) -> int:
        """``values`` (count, components); ``odd``: with any stride, offset or sparse part."""
        values = np.asarray(values).reshape(len(values), -1).astype("<" + KINDS[kind])
        count, width = values.shape
        size, item = width * values.itemsize, values.itemsize
        accessor = {"componentType": kind, "count": count}
        accessor["type"] = next(t for t, n in TYPES.items() if n == width)
        indices = more.pop("indices", False)
        how = self.rng.choice(["plain", "stride", "sparse", "zeros"]) if odd else "plain"
        if indices and how == "stride":
            how = "plain"
        base = values
        if how in ("sparse", "zeros"):
            changed = np.sort(self.rng.choice(count, max(1, count // 3), replace=False))
            base = values.copy()
            base[changed] = 0 if kind != 5126 else 0.5
            if how == "zeros":
                changed = np.arange(count)
            where = self.rng.choice([5123, 5125] if count > 255 else [5121, 5123, 5125])
            accessor["sparse"] = {
                "count": len(changed),
                "indices": {
                    "bufferView": self.view(changed.astype("<" + KINDS[where]).tobytes()),
                    "componentType": int(where),
                    "byteOffset": 0,
                },
                # glTF-Transform takes the accessor's own offset where none is given.
                "values": {"bufferView": self.view(values[changed].tobytes()), "byteOffset": 0},
            }
        if how != "zeros":
            stride = -(-size // 4) * 4 if not indices else size
            if how == "stride":
                stride += 4 * int(self.rng.integers(0, 4))
            start = item * int(self.rng.integers(0, 3)) * (4 // item) if odd else 0
            data = bytearray(self.rng.bytes(start + stride * count))
            for k, row in enumerate(base):
                data[start + k * stride : start + k * stride + size] = row.tobytes()
            stride = {"byteStride": stride} if how == "stride" or stride != size else {}
            accessor["bufferView"] = self.view(bytes(data), **stride)
            if start:
                accessor["byteOffset"] = start
        self.tree["accessors"].append(accessor | more)
        return len(self.tree["accessors"]) - 1

    def positions(self, values, kind: int = 5126, **more) -> int:
        stored = np.asarray(values).astype("<" + KINDS[kind])
        bounds = {"min": stored.min(axis=0).tolist(), "max": stored.max(axis=0).tolist()}
        return self.accessor(stored, kind, **bounds, **more)

    def triangles(self, faces, kind: int = 5123, **more) -> int:
        return self.accessor(np.reshape(faces, (-1, 1)), kind, indices=True, **more)

    def add(self, kind: str, **entry) -> int:
        self.tree.setdefault(kind, []).append(entry)
        return len(self.tree[kind]) - 1

    def shown(self, **node) -> int:
        number = self.add("nodes", **node)
        self.tree["scenes"][0]["nodes"].append(number)
        return number

    def write(self, path: Path) -> Path:
        self.tree["buffers"][0]["byteLength"] = len(self.buffer)
        path.write_bytes(glb(copy.deepcopy(self.tree), self.buffer))
        return path


def ball(builder: Builder, **attributes: int) -> dict:
    """A primitive of the ball."""
    where = attributes.pop("POSITION", None)
    where = builder.positions(V) if where is None else where
    return {"attributes": {"POSITION": where, **attributes}, "indices": builder.triangles(F)}


def moved(mesh):
    """Its vertices displaced."""
    return mesh.vertices + 0.03 * np.sin(9 * mesh.vertices[:, ::-1])


def saved(mesh, path: Path, vertices=None, **more) -> Path:
    meshes.save_mesh(mesh, mesh.vertices if vertices is None else vertices, path, **more)
    return path


def normals_of(points, faces):
    return meshes.vertex_normals(np.asarray(points, float), faces)


# ----------------------------------------------------------------------------------------- reading


@pytest.mark.parametrize("seed", range(16))
def test_any_layout_of_numbers_is_read_as_others_read_it(tmp_path, seed):
    """Component types, normalised or not, strides, offsets, sparse parts, parts without a view."""
    builder = Builder(seed)
    rng = builder.rng
    quantised = bool(seed % 2)
    kind = int(rng.choice([5120, 5121, 5122, 5123])) if quantised else 5126
    top = np.iinfo(KINDS[kind]).max if quantised else 1
    low = 0 if kind in (5121, 5123) else -top
    whole = np.round(low + (V + 1) / 2 * (top - low)) if quantised else V
    normalised = {"normalized": True} if quantised and rng.random() < 0.5 else {}
    attributes = {"POSITION": builder.positions(whole, kind, odd=True, **normalised)}
    attributes["NORMAL"] = (
        builder.accessor(np.round(V * 127), 5120, odd=True, normalized=True)
        if quantised
        else builder.accessor(V, odd=True)
    )
    uv_kind = int(rng.choice([5121, 5123, 5126]))
    uv = rng.random((len(V), 2)) * (1 if uv_kind == 5126 else np.iinfo(KINDS[uv_kind]).max)
    flag = {} if uv_kind == 5126 else {"normalized": True}
    attributes["TEXCOORD_0"] = builder.accessor(uv, uv_kind, odd=True, **flag)
    color_kind, width = int(rng.choice([5121, 5123, 5126])), int(rng.choice([3, 4]))
    color = rng.random((len(V), width)) * (
        1 if color_kind == 5126 else np.iinfo(KINDS[color_kind]).max
    )
    flag = {} if color_kind == 5126 else {"normalized": True}
    attributes["COLOR_0"] = builder.accessor(color, color_kind, odd=True, **flag)
    indices = builder.triangles(F, int(rng.choice([5121, 5123, 5125])), odd=True)
    builder.add("meshes", primitives=[{"attributes": attributes, "indices": indices}])
    scale = [1 / top] * 3 if quantised and not normalised else [1, 1, 1]
    builder.shown(mesh=0, scale=scale)
    if quantised:
        builder.tree["extensionsUsed"] = ["KHR_mesh_quantization"]
        builder.tree["extensionsRequired"] = ["KHR_mesh_quantization"]
    path = builder.write(tmp_path / "a.glb")
    available(gltf_readers.tools)
    assert gltf_readers.errors(path) == [[]]

    (theirs,) = gltf_readers.values(path)
    tree, binary = gltf.parse("glb", path.read_bytes())
    for index, wanted in enumerate(theirs):
        found = accessors.real(tree, [binary], index)
        np.testing.assert_allclose(found, np.array(wanted).reshape(found.shape), atol=1e-6)
    mesh = meshes.load_mesh(path)
    assert len(mesh.vertices) == len(np.unique(whole, axis=0))
    wanted = np.array(theirs[attributes["POSITION"]]) * scale
    order = np.array(theirs[indices], dtype=int).reshape(-1, 3)
    np.testing.assert_allclose(mesh.vertices[mesh.faces], wanted[order], atol=1e-6)
    carrier = mesh.carrier
    uv = np.array(theirs[attributes["TEXCOORD_0"]]) * [1, -1] + [0, 1]
    np.testing.assert_allclose(carrier.uv[carrier.corners], uv[order], atol=1e-6)
    rgba = np.pad(theirs[attributes["COLOR_0"]], ((0, 0), (0, 4 - width)), constant_values=1)
    assert np.abs(carrier.colors[carrier.corners] - 255 * rgba[order]).max() <= 0.5001

    # Displaced, it is where it should be, whatever the layout was.
    out = saved(mesh, tmp_path / "b.glb", moved(mesh))
    back = meshes.load_mesh(out)
    np.testing.assert_allclose(back.vertices[back.faces], moved(mesh)[mesh.faces], atol=1e-6)
    same = gltf_readers.parts(saved(mesh, tmp_path / "c.glb"))
    assert same == (tree, binary)


@pytest.mark.parametrize("mode", [5, 6])
def test_strips_and_fans(tmp_path, mode):
    builder = Builder()
    if mode == 5:
        order = [0, 1, 2, 3, 3, 4, 4, 5, 6, 7]  # with a jump
        wanted = [[0, 1, 2], [1, 3, 2], [4, 5, 6], [5, 7, 6]]
        points = [(x + 3 * (k // 2), y, 0.0) for k in range(4) for x, y in ((0, 0), (0, 1))]
        points = np.array(points) + [[0, 0, 0.1 * k] for k in range(8)]
    else:
        order, wanted = [0, 1, 2, 3, 4], [[1, 2, 0], [2, 3, 0], [3, 4, 0]]
        points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.2], [-1, 1, 0]])
    where = builder.positions(points)
    primitive = {"attributes": {"POSITION": where}, "indices": builder.triangles(order)}
    builder.add("meshes", primitives=[{**primitive, "mode": mode}])
    builder.shown(mesh=0)
    mesh = meshes.load_mesh(builder.write(tmp_path / "a.glb"))
    np.testing.assert_allclose(
        meshes.mesh._crosses(mesh.vertices[mesh.carrier.rows], mesh.carrier.corners),
        meshes.mesh._crosses(points.astype("f4"), np.array(wanted)), atol=1e-6,
    )  # fmt: skip
    out = saved(mesh, tmp_path / "b.glb", mesh.vertices * 2)
    assert gltf_readers.parts(out)[0]["meshes"][0]["primitives"][0]["mode"] == mode
    np.testing.assert_array_equal(meshes.load_mesh(out).faces, mesh.faces)


def test_uv_without_a_material_and_texcoord_of_the_material(tmp_path):
    builder = Builder()
    first, second = builder.rng.random((2, len(V), 2)).astype("f4")
    uv = {f"TEXCOORD_{k}": builder.accessor(t) for k, t in enumerate((first, second))}
    builder.add("meshes", primitives=[ball(builder, **uv)])
    builder.shown(mesh=0)
    path = builder.write(tmp_path / "a.glb")
    up = np.array([0, 1]) + np.array([1, -1]) * first
    carrier = meshes.load_mesh(path).carrier
    np.testing.assert_allclose(carrier.uv[carrier.corners], up[F], atol=1e-7)

    image = builder.add("images", bufferView=builder.view(picture("PNG")()), mimeType="image/png")
    builder.add("textures", source=image)
    texture = {"index": 0, "texCoord": 1}
    builder.add("materials", pbrMetallicRoughness={"baseColorTexture": texture})
    builder.tree["meshes"][0]["primitives"][0]["material"] = 0
    carrier = meshes.load_mesh(builder.write(path)).carrier
    up = np.array([0, 1]) + np.array([1, -1]) * second
    np.testing.assert_allclose(carrier.uv[carrier.corners], up[F], atol=1e-7)


# ------------------------------------------------------------------------------------ as it came


def everything(builder: Builder) -> Builder:
    """A file with all that glTF has a place for, most of it of no use to this package."""
    rng, n = builder.rng, len(V)
    tangents = np.column_stack([np.cross(V, [0.3, 0.5, 0.8]), np.ones(n)])
    tangents[:, :3] /= np.linalg.norm(tangents[:, :3], axis=1, keepdims=True)
    attributes = {
        "NORMAL": builder.accessor(V),
        "TANGENT": builder.accessor(tangents),
        "TEXCOORD_0": builder.accessor(rng.integers(0, 65536, (n, 2)), 5123, normalized=True),
        "TEXCOORD_1": builder.accessor(rng.random((n, 2))),
        "COLOR_0": builder.accessor(rng.integers(0, 65536, (n, 4)), 5123, normalized=True),
        "JOINTS_0": builder.accessor(np.repeat([[0, 1, 0, 0]], n, axis=0), 5121),
        "WEIGHTS_0": builder.accessor(np.repeat([[0.75, 0.25, 0, 0]], n, axis=0)),
        "_WEAR": builder.accessor(rng.random(n)),
    }
    puff = builder.positions(rng.normal(size=(n, 3)) / 50)
    primitive = ball(builder, **attributes) | {"material": 0, "targets": [{"POSITION": puff}]}
    line = {"attributes": {"POSITION": builder.positions(CUBE)}, "mode": 1}
    image = builder.add("images", bufferView=builder.view(picture("PNG")()), mimeType="image/png")
    builder.add("samplers", wrapS=33648, wrapT=33071, magFilter=9728)
    builder.add("textures", source=image, sampler=0, name="wall", extras={"a": [1, None]})
    moved_texture = {"KHR_texture_transform": {"scale": [4, 4], "offset": [0.25, 0]}}
    builder.add(
        "materials", name="brick", doubleSided=True, alphaMode="MASK", alphaCutoff=0.3,
        emissiveFactor=[1, 0.5, 0],
        pbrMetallicRoughness={
            "baseColorFactor": [0.2, 0.5, 0.8, 1], "metallicFactor": 0.3,
            "baseColorTexture": {"index": 0, "extensions": moved_texture},
        },
        normalTexture={"index": 0, "scale": 0.4},
        occlusionTexture={"index": 0, "texCoord": 1, "strength": 0.5},
        extensions={
            "KHR_materials_clearcoat": {"clearcoatFactor": 0.7},
            "KHR_materials_emissive_strength": {"emissiveStrength": 5},
        },
    )  # fmt: skip
    builder.add("materials", name="unused")
    builder.add("meshes", name="body", primitives=[primitive], weights=[0.0],
                extras={"targetNames": ["puff"]})  # fmt: skip
    builder.add("meshes", primitives=[line], name="wires")
    builder.shown(mesh=0, skin=0, name="body", extras={"id": 7})
    hip = builder.shown(
        name="hip", children=[2], translation=[0, 0.5, 0], rotation=[0, 0.6, 0, 0.8]
    )
    assert builder.add("nodes", name="knee", scale=[1, 2, 1]) == 2
    bind = np.tile(np.eye(4).T.reshape(1, 16), (2, 1))
    bind = builder.accessor(bind[:, :4])  # a placeholder of the right view, made MAT4 below
    eye = np.tile(np.eye(4, dtype="<f4").reshape(-1), 2)
    builder.tree["bufferViews"][builder.tree["accessors"][bind]["bufferView"]] = {
        **builder.tree["bufferViews"][builder.view(eye.tobytes())]
    }
    builder.tree["accessors"][bind]["type"] = "MAT4"
    builder.add("skins", joints=[hip, 2], inverseBindMatrices=bind)
    time = builder.accessor([0.0, 1.0], min=[0.0], max=[1.0])
    way = builder.accessor([[0, 0, 0], [0, 1, 0]])
    builder.add(
        "animations",
        name="hop",
        samplers=[{"input": time, "output": way}],
        channels=[{"sampler": 0, "target": {"node": hip, "path": "translation"}}],
    )
    builder.add("cameras", type="perspective", perspective={"yfov": 0.7, "znear": 0.1})
    light = {"lights": [{"type": "spot", "spot": {}, "intensity": 5}]}
    builder.shown(camera=0, extensions={"KHR_lights_punctual": {"light": 0}})
    builder.shown(mesh=1, matrix=[2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 2, 0, 1, 2, 3, 1])
    builder.add("scenes", name="empty")
    builder.tree |= {
        "extensions": {"KHR_lights_punctual": light},
        "extensionsUsed": [
            "KHR_texture_transform", "KHR_materials_clearcoat",
            "KHR_materials_emissive_strength", "KHR_lights_punctual",
        ],
        "extras": {"made": "by hand", "ünï": "李"},
    }  # fmt: skip
    builder.tree["asset"] |= {"copyright": "me", "generator": "a test", "extras": {"v": 1.5e-7}}
    return builder


def test_everything_goes_through_unchanged_where_nothing_moves(tmp_path):
    path = everything(Builder()).write(tmp_path / "a.glb")
    available(gltf_readers.tools)
    assert gltf_readers.errors(path) == [[]]
    mesh = meshes.load_mesh(path)
    (note,) = (n for n in mesh.repairs if "made for the unchanged" in n)
    assert "morph targets, skins and animations" in note
    out = saved(mesh, tmp_path / "b.glb")
    (before, content), (after, left) = gltf_readers.parts(path), gltf_readers.parts(out)
    before["buffers"] = after["buffers"]
    offsets = [[view.pop("byteOffset") for view in t["bufferViews"]] for t in (before, after)]
    assert after == before
    for k, view in enumerate(after["bufferViews"]):  # with a hole in the buffer, byte for byte
        a, b = (where[k] for where in offsets)
        size = view["byteLength"]
        assert content[a : a + size] == left[b : b + size]


def test_only_positions_and_normals_change_where_something_moves(tmp_path):
    path = everything(Builder()).write(tmp_path / "a.glb")
    mesh = meshes.load_mesh(path)
    out = saved(mesh, tmp_path / "b.glb", moved(mesh), displacement=np.arange(len(V)) / 100)
    available(gltf_readers.tools)
    (before, _), (after, _) = gltf_readers.parts(path), gltf_readers.parts(out)
    old, new = gltf_readers.values(path, out)
    kept = before["meshes"][0]["primitives"][0]["attributes"]
    got = after["meshes"][0]["primitives"][0]["attributes"]
    assert set(kept) - set(got) == {"TANGENT"}
    assert set(got) - set(kept) == {"_DISPLACEMENT"}
    np.testing.assert_allclose(
        np.ravel(new[got["_DISPLACEMENT"]]), np.arange(len(V)) / 100, atol=1e-7
    )
    for name in set(kept) & set(got) - {"POSITION", "NORMAL"}:
        assert new[got[name]] == old[kept[name]], name
    positions, normals = np.array(new[got["POSITION"]]), np.array(new[got["NORMAL"]])
    assert np.abs(positions - V).max() > 0.01
    assert after["accessors"][got["POSITION"]]["min"] == positions.min(axis=0).tolist()
    assert after["accessors"][got["POSITION"]]["max"] == positions.max(axis=0).tolist()
    # The skin's matrix is no similarity, so normals in the mesh's own frame are made there.
    np.testing.assert_allclose((normals * normals_of(positions, F)).sum(axis=1), 1, atol=0.02)
    # The joints take it where it was meant to be.
    back = meshes.load_mesh(out)
    np.testing.assert_allclose(back.vertices[back.faces], moved(mesh)[mesh.faces], atol=1e-5)
    del before["meshes"][0]["primitives"][0]["attributes"]
    del after["meshes"][0]["primitives"][0]["attributes"]
    for key in before.keys() - {"accessors", "bufferViews", "buffers"}:
        assert after[key] == before[key], key


@pytest.mark.parametrize("weight", [0.0, 0.7])
def test_morph_targets_count_by_their_given_weights(tmp_path, weight):
    builder = Builder()
    primitive = ball(builder)
    push = V * [[1, 0, 0]]
    primitive["targets"] = [{"POSITION": builder.positions(push)}]
    builder.add("meshes", primitives=[primitive], weights=[0.2])
    builder.shown(mesh=0, weights=[weight])
    mesh = meshes.load_mesh(builder.write(tmp_path / "a.glb"))
    np.testing.assert_allclose(mesh.vertices, V + weight * push, atol=1e-6)
    back = meshes.load_mesh(saved(mesh, tmp_path / "b.glb", moved(mesh)))
    np.testing.assert_allclose(back.vertices, moved(mesh), atol=1e-6)


def test_a_skinned_mesh_ignores_its_node(tmp_path):
    builder = Builder()
    joints = builder.accessor(np.zeros((len(V), 4)), 5121)
    weights = builder.accessor(np.repeat([[1, 0, 0, 0]], len(V), axis=0))
    builder.add("meshes", primitives=[ball(builder, JOINTS_0=joints, WEIGHTS_0=weights)])
    body = builder.shown(mesh=0, skin=0, scale=[100, 100, 100])
    bone = builder.shown(translation=[0, 0, 5])
    builder.add("skins", joints=[bone])
    mesh = meshes.load_mesh(builder.write(tmp_path / "a.glb"))
    np.testing.assert_allclose(mesh.vertices, V + np.array([0, 0, 5]), atol=1e-6)
    del builder.tree["nodes"][body]["skin"]
    mesh = meshes.load_mesh(builder.write(tmp_path / "a.glb"))
    np.testing.assert_allclose(mesh.vertices, 100 * V, rtol=1e-6)


# ----------------------------------------------------------------------------------- several nodes


def test_nodes_that_show_one_mesh_get_their_own_where_they_differ(tmp_path):
    builder = Builder()
    builder.add("meshes", primitives=[ball(builder, NORMAL=builder.accessor(V))], name="ball")
    builder.shown(mesh=0, name="left", translation=[-3, 0, 0])
    builder.shown(mesh=0, name="right", translation=[3, 0, 0], scale=[-1, 2, 1])
    builder.add("nodes", mesh=0, name="in no scene")
    mesh = meshes.load_mesh(builder.write(tmp_path / "a.glb"))
    still, _ = gltf_readers.parts(saved(mesh, tmp_path / "b.glb"))
    assert len(still["meshes"]) == 1
    out = saved(mesh, tmp_path / "c.glb", moved(mesh))
    tree, _ = gltf_readers.parts(out)
    assert [node["mesh"] for node in tree["nodes"]] == [1, 2, 0]
    assert tree["meshes"][0] == builder.tree["meshes"][0]
    back = meshes.load_mesh(out)
    np.testing.assert_array_equal(back.faces, mesh.faces)
    np.testing.assert_allclose(back.vertices, moved(mesh), atol=1e-6)
    half = mesh.vertices.copy()
    half[mesh.vertices[:, 0] > 0] *= 1.01
    tree, _ = gltf_readers.parts(saved(mesh, tmp_path / "d.glb", half))
    assert [node["mesh"] for node in tree["nodes"]] == [0, 1, 0]
    for extension in ("c", "d"):
        outward = meshes.load_mesh(tmp_path / f"{extension}.glb")
        centre = np.where(outward.vertices[outward.carrier.rows][:, :1] > 0, 3, -3) * [1, 0, 0]
        away = outward.vertices[outward.carrier.rows] - centre
        assert (np.einsum("ij,ij->i", outward.carrier.normals, away) > 0).all()


def test_primitives_that_share_their_attributes_go_on_sharing_them(tmp_path):
    builder = Builder()
    shared = builder.positions(V)
    halves = [builder.triangles(F[:40]), builder.triangles(F[40:])]
    builder.add(
        "meshes", primitives=[{"attributes": {"POSITION": shared}, "indices": k} for k in halves]
    )
    builder.shown(mesh=0)
    mesh = meshes.load_mesh(builder.write(tmp_path / "a.glb"))
    assert mesh.repairs == ()
    tree, binary = gltf_readers.parts(saved(mesh, tmp_path / "b.glb", moved(mesh)))
    used = [p["attributes"]["POSITION"] for p in tree["meshes"][0]["primitives"]]
    assert used == [shared, shared]
    assert len(tree["accessors"]) == len(builder.tree["accessors"])  # in the old one's place
    assert len(binary) == len(builder.buffer)


def test_images_beside_the_file_come_into_the_glb(tmp_path):
    builder = Builder()
    content = picture("JPEG")()
    (tmp_path / "my bark.jpg").write_bytes(content)
    for uri in ("my%20bark.jpg", "gone.png", "../secret.png"):
        builder.add("images", uri=uri)
        builder.add("textures", source=len(builder.tree["images"]) - 1)
    builder.add("materials", pbrMetallicRoughness={"baseColorTexture": {"index": 0}},
                normalTexture={"index": 1}, occlusionTexture={"index": 2})  # fmt: skip
    uv = builder.accessor(builder.rng.random((len(V), 2)))
    builder.add("meshes", primitives=[ball(builder, TEXCOORD_0=uv) | {"material": 0}])
    builder.shown(mesh=0)
    (tmp_path.parent / "secret.png").write_bytes(picture("PNG")())
    mesh = meshes.load_mesh(builder.write(tmp_path / "a.glb"))
    assert [("gone.png" in n, "secret.png" in n) for n in mesh.repairs] == [
        (True, False), (False, True),
    ]  # fmt: skip
    tree, binary = gltf_readers.parts(saved(mesh, tmp_path / "b.glb"))
    image = tree["images"][0]
    assert (image["mimeType"], "uri" in image) == ("image/jpeg", False)
    view = tree["bufferViews"][image["bufferView"]]
    start = view.get("byteOffset", 0)
    assert binary[start : start + view["byteLength"]] == content
    assert tree["materials"] == [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    saved(mesh, tmp_path / "b.obj")
    with Image.open(next(tmp_path.glob("b_*"))) as one, Image.open(io.BytesIO(content)) as other:
        assert one.size == other.size


def test_buffers_become_one_and_nothing_overlaps(tmp_path):
    document, buffer = gltf_parts()
    cut = document["bufferViews"][1]["byteOffset"]
    (tmp_path / "a.bin").write_bytes(b"\1\2\3\4" + buffer[:cut] + b"unused")
    (tmp_path / "b.bin").write_bytes(buffer[cut:])
    document["buffers"] = [
        {"uri": "a.bin", "byteLength": cut + 4, "name": "first"},
        {"uri": "b.bin", "byteLength": len(buffer) - cut},
    ]
    document["bufferViews"][0]["byteOffset"] = 4
    document["bufferViews"][1] |= {"buffer": 1, "byteOffset": 0}
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    mesh = meshes.load_mesh(tmp_path / "a.gltf")
    for vertices in (mesh.vertices, moved(mesh)):
        out = saved(mesh, tmp_path / "out.glb", vertices)
        tree, _ = gltf_readers.parts(out)
        assert len(tree["buffers"]) == 1
        back = meshes.load_mesh(out)
        np.testing.assert_array_equal(back.faces, mesh.faces)
        np.testing.assert_allclose(back.vertices, vertices, atol=1e-6)


# --------------------------------------------------------------------------------------- refusals


def refusal(tmp_path, change, buffer=None, kind="glb") -> str:
    document, whole = gltf_parts()
    change(document)
    path = tmp_path / f"bad.{kind}"
    path.write_bytes(glb(document, whole if buffer is None else buffer))
    with pytest.raises(UserError) as caught:
        meshes.load_mesh(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("name", ["KHR_draco_mesh_compression", "EXT_meshopt_compression", "A_b"])
def test_what_is_required_and_not_read_is_named(tmp_path, name):
    told = refusal(tmp_path, lambda d: d.update(extensionsRequired=[name]))
    assert name in told


def test_instancing_is_named_even_where_it_is_optional(tmp_path):
    def change(document):
        document["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": {}}}

    assert "EXT_mesh_gpu_instancing" in refusal(tmp_path, change)


def test_draco_beside_the_plain_numbers_is_left_out_of_what_changed(tmp_path):
    document, buffer = gltf_parts()
    draco = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}}
    document["meshes"][0]["primitives"][0]["extensions"] = draco
    document["extensionsUsed"] = list(draco)
    (tmp_path / "a.glb").write_bytes(glb(document, buffer))
    mesh = meshes.load_mesh(tmp_path / "a.glb")
    tree, _ = gltf_readers.parts(saved(mesh, tmp_path / "b.glb", moved(mesh)))
    assert "extensions" not in tree["meshes"][0]["primitives"][0]
    assert not tree.get("extensionsUsed")


def test_a_small_file_can_not_ask_for_much(tmp_path):
    def often(document):
        document["nodes"] = [{"mesh": 0} for _ in range(100_000)]
        document["scenes"] = [{"nodes": list(range(100_000))}]

    assert "too often" in refusal(tmp_path, often)

    def zeros(document):
        del document["accessors"][0]["bufferView"]
        document["accessors"] += [dict(document["accessors"][0], count=9_000_000)] * 2

    assert "does not contain" in refusal(tmp_path, zeros)

    def diamond(document):
        document["nodes"] = [{"children": [k + 1, k + 1]} for k in range(60)] + [{"mesh": 0}]

    assert "as a child of two nodes, or twice" in refusal(tmp_path, diamond)


@pytest.mark.parametrize("where", ["bufferView", "componentType", "count"])
@pytest.mark.parametrize("value", [-1, True, 10**20, None, 0.5, "x"])
def test_odd_numbers_in_an_accessor(tmp_path, where, value):
    assert refusal(tmp_path, lambda d: d["accessors"][0].update({where: value})).endswith(".")


def test_numbers_that_are_none(tmp_path):
    path = tmp_path / "a.gltf"
    for word in ("NaN", "1e999"):
        path.write_text(f'{{"asset": {{"version": "2.0"}}, "extras": {word}}}')
        with pytest.raises(UserError, match="not valid JSON"):
            meshes.load_mesh(path)
    path = tmp_path / "a.glb"
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12))
    with pytest.raises(UserError, match="ends too early"):
        meshes.load_mesh(path)


def test_the_pages_own_files_are_valid(tmp_path):
    from styleexp.experiments.reports import glb as page

    available(gltf_readers.tools)
    for k, (values, bare) in enumerate([(None, False), (V[:, 0], False), (None, True)]):
        (tmp_path / f"{k}.glb").write_bytes(page.glb(V, F, 1.25, values, bare))
    assert gltf_readers.errors(*sorted(tmp_path.glob("*.glb"))) == [[], [], []]
