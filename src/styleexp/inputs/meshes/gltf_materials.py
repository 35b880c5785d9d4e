"""A glTF file's images, and its materials as far as other formats support them."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from styleexp.inputs import images
from styleexp.inputs.meshes.accessors import item
from styleexp.inputs.meshes.references import Beside, resolved
from styleexp.system.errors import UserError


class Materials:
    """Reads images lazily, once; collects notes on unavailable ones.

    ``beside`` holds the contents of external files, None for unavailable ones.
    """

    def __init__(
        self, tree: dict[str, Any], buffers: list[bytes], folder: Beside, notes: list[str]
    ) -> None:
        self.tree, self.notes = tree, notes
        self.beside: dict[int, bytes | None] = {}
        self.pictures: dict[int, Any] = {}
        for k, image in enumerate(tree.get("images", ())):
            content = self._content(k, image, buffers, folder)
            # GPU formats such as Basis Universal are kept, not decoded.
            if content is None or content.startswith(b"\xabKTX"):
                continue
            if fault := images.fault(content):
                self.notes.append(
                    f"kept the texture {self._label(k, image)} in GLB only: it {fault}"
                )
            else:
                self.pictures[k] = content

    def _label(self, index: int, image: dict[str, Any]) -> str:
        uri = image.get("uri", "data:")
        return f"'{image.get('name') or (index if uri.startswith('data:') else uri)}'"

    def _content(
        self, index: int, image: dict[str, Any], buffers: list[bytes], folder: Beside
    ) -> bytes | None:
        uri = image.get("uri")
        if uri is None:
            view = item(self.tree, "bufferViews", image.get("bufferView"))
            item(self.tree, "buffers", view["buffer"])
            start = view.get("byteOffset", 0)
            return buffers[view["buffer"]][start : start + view["byteLength"]]
        try:
            content = resolved(uri, folder)
        except UserError as error:
            content = None
            reason = (
                str(error).split(":")[0] if not uri.startswith("data:") else "a broken data URI"
            )
            self.notes.append(f"saved without a texture: {reason}")
        if content is None or not uri.startswith("data:"):
            self.beside[index] = content
        return content

    def chosen(self, number: np.ndarray) -> tuple[tuple[Any, ...], np.ndarray]:
        """trimesh materials used by faces' material numbers (-1: none), and each face's index into
        them."""
        used, place = np.unique(number, return_inverse=True)
        first = int(len(used) > 0 and used[0] < 0)
        return tuple(self._made(int(k)) for k in used[first:]), place.ravel() - first

    def _made(self, index: int) -> Any:
        from PIL import Image
        from trimesh.visual.material import PBRMaterial

        material = item(self.tree, "materials", index)
        surface = material.get("pbrMetallicRoughness", {})
        picture = None
        if "baseColorTexture" in surface:
            texture = item(self.tree, "textures", surface["baseColorTexture"].get("index"))
            content = self.pictures.get(texture.get("source", -1))
            picture = None if content is None else Image.open(io.BytesIO(content))
        return PBRMaterial(
            name=str(material.get("name") or f"material {index}"),
            baseColorFactor=surface.get("baseColorFactor"),
            baseColorTexture=picture,
            metallicFactor=surface.get("metallicFactor"),
            roughnessFactor=surface.get("roughnessFactor"),
            emissiveFactor=material.get("emissiveFactor"),
            alphaMode=material.get("alphaMode"),
            doubleSided=bool(material.get("doubleSided", False)),
        )
