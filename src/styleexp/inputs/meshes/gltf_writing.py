"""Write a changed surface into its original glTF document, leaving the rest unchanged."""

from __future__ import annotations

import copy
import json
import struct
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np

from styleexp.inputs.meshes import accessors
from styleexp.inputs.meshes.gltf import DRACO, Block, Document, turned
from styleexp.inputs.meshes.gltf_nodes import LOOKS
from styleexp.inputs.meshes.mesh import Carrier
from styleexp.inputs.meshes.references import bare

DISPLACEMENT = "_DISPLACEMENT"
"""Custom attribute name; glTF requires a leading underscore and capitals."""
Content = dict[str, np.ndarray]
"""New values of some of a block's attributes: float32, for all elements."""


def glb_of(
    carrier: Carrier,
    points: np.ndarray,
    moved: np.ndarray,
    normals: np.ndarray,
    displacement: np.ndarray | None,
) -> bytes:
    """Make a GLB of the carrier's document with its rows at ``points`` (rows, 3), in world space.

    Only ``moved`` rows (rows,) get new positions, and only they and their neighbours get new
    normals (rows, 3), so an unmoved surface is stored bit for bit. Nodes that shared a mesh and now
    differ get separate meshes. ``displacement`` (rows,) is written as ``_DISPLACEMENT``.
    """
    document: Document = carrier.document
    near = np.zeros(len(points), dtype=bool)
    near[carrier.corners[moved[carrier.corners].any(axis=1)]] = True
    near = np.isin(carrier.rows, carrier.rows[near])  # include all rows of a seam
    writer = _Writer(document)
    start = 0
    by_node: dict[int, list[tuple[Block, Content]]] = {}
    for block in document.blocks:
        rows = slice(start, start + len(block.used))
        start = rows.stop
        content = _content(document, block, points[rows], moved[rows], normals[rows], near[rows])
        if displacement is not None:
            count = accessors.count_of(document.tree, block.attributes["POSITION"])
            content[DISPLACEMENT] = np.zeros((count, 1), np.float32)
            content[DISPLACEMENT][block.used, 0] = displacement[rows]
        by_node.setdefault(block.node, []).append((block, content))
    writer.put_all(by_node)
    return writer.glb()


def _content(
    document: Document,
    block: Block,
    points: np.ndarray,
    moved: np.ndarray,
    normals: np.ndarray,
    near: np.ndarray,
) -> Content:
    content: Content = {}
    linear = block.matrix[..., :3, :3]
    if moved.any():
        positions = accessors.real(document.tree, document.buffers, block.attributes["POSITION"])
        inverse = np.linalg.pinv(linear)
        local = turned(inverse.swapaxes(-1, -2), points - block.matrix[..., :3, 3]) - block.morph
        positions[block.used[moved]] = local[moved]
        content["POSITION"] = positions.astype(np.float32)
    if near.any() and "NORMAL" in block.attributes:
        values = accessors.real(document.tree, document.buffers, block.attributes["NORMAL"])
        own = turned(linear, normals)
        own /= np.maximum(np.linalg.norm(own, axis=1, keepdims=True), 1e-300)
        values[block.used[near]] = own[near]
        content["NORMAL"] = values.astype(np.float32)
    return content


class _Writer:
    def __init__(self, document: Document) -> None:
        self.original = document.tree
        self.tree = copy.deepcopy(document.tree)
        self.buffers = [*document.buffers, b""]  # the last buffer is for new data
        self.uses = Counter(_references(document.tree))
        # Unknown extensions may also refer to accessors and views.
        self.known = all(LOOKS.fullmatch(str(x)) for x in document.tree.get("extensionsUsed", ()))
        self.views = Counter(_view_references(document.tree))
        self.absent: set[int] = set()
        for index, content in (document.images or {}).items():
            self._image(index, content)

    def put_all(self, by_node: dict[int, list[tuple[Block, Content]]]) -> None:
        """Store every node's new content in its mesh, or in a copy if other nodes still use the old
        one."""
        shown: dict[int, list[int]] = {}
        for k, node in enumerate(self.original["nodes"]):
            if "mesh" in node:
                shown.setdefault(node["mesh"], []).append(k)
        for mesh, nodes in shown.items():
            variants: dict[Any, list[int]] = {}
            for k in nodes:
                variants.setdefault(_key(by_node.get(k, ())), []).append(k)
            place: int | None = mesh
            for key, members in sorted(variants.items(), key=lambda pair: bool(pair[0])):
                if place is None:
                    place = len(self.tree["meshes"])
                    self.tree["meshes"].append(copy.deepcopy(self.original["meshes"][mesh]))
                if key:
                    self._put(place, by_node[members[0]], alone=len(variants) == 1)
                for k in members:
                    self.tree["nodes"][k]["mesh"] = place
                place = None

    def _put(self, mesh: int, blocks: list[tuple[Block, Content]], alone: bool) -> None:
        for block, content in blocks:
            given = [self.tree["meshes"][mesh]["primitives"][k] for k in block.primitives]
            changed = "POSITION" in content or "NORMAL" in content
            new = {}
            for name, values in content.items():
                old = block.attributes.get(name) if alone else None
                if old is not None and (not self.known or self.uses[old] != len(given)):
                    old = None
                new[name] = self._accessor(values, old, bounds=name == "POSITION")
            for primitive in given:
                if changed:
                    for name in ("TANGENT", DISPLACEMENT):
                        primitive["attributes"].pop(name, None)
                    # The Draco copy holds the old mesh.
                    primitive.get("extensions", {}).pop(DRACO, None)
                    if primitive.get("extensions") == {}:
                        del primitive["extensions"]
                primitive["attributes"].update(new)
        if DRACO in self.tree.get("extensionsUsed", ()) and DRACO not in json.dumps(
            self.tree["meshes"]
        ):
            self.tree["extensionsUsed"].remove(DRACO)
            if not self.tree["extensionsUsed"]:
                del self.tree["extensionsUsed"]

    def _accessor(self, values: np.ndarray, old: int | None, bounds: bool) -> int:
        """Add a float accessor of ``values`` (count, components), reusing a freed index."""
        view = None
        if old is not None and "bufferView" in self.original["accessors"][old]:
            view = self.original["accessors"][old]["bufferView"]
            view = view if self.views[view] == 1 else None
        accessor: dict[str, Any] = {
            "bufferView": self._view(values.astype("<f4").tobytes(), view, target=34962),
            "componentType": 5126,
            "count": len(values),
            "type": "SCALAR" if values.shape[1] == 1 else f"VEC{values.shape[1]}",
        }
        if bounds:
            accessor |= {
                "min": values.min(axis=0).astype(float).tolist(),
                "max": values.max(axis=0).astype(float).tolist(),
            }
        if old is None:
            self.tree["accessors"].append(accessor)
            return len(self.tree["accessors"]) - 1
        kept = self.tree["accessors"][old]
        for key in ("byteOffset", "normalized", "sparse", "min", "max"):
            kept.pop(key, None)
        kept.update(accessor)
        return old

    def _view(self, data: bytes, old: int | None = None, target: int | None = None) -> int:
        start = len(self.buffers[-1])
        self.buffers[-1] += data + bytes(-len(data) % 4)
        views = self.tree.setdefault("bufferViews", [])
        view = {"buffer": len(self.buffers) - 1, "byteOffset": start, "byteLength": len(data)}
        if target is not None:
            view["target"] = target
        if old is None:
            views.append(view)
            return len(views) - 1
        views[old].pop("byteStride", None)
        views[old].pop("extensions", None)
        views[old].update(view)
        return old

    def _image(self, index: int, content: bytes | None) -> None:
        """Embed an external image in the GLB. An unavailable one becomes an unreferenced grey
        pixel, so that the other images keep their indices."""
        image = self.tree["images"][index]
        image.setdefault("name", bare(image.pop("uri")))
        image.pop("uri", None)
        if content is None:
            content = GREY
            lost = {
                k
                for k, texture in enumerate(self.tree.get("textures", ()))
                if texture.get("source") == index
            }
            for material in self.tree.get("materials", ()):
                _without(material, lost)
        image["bufferView"] = self._view(content)
        image["mimeType"] = _mime(content) or image.get("mimeType", "image/png")

    def glb(self) -> bytes:
        """The content of the GLB file."""
        binary = _packed(self.tree, self.buffers)
        if binary:
            first = {k: v for k, v in (self.tree.get("buffers") or [{}])[0].items() if k != "uri"}
            self.tree["buffers"] = [{**first, "byteLength": len(binary)}]
        else:
            self.tree.pop("buffers", None)
        return container(self.tree, binary)


def container(tree: dict[str, Any], binary: bytes) -> bytes:
    """Pack a document and its single buffer as a GLB (glTF 2.0, 4)."""
    text = json.dumps(tree, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    if binary:
        binary += bytes(-len(binary) % 4)
        chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _key(blocks: Any) -> Any:
    return tuple(
        (name, values.tobytes()) for _, content in blocks for name, values in content.items()
    )


def _packed(tree: dict[str, Any], buffers: list[bytes]) -> bytes:
    """Merge all bytes that views refer to into one buffer, in order, and update the views.

    Adjacent or overlapping views stay so, and offsets are preserved modulo 8.
    """
    views = [view for view in tree.get("bufferViews", ()) for view in _spans(view)]
    packed = bytearray()
    for number, content in enumerate(buffers):
        own = sorted(
            (v for v in views if v["buffer"] == number), key=lambda v: v.get("byteOffset", 0)
        )
        reached, shift = -1, 0
        moves = []
        for view in own:
            start = view.get("byteOffset", 0)
            stop = start + view["byteLength"]
            if start > reached:
                packed += bytes((start - len(packed)) % 8)
                shift, reached = len(packed) - start, start
            if stop > reached:
                packed += content[reached:stop]
                reached = stop
            moves.append((view, start + shift))
        for view, start in moves:
            view["buffer"] = 0
            if start or "byteOffset" in view:
                view["byteOffset"] = start
    return bytes(packed)


def _spans(view: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """A buffer view, and view-like objects in its extensions."""
    yield view
    for extension in view.get("extensions", {}).values():
        if isinstance(extension, dict) and {"buffer", "byteLength"} <= extension.keys():
            yield extension


def _references(tree: dict[str, Any]) -> Iterator[int]:
    """Yield every reference to an accessor in core glTF."""
    for mesh in tree.get("meshes", ()):
        for primitive in mesh.get("primitives", ()):
            yield from primitive.get("attributes", {}).values()
            if "indices" in primitive:
                yield primitive["indices"]
            for target in primitive.get("targets", ()):
                yield from target.values()
    for animation in tree.get("animations", ()):
        for sampler in animation.get("samplers", ()):
            yield from (sampler.get("input"), sampler.get("output"))
    for skin in tree.get("skins", ()):
        yield skin.get("inverseBindMatrices")


def _view_references(tree: dict[str, Any]) -> Iterator[int]:
    for accessor in tree.get("accessors", ()):
        sparse = accessor.get("sparse", {})
        for holder in (accessor, sparse.get("indices", {}), sparse.get("values", {})):
            yield holder.get("bufferView", -1)
    for image in tree.get("images", ()):
        yield image.get("bufferView", -1)


def _without(material: Any, textures: set[int]) -> None:
    """Remove, at any depth, references to the given textures."""
    entries = material if isinstance(material, dict) else {}
    for key, value in list(entries.items()):
        lost = isinstance(value, dict) and value.get("index") in textures
        if lost and key.lower().endswith("texture"):
            del entries[key]
        else:
            _without(value, textures)


def _mime(content: bytes) -> str | None:
    for start, kind in (
        (b"\x89PNG", "png"),
        (b"\xff\xd8\xff", "jpeg"),
        (b"\xabKTX 20", "ktx2"),
        (b"RIFF", "webp"),
    ):
        if content.startswith(start):
            return f"image/{kind}"
    return None


def _pixel() -> bytes:
    import zlib

    def chunk(kind: bytes, body: bytes) -> bytes:
        return (
            struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        )

    head = struct.pack(">IIBBBBB", 1, 1, 8, 0, 0, 0, 0)
    data = zlib.compress(b"\0\x80")
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


GREY = _pixel()
