"""The mesh that maps are baked to: its texture coordinates, its normals and its tangents."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from styleexp.inputs.meshes import vertex_normals
from styleexp.inputs.meshes.mesh import Carrier, at_vertices
from styleexp.runs.bake.tangents import tangents, unit
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from jaxtyping import Float, Int

    from styleexp.inputs.meshes import Mesh

ATLAS = 512
"""Side that xatlas aims for, in its texels."""
GUTTER = 2
"""Texels of it between islands: 8 of a texture of 2048."""


@dataclass(frozen=True)
class Low:
    """A mesh to bake to. Corners are wound as the mesh's faces, counter-clockwise from outside."""

    mesh: Mesh
    uv: Float[np.ndarray, "faces 3 2"]
    smooth: Float[np.ndarray, "vertices 3"]
    """Unit normals along which heights are measured: means of those that the mesh is shaded with,
    without gaps at hard edges."""
    rows: Float[np.ndarray, "rows 3"]
    """Unit normals of the file's rows that it is shaded with."""
    normals: Float[np.ndarray, "faces 3 3"]
    """The same at every corner."""
    tangents: Float[np.ndarray, "faces 3 3"]
    sign: Float[np.ndarray, " faces"]
    """1, or -1 where the texture is mirrored."""
    own: bool
    """Whether the file has the normals that it is shaded with."""


def low(mesh: Mesh) -> Low:
    """A mesh with texture coordinates, ready to bake to. Raises `UserError` if there are none."""
    uv, corners = coordinates(mesh)
    carrier = mesh.carrier
    assert carrier is not None
    smooth = vertex_normals(mesh.vertices, mesh.faces)
    rows, own = smooth[carrier.rows], False
    if carrier.normals is not None and not carrier.flipped.any():
        length = np.linalg.norm(carrier.normals, axis=1, keepdims=True)
        given = length[:, 0] > 0.5  # the filler of parts without normals is zero
        own = bool(given.any())
        rows = np.where(given[:, None], carrier.normals / np.maximum(length, 1e-12), rows)
        mean = at_vertices(mesh, rows)
        whole = np.linalg.norm(mean, axis=1, keepdims=True) > 0.1
        smooth = unit(np.where(whole, mean, smooth))
    normals = rows[corners]
    frame, sign = tangents(mesh.vertices[mesh.faces], normals, uv[corners])
    return Low(mesh, uv[corners], smooth, rows, normals, frame, sign, own)


def coordinates(source: Mesh) -> tuple[Float[np.ndarray, "rows 2"], Int[np.ndarray, "faces 3"]]:
    """The file's texture coordinates, and each face's indices into them, wound as ``source.faces``.

    Raises `UserError` if there are none.
    """
    carrier = source.carrier
    if carrier is None or carrier.uv is None or not has_coordinates(source):
        raise UserError(
            f"the source '{source.name}' has no texture coordinates to bake to: unwrap it (in "
            "Blender: Edit Mode, UV > Smart UV Project), export it as OBJ or GLB and run again; "
            "or let styleexp-bake make them."
        )
    corners = carrier.corners.copy()
    corners[carrier.flipped] = corners[carrier.flipped][:, ::-1]
    return carrier.uv, corners


def has_coordinates(mesh: Mesh) -> bool:
    """Whether a mesh has texture coordinates that span an area."""
    carrier = mesh.carrier
    return carrier is not None and carrier.uv is not None and bool(np.ptp(carrier.uv, axis=0).all())


def unwrapped(mesh: Mesh) -> Mesh:
    """The mesh with new texture coordinates, islands that don't overlap, by xatlas; without the
    glTF or PLY data that belongs to the old rows, and the textures that were made for the old ones.

    Raises `UserError` if xatlas is missing.
    """
    try:
        import xatlas
    except ImportError:
        raise UserError(
            f"making texture coordinates for '{mesh.name}' needs xatlas: pip install "
            "'styleexp[bake]', or unwrap it in the program that made it."
        ) from None
    carrier = mesh.carrier or Carrier(
        mesh.faces,
        np.arange(len(mesh.vertices)),
        np.zeros(len(mesh.faces), bool),
        parts=(mesh.name,),
    )
    middle, extent = mesh.vertices.mean(axis=0), np.ptp(mesh.vertices, axis=0).max()
    points = (mesh.vertices[carrier.rows] - middle) / extent
    atlas, pack = xatlas.Atlas(), xatlas.PackOptions()
    pack.resolution, pack.padding, pack.bruteForce = ATLAS, GUTTER, True
    atlas.add_mesh(points.astype(np.float32), carrier.corners.astype(np.uint32))
    atlas.generate(pack_options=pack)
    old, corners, uv = atlas[0]
    if atlas.atlas_count != 1 or corners.shape != carrier.corners.shape:
        raise UserError(f"xatlas could not unwrap '{mesh.name}': unwrap it in a mesh editor.")
    # One scale for both directions, so that the texture isn't stretched.
    uv = uv * [atlas.width, atlas.height] / max(atlas.width, atlas.height)
    old = old.astype(np.int64)

    def taken(column: np.ndarray | None) -> np.ndarray | None:
        return None if column is None else column[old]

    materials = tuple(_untextured(each) for each in carrier.materials)
    return replace(
        mesh,
        carrier=replace(
            carrier,
            corners=corners.astype(np.int64),
            rows=carrier.rows[old],
            uv=uv.astype(np.float64),
            normals=taken(carrier.normals),
            colors=taken(carrier.colors),
            shades=taken(carrier.shades),
            attributes={name: each[old] for name, each in carrier.attributes.items()},
            materials=materials,
            mtl="",
            textures={},
            ply=None,
            document=None,
        ),
    )


def _untextured(material: object) -> object:
    plain = copy.copy(material)
    plain.baseColorTexture = None  # type: ignore[attr-defined]
    return plain
