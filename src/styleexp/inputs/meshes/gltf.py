"""glTF files: the original document, and the surfaces that its scene shows.

The document is kept as plain JSON, so that unknown content (extensions, extras, fields of later
versions) survives unchanged. `gltf_writing` writes a changed surface into it.

Surfaces are read in world space, as a viewer shows the file without animation: with node transforms
(joint transforms for skinned meshes) and morph targets at their default weights.
"""

from __future__ import annotations

import json
import math
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from styleexp.inputs.meshes import accessors, gltf_nodes, precision
from styleexp.inputs.meshes.accessors import MOST_ZEROS, item
from styleexp.inputs.meshes.gltf_materials import Materials
from styleexp.inputs.meshes.mesh import Carrier
from styleexp.inputs.meshes.references import Beside, resolved
from styleexp.inputs.meshes.welding import check_indices, plural
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from jaxtyping import Float, Int

DISPLACEMENT = "_DISPLACEMENT"
"""Custom attribute of a result; a next run overwrites it."""
TRIANGLES, STRIP, FAN = 4, 5, 6
EARLY = "ends too early: copy or export the mesh again."
DRACO = "KHR_draco_mesh_compression"
UNDO = {
    DRACO: "for example with 'npx @gltf-transform/cli copy in.glb out.glb'",
    "EXT_meshopt_compression": "for example with 'npx @gltf-transform/cli copy in.glb out.glb'",
    "EXT_mesh_gpu_instancing": "with a separate node for each copy",
}
"""How to remove an unsupported extension from a file."""


@dataclass(frozen=True)
class Block:
    """Rows of one node's mesh, for all primitives that share the same attributes."""

    node: int
    mesh: int
    primitives: tuple[int, ...]
    attributes: dict[str, int]
    used: Int[np.ndarray, " rows"]
    """Elements of the attributes that faces use; these are the rows."""
    matrix: Float[np.ndarray, "*rows 4 4"]
    """Transform from the mesh's own frame to the world; per row for a skinned mesh."""
    morph: Float[np.ndarray, "rows 3"] | float = 0.0
    """Offset of each row by morph targets, in the mesh's own frame."""


@dataclass(frozen=True)
class Document:
    """A glTF file: its JSON, its buffers, and the origin of each row."""

    tree: dict[str, Any]
    buffers: list[bytes]
    blocks: tuple[Block, ...] = ()
    """Blocks in the order of `Carrier.rows`."""
    images: dict[int, bytes | None] | None = None
    """Contents of external image files; None for those that can't be read."""


def parse(kind: str, data: bytes) -> tuple[dict[str, Any], bytes]:
    """The JSON of a glTF file and, for a GLB, its binary chunk."""
    text, binary = data, b""
    if kind == "glb":
        if data[:4] != b"glTF":
            raise UserError("is not a GLB file: export it again.")
        if len(data) < 20:
            raise UserError(EARLY)
        (length,) = struct.unpack("<I", data[12:16])
        text, rest = data[20 : 20 + length], data[20 + length :]
        if len(text) < length:
            raise UserError(EARLY)
        if len(rest) >= 8 and rest[4:8] == b"BIN\0":
            (length,) = struct.unpack("<I", rest[:4])
            binary = rest[8 : 8 + length]
            if len(binary) < length:
                raise UserError(EARLY)
    try:
        tree = json.loads(text, parse_constant=_no_number, parse_float=_finite)
    except (ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())[:80]
        raise UserError(f"is not valid JSON ({reason}): copy or export the mesh again.") from None
    if not isinstance(tree, dict):
        raise UserError("is JSON, but not glTF: export the mesh again.")
    return tree, binary


def read_gltf(data: bytes, path: Path) -> tuple[np.ndarray, Carrier, list[str]]:
    """Read the rows' positions (rows, 3) in world space, the carrier, and notes."""
    tree, binary = parse(path.suffix.lower()[1:], data)
    _check_extensions(tree)
    beside = Beside(path)
    buffers = [_buffer(b, k, binary, beside) for k, b in enumerate(tree.get("buffers", ()))]
    zeros = sum(a["count"] for a in tree.get("accessors", ()) if "bufferView" not in a)
    if zeros > MOST_ZEROS:
        raise UserError(f"promises {zeros} values that it does not contain: export it again.")
    notes: list[str] = []
    world, parent, shown = gltf_nodes.world(tree)
    _check_size(tree, shown, MOST_ZEROS + len(data) + sum(map(len, buffers)))
    reader = _Reader(tree, buffers)
    materials = Materials(tree, buffers, beside, notes)
    # Not in mesh order, which changes once nodes that shared a mesh differ.
    for node, name in zip(shown, gltf_nodes.names(tree, parent, shown), strict=True):
        reader.node(node, name, world)
    if not reader.blocks:
        nothing = np.zeros((0, 3), dtype=np.int64)
        return reader.loose, Carrier(nothing, nothing, nothing), notes
    notes += reader.left_out()
    notes += _stale(tree, reader.blocks)
    return reader.points(), reader.carrier(materials), notes


class _Reader:
    """Collects the blocks of rows and their columns."""

    def __init__(self, tree: dict[str, Any], buffers: list[bytes]) -> None:
        self.tree, self.buffers = tree, buffers
        self.blocks: list[Block] = []
        self.columns: list[dict[str, np.ndarray]] = []
        self.faces: list[np.ndarray] = []
        self.labels: list[tuple[int, int, int]] = []  # part, material and faces of each primitive
        self.parts: dict[str, int] = {}
        self.loose = np.zeros((0, 3))  # positions, if there are no faces at all
        self.rows = self.unused = self.odd = self.flat = 0

    def node(self, index: int, name: str, world: np.ndarray) -> None:
        """Collect the surfaces of one node."""
        node = self.tree["nodes"][index]
        mesh = item(self.tree, "meshes", node["mesh"])
        extensions = node.get("extensions", {})
        if "EXT_mesh_gpu_instancing" in extensions:
            raise _unread("EXT_mesh_gpu_instancing")
        by_attributes: dict[tuple, list[int]] = {}
        for k, primitive in enumerate(mesh["primitives"]):
            if primitive.get("mode", TRIANGLES) not in (TRIANGLES, STRIP, FAN):
                self.odd += 1
                self.loose = self._positions(primitive)
                continue
            if DRACO in primitive.get("extensions", {}) and "bufferView" not in item(
                self.tree, "accessors", primitive["attributes"]["POSITION"]
            ):
                raise _unread(DRACO)
            key = (*sorted(primitive["attributes"].items()), _morphs(primitive))
            by_attributes.setdefault(key, []).append(k)
        part = self.parts.setdefault(name, len(self.parts))
        for primitives in by_attributes.values():
            self._block(index, node["mesh"], primitives, world, part)

    def _block(
        self, node: int, mesh: int, primitives: list[int], world: np.ndarray, part: int
    ) -> None:
        given = [self.tree["meshes"][mesh]["primitives"][k] for k in primitives]
        attributes = given[0]["attributes"]
        if "POSITION" not in attributes:
            raise UserError(f"has no positions in meshes[{mesh}]: export the mesh again.")
        count = accessors.count_of(self.tree, attributes["POSITION"])
        local = self._positions(given[0])
        faces = [self._faces(primitive, count) for primitive in given]
        used, numbers = np.unique(np.concatenate(faces), return_inverse=True)
        numbers = numbers.reshape(-1, 3) + self.rows
        morph = self._morph(node, mesh, given[0], count)
        skin = self.tree["nodes"][node].get("skin")
        matrix = world[node]
        if skin is not None and "JOINTS_0" in attributes:
            matrix = gltf_nodes.skinning(self.tree, self.buffers, skin, attributes, world)[used]
        block = Block(node, mesh, tuple(primitives), attributes, used, matrix,
                      morph if isinstance(morph, float) else morph[used])  # fmt: skip
        columns = {"points": transformed(matrix, local[used] + block.morph)}
        self.unused += count - len(used)
        determinants = np.linalg.det(matrix[..., :3, :3])
        scale = np.linalg.norm(matrix[..., :3, :3], axis=(-2, -1))
        self.flat += bool((np.abs(determinants) < 1e-9 * scale**3).any())
        for name, column, width in (
            ("NORMAL", "normals", 3),
            (f"TEXCOORD_{base_uv(self.tree, given[0])}", "uv", 2),
            ("COLOR_0", "colors", None),
        ):
            if name in attributes and len(used):
                columns[column] = self._column(attributes[name], count, width)[used]
        for name, accessor in attributes.items():
            if name.startswith("_") and name != DISPLACEMENT and len(used):
                values = accessors.real(self.tree, self.buffers, accessor)
                values = self._column(accessor, count, values.shape[1])[used]
                if values.shape[1] == 3:
                    values = turned(matrix[..., :3, :3].swapaxes(-1, -2), values)
                columns[name] = values
        if "normals" in columns:
            columns["normals"] = turned(np.linalg.pinv(matrix[..., :3, :3]), columns["normals"])
        # A mirrored node reverses the winding (glTF 2.0, 3.7.4).
        mirrored = np.broadcast_to(determinants < 0, len(used))
        numbers = np.where(mirrored[numbers[:, :1] - self.rows], numbers[:, ::-1], numbers)
        self.faces.append(numbers)
        for primitive, own in zip(given, faces, strict=True):
            self.labels.append((part, primitive.get("material", -1), len(own)))
        self.rows += len(used)
        self.blocks.append(block)
        self.columns.append(columns)

    def _column(self, index: int, count: int, width: int | None) -> np.ndarray:
        values = accessors.real(self.tree, self.buffers, index)
        if width is None:  # a colour, always a fraction
            stored = accessors.read(self.tree, self.buffers, index)
            values = values if stored.dtype.kind == "f" else accessors.fraction(stored)
            values = np.pad(values, ((0, 0), (0, max(0, 4 - values.shape[1]))), constant_values=1.0)
            width = 4
        if values.shape != (count, width):
            raise UserError(
                f"has {values.shape[0]} elements of {values.shape[1]} numbers in accessors[{index}]"
                f", but {count} of {width} are needed: export the mesh again."
            )
        return values

    def _positions(self, primitive: dict[str, Any]) -> np.ndarray:
        index = primitive["attributes"]["POSITION"]
        return self._column(index, accessors.count_of(self.tree, index), 3)

    def _faces(self, primitive: dict[str, Any], count: int) -> np.ndarray:
        """Triangles (faces, 3), also from strips and fans, with correct winding (glTF 2.0,
        3.7.2.1)."""
        order = np.arange(count)
        if "indices" in primitive:
            stored = accessors.read(self.tree, self.buffers, primitive["indices"])
            if stored.shape[1] != 1 or stored.dtype.kind != "u":
                raise UserError("has indices that are not unsigned integers: export it again.")
            order = stored[:, 0].astype(np.int64)
        mode = primitive.get("mode", TRIANGLES)
        if mode == TRIANGLES:
            if len(order) % 3:
                raise UserError(
                    f"has {len(order)} corners in a list of triangles: export the mesh again."
                )
            faces = order.reshape(-1, 3)
        else:
            k = np.arange(max(0, len(order) - 2))
            if mode == FAN:
                faces = order[np.stack([k + 1, k + 2, 0 * k], axis=1)]
            else:
                faces = order[np.stack([k, k + 1 + k % 2, k + 2 - k % 2], axis=1)]
                # Repeated indices join separate strips.
                faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
        check_indices(faces, count)
        return faces

    def _morph(
        self, node: int, mesh: int, primitive: dict[str, Any], count: int
    ) -> np.ndarray | float:
        weights = self.tree["nodes"][node].get("weights", self.tree["meshes"][mesh].get("weights"))
        moved: np.ndarray | float = 0.0
        for weight, target in zip(weights or (), primitive.get("targets", ()), strict=False):
            if weight and "POSITION" in target:
                moved = moved + float(weight) * self._column(target["POSITION"], count, 3)
        return moved

    def left_out(self) -> list[str]:
        """Notes on everything that isn't part of the surface."""
        notes = []
        if self.odd:
            number = plural(self.odd, "primitive", "primitives")
            notes.append(f"left {number} of points or lines unchanged (GLB only)")
        if self.unused:
            number = plural(self.unused, "vertex", "vertices")
            notes.append(f"left out {number} that no face uses")
        if self.flat:
            notes.append("has a node with zero scale along an axis: nothing can move along it")
        return notes

    def points(self) -> np.ndarray:
        """Positions of the rows, (rows, 3)."""
        return np.concatenate([columns["points"] for columns in self.columns])

    def carrier(self, materials: Materials) -> Carrier:
        """Everything else about the rows, as a `Carrier`."""
        corners = np.concatenate(self.faces)
        uv = self._joined("uv", np.zeros(2))
        if uv is not None:
            uv[:, 1] = 1.0 - uv[:, 1]
        colors = self._joined("colors", np.ones(4))
        if colors is not None:
            colors = np.clip(np.nan_to_num(colors) * 255, 0, 255).round().astype(np.uint8)
        part, material, number = np.array(self.labels, dtype=np.int64).T
        chosen, face_material = materials.chosen(np.repeat(material, number))
        return Carrier(
            corners,
            np.zeros(self.rows, dtype=np.int64),
            np.zeros(len(corners), dtype=bool),
            precision=precision.of_floats(self.points()),
            uv=uv,
            normals=self._joined("normals", np.zeros(3)),
            colors=colors,
            parts=tuple(self.parts),
            face_part=np.repeat(part, number),
            materials=chosen,
            face_material=face_material,
            attributes=self._attributes(),
            document=Document(self.tree, self.buffers, tuple(self.blocks), materials.beside),
        )

    def _attributes(self) -> dict[str, np.ndarray]:
        """Custom attributes, 0 where a block lacks one; without those whose width differs between
        blocks."""
        widths: dict[str, set[int]] = {}
        for columns in self.columns:
            for name in filter(lambda name: name.startswith("_"), columns):
                widths.setdefault(name, set()).add(columns[name].shape[1])
        found = {}
        for name, given in widths.items():
            values = self._joined(name, np.zeros(min(given))) if len(given) == 1 else None
            if values is not None:
                found[name[1:]] = values
        return found

    def _joined(self, name: str, filler: np.ndarray) -> np.ndarray | None:
        """One attribute for all rows, filled where a block lacks it; None if no block has it."""
        if not any(name in columns for columns in self.columns):
            return None
        return np.concatenate(
            [
                columns.get(name, np.tile(filler, (len(columns["points"]), 1)))
                for columns in self.columns
            ]
        )


def transformed(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Transform points (n, 3) by one matrix (4, 4), or one per point (n, 4, 4)."""
    return turned(matrix[..., :3, :3].swapaxes(-1, -2), points) + matrix[..., :3, 3]


def turned(matrix: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Multiply row vectors (n, 3) by one matrix (3, 3), or one per vector (n, 3, 3)."""
    return np.einsum("...i,...ij->...j", directions, matrix)


def base_uv(tree: dict[str, Any], primitive: dict[str, Any]) -> int:
    """Index of the texture coordinates that the base colour texture uses; 0 if it has none."""
    if "material" not in primitive:
        return 0
    material = item(tree, "materials", primitive["material"])
    texture = material.get("pbrMetallicRoughness", {}).get("baseColorTexture", {})
    return texture.get("texCoord", 0)


def _morphs(primitive: dict[str, Any]) -> str:
    return json.dumps(primitive.get("targets", ()), sort_keys=True)


def _stale(tree: dict[str, Any], blocks: list[Block]) -> list[str]:
    """A note on content that was made for the original mesh and is kept unchanged."""
    shown = [tree["meshes"][b.mesh]["primitives"][b.primitives[0]] for b in blocks]
    found = {
        "morph targets": any(p.get("targets") for p in shown),
        "skins": any("skin" in tree["nodes"][b.node] for b in blocks),
        "animations": bool(tree.get("animations")),
    }
    names = [name for name, there in found.items() if there]
    if not names:
        return []
    joined = " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
    return [f"kept {joined} in the GLB, made for the unchanged mesh: check them"]


def _check_size(tree: dict[str, Any], shown: list[int], most: int) -> None:
    """Limit instancing: a small file may show the same data a million times."""
    sizes: dict[int, int] = {}
    for node in shown:
        mesh = tree["nodes"][node]["mesh"]
        if mesh not in sizes:
            sizes[mesh] = 0
            for primitive in item(tree, "meshes", mesh)["primitives"]:
                used = (primitive.get("attributes", {}).get("POSITION"), primitive.get("indices"))
                for index in used:
                    sizes[mesh] += 0 if index is None else accessors.count_of(tree, index)
        most -= sizes[mesh]
        if most < 0:
            raise UserError("instances its meshes too often for its size: export fewer copies.")


def _check_extensions(tree: dict[str, Any]) -> None:
    for name in tree.get("extensionsRequired", ()):
        if not gltf_nodes.LOOKS.fullmatch(str(name)):
            raise _unread(str(name))


def _unread(name: str) -> UserError:
    how = UNDO.get(name, "export the mesh without it")
    how = f"undo it, {how}" if name in UNDO else how
    return UserError(f"needs the glTF extension {name}, which is not supported: {how}.")


def _buffer(buffer: dict[str, Any], index: int, binary: bytes, beside: Beside) -> bytes:
    length = buffer["byteLength"]
    content = binary if index == 0 else b""
    if "uri" in buffer:
        content = resolved(buffer["uri"], beside)
    if len(content) < length:
        raise UserError(EARLY)
    return content[:length]


def _no_number(word: str) -> float:
    raise ValueError(f"{word} is not a JSON number")


def _finite(word: str) -> float:
    if not math.isfinite(float(word)):
        raise ValueError(f"{word[:20]} is out of range")
    return float(word)
