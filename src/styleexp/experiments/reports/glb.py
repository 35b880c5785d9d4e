"""Small GLB files for pages: quantised geometry, with optional heat map and wireframe.

A file has up to three nodes: the surface in one colour, the surface coloured by a per-vertex value,
and its edges. The default scene shows the first; a page shows others by changing the scene's list
of nodes (``viewers.js``). Positions and normals are 16-bit integers (KHR_mesh_quantization), in
steps of 1/32767 of the largest coordinate, far below a pixel.
"""

from __future__ import annotations

import io
import json
import struct
from typing import TYPE_CHECKING, Any

import numpy as np

from styleexp.inputs import meshes

if TYPE_CHECKING:
    from jaxtyping import Float, Int

SURFACE, HEAT, EDGES = 0, 1, 2
"""Node indices."""

WIREFRAME_FACES = 300_000
"""Meshes with more faces get no wireframe: it would cover the whole surface."""

CLAY = (0.47, 0.45, 0.42)
"""Linear base colour of the surface."""

INK = (0.02, 0.05, 0.12)
"""Linear colour of the edges."""

DIVERGING = ((0.09, 0.24, 0.60), (0.42, 0.66, 0.90), (0.93, 0.93, 0.91), (0.93, 0.60, 0.40),
             (0.62, 0.10, 0.12))  # fmt: skip
"""sRGB colours of the heat map, from inward (-1) through zero to outward (+1)."""


def glb(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    extent: float,
    values: Float[np.ndarray, " vertices"] | None = None,
    bare: bool = False,
) -> bytes:
    """Make a binary glTF 2.0 file.

    ``extent`` bounds the magnitude of every coordinate; compared meshes share it, so that equal
    positions stay equal. ``values`` in [-1, 1] select the heat map's colours. ``bare`` leaves out
    the edges and, without ``values``, the second surface.
    """
    normals = meshes.vertex_normals(vertices, faces)
    buffer = _Buffer()
    attributes = {
        "POSITION": buffer.vectors(vertices / extent, bounds=True),
        "NORMAL": buffer.vectors(normals),
    }
    triangles = buffer.indices(faces)
    surface = {"attributes": attributes, "indices": triangles, "material": 0}
    primitives: list[dict[str, Any]] = [surface]
    materials = [_material(CLAY)]
    extra: dict[str, Any] = {}
    if values is not None:
        coloured = attributes | {"TEXCOORD_0": buffer.coordinates((values + 1) / 2)}
        primitives.append({"attributes": coloured, "indices": triangles, "material": 1})
        materials.append(_material((1.0, 1.0, 1.0)))
        materials[1]["pbrMetallicRoughness"]["baseColorTexture"] = {"index": 0}
        extra = {
            "textures": [{"source": 0, "sampler": 0}],
            "samplers": [{"magFilter": 9729, "minFilter": 9729, "wrapS": 33071, "wrapT": 33071}],
            "images": [{"bufferView": buffer.view(_colour_strip()), "mimeType": "image/png"}],
        }
    elif not bare:
        primitives.append(surface)  # so that the edges are always node 2
    if len(faces) <= WIREFRAME_FACES and not bare:
        lines = buffer.indices(meshes.edges_of(faces))
        materials.append(_material(INK) | {"extensions": {"KHR_materials_unlit": {}}})
        primitives.append(
            {
                "attributes": {"POSITION": attributes["POSITION"]},
                "indices": lines,
                "material": len(materials) - 1,
                "mode": 1,
            }
        )
    nodes = [{"mesh": index, "scale": [extent] * 3} for index in range(len(primitives))]
    return buffer.file(
        {
            "asset": {"version": "2.0", "generator": "styleexp"},
            "extensionsUsed": ["KHR_mesh_quantization", "KHR_materials_unlit"],
            "extensionsRequired": ["KHR_mesh_quantization"],
            "scene": 0,
            "scenes": [{"nodes": [SURFACE]}],
            "nodes": nodes,
            "meshes": [{"primitives": [primitive]} for primitive in primitives],
            "materials": materials,
            **extra,
        }
    )


def diverging(values: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """Map values in [-1, 1] to sRGB in [0, 1]."""
    knots = np.linspace(-1, 1, len(DIVERGING))
    return np.stack([np.interp(values, knots, [c[k] for c in DIVERGING]) for k in range(3)], axis=1)


def gradient() -> str:
    """The heat map's colours as stops of a CSS gradient."""
    stops = (diverging(np.linspace(-1, 1, 9)) * 255).round().astype(int).tolist()
    return ", ".join(f"rgb({r} {g} {b})" for r, g, b in stops)


def _colour_strip() -> bytes:
    from PIL import Image

    row = (diverging(np.linspace(-1, 1, 256)) * 255).round().astype(np.uint8)
    out = io.BytesIO()
    Image.fromarray(row[None]).save(out, "PNG")
    return out.getvalue()


def _material(colour: tuple[float, float, float]) -> dict[str, Any]:
    return {
        "doubleSided": True,
        "pbrMetallicRoughness": {
            "baseColorFactor": [*colour, 1.0],
            "metallicFactor": 0.0,
            "roughnessFactor": 0.75,
        },
    }


class _Buffer:
    """The binary chunk, with its views and accessors."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.size = 0
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, content: bytes, **more: Any) -> int:
        self.views.append(
            {"buffer": 0, "byteOffset": self.size, "byteLength": len(content), **more}
        )
        padding = -len(content) % 4
        self.parts += [content, bytes(padding)]
        self.size += len(content) + padding
        return len(self.views) - 1

    def vectors(self, rows: np.ndarray, bounds: bool = False) -> int:
        """Add (n, 3) in [-1, 1] as normalised int16, padded to 8 bytes per row as glTF requires."""
        stored = np.zeros((len(rows), 4), np.int16)
        stored[:, :3] = np.clip(np.rint(rows * 32767), -32767, 32767)
        view = self.view(stored.tobytes(), byteStride=8, target=34962)
        accessor: dict[str, Any] = {"bufferView": view, "componentType": 5122, "normalized": True}
        accessor |= {"count": len(rows), "type": "VEC3"}
        if bounds:
            accessor["min"] = stored[:, :3].min(axis=0).tolist()
            accessor["max"] = stored[:, :3].max(axis=0).tolist()
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def coordinates(self, u: np.ndarray) -> int:
        """Add u in [0, 1] as texture coordinates (u, 0.5)."""
        stored = np.full((len(u), 2), 32768, np.uint16)
        stored[:, 0] = np.rint(np.clip(u, 0, 1) * 65535)
        view = self.view(stored.tobytes(), byteStride=4, target=34962)
        accessor: dict[str, Any] = {"bufferView": view, "componentType": 5123, "normalized": True}
        self.accessors.append(accessor | {"count": len(u), "type": "VEC2"})
        return len(self.accessors) - 1

    def indices(self, rows: np.ndarray) -> int:
        # 65535 is the primitive restart value in some graphics APIs, so it can't be an index.
        kind = np.uint16 if rows.max(initial=0) < 65535 else np.uint32
        view = self.view(np.ascontiguousarray(rows, kind).tobytes(), target=34963)
        component = 5123 if kind is np.uint16 else 5125
        accessor = {"bufferView": view, "componentType": component}
        self.accessors.append(accessor | {"count": rows.size, "type": "SCALAR"})
        return len(self.accessors) - 1

    def file(self, scene: dict[str, Any]) -> bytes:
        scene |= {"buffers": [{"byteLength": self.size}]}
        scene |= {"bufferViews": self.views, "accessors": self.accessors}
        text = json.dumps(scene, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        head = struct.pack("<4sIIII", b"glTF", 2, 28 + len(text) + self.size, len(text), 0x4E4F534A)
        return b"".join([head, text, struct.pack("<II", self.size, 0x004E4942), *self.parts])
