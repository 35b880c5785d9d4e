"""What glTF files may hold, and what may be wrong in them."""

from __future__ import annotations

import base64
import struct
from collections.abc import Callable

import numpy as np

from tests.helpers.corpus.case import group, refused, repaired, works
from tests.helpers.corpus.writers import (
    BALL,
    TEXT,
    Content,
    F,
    V,
    changed,
    glb,
    gltf,
    gltf_parts,
    good_glb,
    picture,
    png_claiming,
)

Change = Callable[[dict], object]

# ------------------------------------------------------------------------- features and faults


def _odd(change: Change, points=V, faces=F) -> bytes:
    """A GLB of the ball whose document has been changed."""
    return glb(*changed(change, points, faces))


def _set(**values) -> bytes:
    return _odd(lambda document: document.update(values))


def _primitive(**values) -> Change:
    return lambda document: document["meshes"][0]["primitives"][0].update(values)


def _node(**values) -> bytes:
    return _odd(lambda document: document["nodes"][0].update(values))


def _at(uri: str) -> bytes:
    """A glTF whose buffer is there."""
    return gltf(*gltf_parts(), uri)


def _draco(document: dict) -> None:
    draco = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}}
    document.update(extensionsUsed=list(draco), extensionsRequired=list(draco))
    document["meshes"][0]["primitives"][0]["extensions"] = draco


def _skin(document: dict) -> None:
    document["skins"] = [{"joints": [0]}]
    document["nodes"][0]["skin"] = 0


def _camera(document: dict) -> None:
    document["nodes"][0].pop("mesh")
    document["cameras"] = []


def _no_indices(document: dict) -> None:
    document["meshes"][0]["primitives"][0].pop("indices")


def _no_scene(document: dict) -> None:
    del document["scene"], document["scenes"]


def _twice(document: dict) -> None:
    document["nodes"] = [{"mesh": 0}, {"mesh": 0, "translation": [4, 0, 0]}]
    document["scenes"] = [{"nodes": [0, 1]}]


def _image(uri: str) -> Change:
    def change(document: dict) -> None:
        document.update(
            images=[{"uri": uri}],
            textures=[{"source": 0}],
            materials=[{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        )
        document["meshes"][0]["primitives"][0]["material"] = 0

    return change


def _data(content: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(content).decode()


def _at_byte(start: int, number: int) -> bytes:
    """A GLB with another number at a place of its header."""
    whole = good_glb()
    return whole[:start] + struct.pack("<I", number) + whole[start + 4 :]


_ANIMATION = {
    "channels": [{"sampler": 0, "target": {"node": 0, "path": "scale"}}],
    "samplers": [{"input": 1, "output": 0}],
}
_BUFFER = gltf_parts()[1]
_SECRET: dict[str, Content] = {"../secret/ball.bin": _BUFFER}
_LINK = {"ball.bin": "../secret/ball.bin"}
_MESHOPT = "EXT_meshopt_compression"
_BASE64 = "data:application/octet-stream;base64,"
_PNG = picture("PNG")()
_STRIP = np.arange(36).reshape(-1, 3)
_SOUP = V[F].reshape(-1, 3)
_LOOP = [{"mesh": 0, "children": [1]}, {"children": [0]}]
_DEEP = [*({"children": [k + 1]} for k in range(2000)), {"mesh": 0}]
_MARKUP = "</script><img src=x onerror=alert(1)>"
_UP_IMAGE = gltf(*changed(_image("../secret/skin.png")))
_SECRET_IMAGE: dict[str, Content] = {"../secret/skin.png": picture("PNG")}

FEATURES = group(
    "features and faults of glTF",
    works("plain.glb", "nothing odd", good_glb(), faces=80),
    works("uri.gltf", "its buffer as a data URI", gltf(*gltf_parts()), faces=80),
    works("beside.gltf", "its buffer beside it", _at("ball.bin"), beside={"ball.bin": _BUFFER},
          **BALL),
    works("percent.gltf", "its buffer beside it, %20 for a space", _at("my%20ball.bin"),
          beside={"my ball.bin": _BUFFER}, **BALL),
    refused("gone.gltf", "a buffer that isn't there", _at("ball.bin"), "ball.bin"),
    refused("up.gltf", "a buffer by ../", _at("../secret/ball.bin"), "outside", beside=_SECRET),
    refused("encoded.gltf", "a buffer by %2e%2e/", _at("%2e%2e/secret/ball.bin"), "outside",
            beside=_SECRET),
    refused("link.gltf", "a buffer that is a link to elsewhere", _at("ball.bin"), "outside",
            beside=_SECRET, links=_LINK),
    refused("absolute.gltf", "a buffer by an absolute path", _at("/etc/passwd"), "outside"),
    refused("file.gltf", "a buffer by file://", _at("file:///etc/passwd"), "file:///etc/passwd"),
    refused("web.gltf", "a buffer on the web", _at("http://127.0.0.1/b.bin"),
            "http://127.0.0.1/b.bin"),
    refused("base64.gltf", "a data URI that is cut off", _at(_BASE64 + "AAAA")),
    refused("nobase64.gltf", "a data URI that is none", _at(_BASE64 + "%%%")),
    refused("draco.glb", "Draco compression", _odd(_draco), "KHR_draco_mesh_compression"),
    refused("meshopt.glb", "meshopt compression", _set(extensionsRequired=[_MESHOPT]), _MESHOPT),
    works("optional.glb", "an unknown extension that isn't required",
          _set(extensionsUsed=["ABC_xyz"]), faces=80),
    repaired("skin.glb", "a node with a skin, whose mesh has no joints", _odd(_skin), "kept skins",
             faces=80),
    repaired("animation.glb", "an animation", _set(animations=[_ANIMATION]), "kept animations",
             faces=80),
    repaired("morph.glb", "a morph target", _odd(_primitive(targets=[{"POSITION": 0}])),
             "kept morph targets", faces=80),
    refused("camera.glb", "a camera and no mesh", _odd(_camera), "no faces"),
    refused("points.glb", "points", _odd(_primitive(mode=0)), "no faces"),
    refused("lines.glb", "lines", _odd(_primitive(mode=1)), "no faces"),
    repaired("strip.glb", "a triangle strip", _odd(_primitive(mode=5), V, _STRIP), "no face uses",
             faces=34),
    works("unindexed.glb", "no indices", _odd(_no_indices, _SOUP), **BALL),
    refused("noposition.glb", "a mesh without positions", _odd(_primitive(attributes={}))),
    refused("nomesh.glb", "a node with a mesh that isn't there", _node(mesh=5)),
    refused("nonode.glb", "a scene with a node that isn't there", _set(scenes=[{"nodes": [0, 9]}])),
    refused("noscene.glb", "no scene", _odd(_no_scene), "no mesh"),
    refused("badscene.glb", "a scene that isn't there", _set(scene=4)),
    refused("empty.glb", "a mesh without primitives", _set(meshes=[{"primitives": []}])),
    refused("cycle.glb", "a node that is its own child", _node(children=[0])),
    refused("loop.glb", "two nodes that are each other's children", _set(nodes=_LOOP)),
    works("deep.glb", "3000 nodes below each other", _set(nodes=_DEEP), faces=80),
    refused("flat.glb", "a node of scale 0", _node(scale=[0, 0, 0]), "no extent"),
    works("mirror.glb", "a mirrored node", _node(scale=[-1, 1, 1]), faces=80),
    refused("nanmatrix.glb", "a node's matrix with a word in it", _node(matrix=["x"] * 16)),
    refused("short.glb", "a node's matrix of three numbers", _node(matrix=[1, 0, 0])),
    works("twice.glb", "two nodes that show one mesh", _odd(_twice), faces=160, vertices=84),
    works("names.glb", "a node with markup for a name", _node(name=_MARKUP), faces=80),
    works("version1.glb", "version 1", _set(asset={"version": "1.0"}), faces=80),
    refused("list.gltf", "JSON that is a list", b"[1, 2]"),
    refused("nest.gltf", "JSON nested 100000 deep", b"[" * 10**5),
    works("header.glb", "a wrong length in its header, whole besides", _at_byte(8, 10**9), **BALL),
    refused("chunk.glb", "a chunk of 4 GB", _at_byte(12, 2**32 - 1)),
    works("image.glb", "a texture inside", _odd(_image(_data(_PNG))), faces=80),
    repaired("goneimage.glb", "a texture that isn't there", _odd(_image("gone.png")), "gone.png",
             faces=80),
    repaired("cutimage.glb", "a texture that is cut off", _odd(_image(_data(_PNG[:300]))),
             "texture", faces=80),
    repaired("bombimage.glb", "a texture of 900 million pixels",
             _odd(_image(_data(png_claiming(30000, 30000)))), "texture", faces=80),
    repaired("textimage.glb", "a texture that is text", _odd(_image(_data(TEXT))), "texture",
             faces=80),
    repaired("upimage.gltf", "a texture by ../", _UP_IMAGE, "outside", beside=_SECRET_IMAGE,
             faces=80),
)  # fmt: skip

# ------------------------------------------------------------------------------------- numbers

_KINDS = {"f4": 5126, "u1": 5121, "u2": 5123, "i2": 5122}
Column = tuple[str, np.ndarray, bool]
"""An attribute, its numbers, and whether they are normalised."""


def _columns(*columns: Column, change: Change | None = None) -> bytes:
    """The ball with more attributes, then changed."""
    document, buffer = gltf_parts()
    for attribute, values, normalised in columns:
        buffer += bytes(-len(buffer) % 4)
        content = np.ascontiguousarray(values)
        document["bufferViews"].append(
            {"buffer": 0, "byteOffset": len(buffer), "byteLength": content.nbytes}
        )
        buffer += content.tobytes()
        accessor = {
            "bufferView": len(document["bufferViews"]) - 1,
            "componentType": _KINDS[content.dtype.str[1:]],
            "count": len(content),
            "type": {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}[content.shape[1]],
        }
        document["accessors"].append(accessor | ({"normalized": True} if normalised else {}))
        primitive = document["meshes"][0]["primitives"][0]
        primitive["attributes"][attribute] = len(document["accessors"]) - 1
    document["buffers"][0]["byteLength"] = len(buffer)
    if change is not None:
        change(document)
    return glb(document, buffer)


def _strided(kind: str) -> Change:
    """The first column's elements are shorter than their stride of four numbers' bytes."""

    def change(document: dict) -> None:
        document["accessors"][2]["type"] = kind
        document["bufferViews"][2]["byteStride"] = 8 if kind == "VEC3" else 4
        if kind == "VEC3":
            document["extensionsRequired"] = document["extensionsUsed"] = ["KHR_mesh_quantization"]

    return change


def _sparse(document: dict) -> None:
    # The first column's view holds the indices, the second's the values.
    document["accessors"][0]["sparse"] = {
        "count": 3,
        "indices": {"bufferView": 2, "componentType": 5121},
        "values": {"bufferView": 3},
    }
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    del attributes["_INDICES"], attributes["_VALUES"]


def _stride(document: dict) -> None:
    document["bufferViews"][0]["byteStride"] = 4


def _instances(document: dict) -> None:
    document["nodes"] = [{"mesh": 0}] * 100_000
    document["scenes"] = [{"nodes": list(range(100_000))}]


def _diamond(document: dict) -> None:
    document["nodes"] = [*({"children": [k + 1, k + 1]} for k in range(60)), {"mesh": 0}]


def _instancing(document: dict) -> None:
    document["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": {}}}


_SHARE = (V[:, :2] + 1) / 2
_COLOR = ((V + 1) / 2 * 65535).astype("<u2")
_UV = ("TEXCOORD_0", _SHARE.astype("<f4"), False)
_UV_BYTES = ("TEXCOORD_0", np.pad((_SHARE * 255).astype("u1"), ((0, 0), (0, 2))), True)
_UV_SHORTS = ("TEXCOORD_0", (_SHARE * 65535).astype("<u2"), True)
_SECOND_UV = ("TEXCOORD_1", _SHARE[::-1].astype("<f4"), False)
_NORMAL = ("NORMAL", V.astype("<f4"), False)
_TANGENT = ("TANGENT", np.pad(V[:, [1, 2, 0]], ((0, 0), (0, 1)), constant_values=1).astype("<f4"),
            False)  # fmt: skip
_OPAQUE = ("COLOR_0", np.pad(_COLOR, ((0, 0), (0, 1)), constant_values=65535), True)
_COLOR_FLOATS = ("COLOR_0", (_COLOR / 65535).astype("<f4"), False)
_POSITION = ("POSITION", np.pad(np.round(V * 32767).astype("<i2"), ((0, 0), (0, 1))), True)
_VALUES = ("_VALUES", (V[[1, 5, 7]] * 1.1).astype("<f4"), False)


def _indices(*values: int) -> Column:
    return "_INDICES", np.array(values, "u1")[:, None], False


NUMBERS = group(
    "numbers of glTF",
    works("uvfloat.glb", "texture coordinates without a material", _columns(_UV), **BALL),
    works("uvbyte.glb", "texture coordinates of 8 bits, in strides",
          _columns(_UV_BYTES, change=_strided("VEC2")), **BALL),
    works("uvshort.glb", "texture coordinates of 16 bits", _columns(_UV_SHORTS), **BALL),
    works("color16.glb", "colours of 16 bits", _columns(_OPAQUE), **BALL),
    works("colorfloat.glb", "colours of floats, without opacity", _columns(_COLOR_FLOATS), **BALL),
    works("second.glb", "a second set of texture coordinates, tangents",
          _columns(_UV, _SECOND_UV, _NORMAL, _TANGENT), **BALL),
    works("quantised.glb", "positions of 16 bits (KHR_mesh_quantization)",
          _columns(_POSITION, change=_strided("VEC3")), **BALL),
    works("sparse.glb", "sparse positions", _columns(_indices(1, 5, 7), _VALUES, change=_sparse),
          **BALL),
    refused("sparsebeyond.glb", "a sparse position beyond the last",
            _columns(_indices(1, 5, 99), _VALUES, change=_sparse), "element 99 of 42"),
    refused("fewcolors.glb", "fewer colours than vertices", _columns(("COLOR_0", _COLOR[:9], True)),
            "9 elements"),
    refused("stride.glb", "a stride shorter than its elements", _columns(change=_stride),
            "it contains"),
    refused("instances.glb", "a hundred thousand nodes that show one mesh",
            _columns(change=_instances), "too often"),
    refused("diamond.glb", "nodes below two others, 2^60 ways to the mesh",
            _columns(change=_diamond), "child of two nodes"),
    refused("instancing.glb", "instances by an extension that isn't required",
            _columns(change=_instancing), "EXT_mesh_gpu_instancing"),
)  # fmt: skip
