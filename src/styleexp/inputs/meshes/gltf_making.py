"""Write a new GLB for a mesh that was not loaded from glTF."""

from __future__ import annotations

import io
import re
from typing import Any

import numpy as np

from styleexp.inputs.meshes.gltf_writing import DISPLACEMENT, container
from styleexp.inputs.meshes.mesh import Carrier

KINDS = {"u1": 5121, "u2": 5123, "u4": 5125, "f4": 5126}
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
VERTEX, INDEX = 34962, 34963
"""Buffer view targets."""


def new_glb(
    carrier: Carrier,
    runs: list[tuple[int, int, np.ndarray]],
    points: np.ndarray,
    normals: np.ndarray,
    displacement: np.ndarray | None,
) -> bytes:
    """Make a GLB with one node and mesh per part, and one primitive per material.

    ``runs`` are part, material (-1 for none) and faces. ``points`` (rows, 3), unit ``normals``
    (rows, 3) and ``displacement`` (rows,), written as ``_DISPLACEMENT``, are per row.
    """
    pieces: dict[int, dict[int, list[np.ndarray]]] = {}
    for part, material, run in runs:
        pieces.setdefault(part, {}).setdefault(material, []).append(run)
    file = _File()
    used = {material: k for k, material in enumerate(sorted({m for _, m, _ in runs if m >= 0}))}
    for material in used:
        file.material(carrier.materials[material], textured=carrier.uv is not None)
    if carrier.uv is not None and any(material < 0 for _, material, _ in runs):
        used[-1] = file.plain_material()  # without a material, some readers drop the UVs
    for part, by_material in pieces.items():
        primitives = []
        for material, faces in by_material.items():
            rows, corners, colors = _rows(carrier, np.concatenate(faces))
            columns = {"POSITION": points[rows], "NORMAL": normals[rows]}
            if carrier.uv is not None:
                columns["TEXCOORD_0"] = carrier.uv[rows] * [1, -1] + [0, 1]
            if displacement is not None:
                columns[DISPLACEMENT] = displacement[rows]
            columns |= {name: values[rows] for name, values in _own(carrier).items()}
            attributes = {name: file.floats(name, values) for name, values in columns.items()}
            if colors is not None:
                attributes["COLOR_0"] = file.accessor(colors, VERTEX, normalized=True)
            small = len(rows) < 65535  # 65535 is not a valid index
            indices = corners.reshape(-1, 1).astype(np.uint16 if small else np.uint32)
            primitive = {"attributes": attributes, "indices": file.accessor(indices, INDEX)}
            if material in used:
                primitive["material"] = used[material]
            primitives.append(primitive)
        file.node(carrier.parts[part], primitives)
    return file.glb()


def _own(carrier: Carrier) -> dict[str, np.ndarray]:
    """Custom vertex attributes, renamed to be valid in glTF."""
    return {
        "_" + re.sub(r"\W", "_", name).upper(): values
        for name, values in carrier.attributes.items()
        if values.shape[1] in TYPES
    }


def _rows(carrier: Carrier, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, Any]:
    """The rows used by some faces, the faces indexed into them, and the rows' colours, if any.

    glTF has no face colours, so rows are duplicated for each adjacent colour.
    """
    corners = carrier.corners[faces]
    if carrier.colors is not None or carrier.face_colors is None:
        rows, inverse = np.unique(corners, return_inverse=True)
        colors = None if carrier.colors is None else carrier.colors[rows]
        return rows, inverse.reshape(-1, 3), colors
    each = np.repeat(carrier.face_colors[faces], 3, axis=0)
    table, inverse = np.unique(
        np.column_stack([corners.ravel(), each]), axis=0, return_inverse=True
    )
    return table[:, 0], inverse.reshape(-1, 3), table[:, 1:].astype(np.uint8)


class _File:
    def __init__(self) -> None:
        self.binary = bytearray()
        self.tree: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "styleexp"},
            "scene": 0,
            "scenes": [{"nodes": []}],
        }
        self.images: dict[int, int] = {}

    def _add(self, kind: str, entry: dict[str, Any]) -> int:
        self.tree.setdefault(kind, []).append(entry)
        return len(self.tree[kind]) - 1

    def _view(self, data: bytes, **more: int) -> int:
        self.binary += bytes(-len(self.binary) % 4)
        start = len(self.binary)
        self.binary += data
        entry = {"buffer": 0, "byteOffset": start, "byteLength": len(data), **more}
        return self._add("bufferViews", entry)

    def accessor(self, values: np.ndarray, target: int, **more: Any) -> int:
        """Add an accessor for ``values`` (count, components); return its index."""
        kind = values.dtype.str[1:]
        entry = {
            "bufferView": self._view(values.astype(f"<{kind}").tobytes(), target=target),
            "componentType": KINDS[kind],
            "count": len(values),
            "type": TYPES[values.shape[1]],
        }
        return self._add("accessors", entry | more)

    def floats(self, name: str, values: np.ndarray) -> int:
        """Add a float attribute's accessor; positions also get bounds."""
        values = values.reshape(len(values), -1).astype(np.float32)
        bounds = {}
        if name == "POSITION":
            bounds["min"] = values.min(axis=0).astype(float).tolist()
            bounds["max"] = values.max(axis=0).astype(float).tolist()
        return self.accessor(values, VERTEX, **bounds)

    def node(self, name: str, primitives: list[dict[str, Any]]) -> None:
        """Add a node with a mesh, both with this name."""
        mesh = self._add("meshes", {"name": name, "primitives": primitives})
        self.tree["scenes"][0]["nodes"].append(self._add("nodes", {"name": name, "mesh": mesh}))

    def material(self, material: Any, textured: bool) -> None:
        """Add a trimesh material, with its texture if there are texture coordinates."""
        surface: dict[str, Any] = {}
        if material.baseColorFactor is not None:
            surface["baseColorFactor"] = (np.asarray(material.baseColorFactor) / 255).tolist()
        if material.baseColorTexture is not None and textured:
            surface["baseColorTexture"] = {"index": self._texture(material.baseColorTexture)}
        for key in ("metallicFactor", "roughnessFactor"):
            if getattr(material, key) is not None:
                surface[key] = float(getattr(material, key))
        entry = {"name": material.name or "material", "pbrMetallicRoughness": surface}
        if material.alphaMode is not None:
            entry["alphaMode"] = material.alphaMode
        if material.doubleSided:
            entry["doubleSided"] = True
        self._add("materials", entry)

    def plain_material(self) -> int:
        """Add a material that looks like no material."""
        return self._add("materials", {"name": "material"})

    def _texture(self, image: Any) -> int:
        if id(image) not in self.images:
            out = io.BytesIO()
            kind = "JPEG" if image.format == "JPEG" and image.mode in ("L", "RGB") else "PNG"
            if kind == "JPEG":
                image.save(out, kind, quality="keep")
            else:
                plain = image.mode in ("1", "L", "LA", "P", "RGB", "RGBA", "I;16")
                (image if plain else image.convert("RGBA")).save(out, kind)
            view = self._view(out.getvalue())
            source = self._add("images", {"bufferView": view, "mimeType": f"image/{kind.lower()}"})
            self.images[id(image)] = self._add("textures", {"source": source})
        return self.images[id(image)]

    def glb(self) -> bytes:
        """The content of the GLB file."""
        self.tree["buffers"] = [{"byteLength": len(self.binary)}]
        return container(self.tree, bytes(self.binary))
