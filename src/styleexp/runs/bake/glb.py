"""Write a mesh with its baked maps as one GLB."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from styleexp.inputs.meshes.gltf import base_uv, parse
from styleexp.inputs.meshes.gltf_writing import container
from styleexp.inputs.meshes.obj import surface
from styleexp.inputs.meshes.writing import glb_as_it_is
from styleexp.runs.bake.files import png

if TYPE_CHECKING:
    from styleexp.inputs.meshes import Mesh
    from styleexp.runs.bake import Maps
    from styleexp.runs.bake.low import Low


def glb(low: Low, maps: Maps) -> bytes:
    """A GLB of the mesh, with the normal map and, if there is one, the occlusion map in its
    materials, as 8-bit PNGs, beside what they have already.

    It has the normals that the maps were baked for, and no tangents: glTF's default are
    MikkTSpace's, as here. A glTF file's document stays as it is otherwise.
    """
    tree, binary = parse("glb", glb_as_it_is(_ready(low), low.rows))
    content = bytearray(binary)
    pictures = {"normalTexture": maps.normal / 2 + np.float32(0.5)}
    if maps.occlusion is not None:
        pictures["occlusionTexture"] = maps.occlusion
    textures = {
        key: _texture(tree, content, key, png(each, np.uint8)) for key, each in pictures.items()
    }
    tree["buffers"][0]["byteLength"] = len(content)
    bare: int | None = None
    for primitive in (each for mesh in tree["meshes"] for each in mesh["primitives"]):
        primitive["attributes"].pop("TANGENT", None)
        if "material" not in primitive:
            if bare is None:
                tree.setdefault("materials", []).append({"name": "baked"})
                bare = len(tree["materials"]) - 1
            primitive["material"] = bare
        place = {"texCoord": uv} if (uv := base_uv(tree, primitive)) else {}
        material = tree["materials"][primitive["material"]]
        material.update({key: {"index": index, **place} for key, index in textures.items()})
    return container(tree, bytes(content))


def _ready(low: Low) -> Mesh:
    """The mesh, with a material, and without a document that has other normals or windings."""
    mesh, carrier = low.mesh, low.mesh.carrier
    assert carrier is not None
    document = carrier.document
    if low.own and document and all("NORMAL" in each.attributes for each in document.blocks):
        return mesh
    corners = np.where(carrier.flipped[:, None], carrier.corners[:, ::-1], carrier.corners)
    carrier = replace(carrier, document=None, corners=corners, flipped=np.zeros(len(corners), bool))
    none = np.full(len(corners), -1) if carrier.face_material is None else carrier.face_material
    if (none < 0).any():
        kept = (*carrier.materials, surface("baked"))
        carrier = replace(
            carrier, materials=kept, face_material=np.where(none < 0, len(kept) - 1, none)
        )
    return replace(mesh, carrier=carrier)


def _texture(tree: dict[str, Any], content: bytearray, name: str, picture: bytes) -> int:
    """Add a PNG to a document and its binary chunk; return its texture's index."""
    content += bytes(-len(content) % 4)
    view = {"buffer": 0, "byteOffset": len(content), "byteLength": len(picture)}
    content += picture
    image = {
        "name": name.removesuffix("Texture"),
        "mimeType": "image/png",
        "bufferView": _added(tree, "bufferViews", view),
    }
    return _added(tree, "textures", {"source": _added(tree, "images", image)})


def _added(tree: dict[str, Any], kind: str, entry: dict[str, Any]) -> int:
    tree.setdefault(kind, []).append(entry)
    return len(tree[kind]) - 1
