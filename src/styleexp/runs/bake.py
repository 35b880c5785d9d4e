"""Bake a run's displacement into textures of its source: a height and a tangent-space normal map.

Texture space: u points right, v up, so v = 1 is the first row of the image; pixel centres are at
(column + 1/2, row + 1/2) / size. Texture coordinates wrap outside [0, 1].

The height map holds the displacement along the source's smooth vertex normals. The normal map holds
the result's smooth normals in the source's tangent space, in the convention of OpenGL, glTF and
Blender: red along u, green along v (up in the image), blue along the normal, each n / 2 + 1/2.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from styleexp.inputs.meshes import vertex_normals
from styleexp.system import atomic
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int, UInt16

    from styleexp.inputs.meshes import Mesh

BATCH = 4_000_000
"""Pixel-face pairs per batch, about 100 MB."""
INSIDE = 1e-3
"""Barycentric distance to an edge below which a pixel doesn't count as overlap."""


@dataclass(frozen=True)
class Maps:
    """Baked maps of shape (size, size), first row at v = 1."""

    height: Float[np.ndarray, "size size"]
    """Displacement in the source's own units; outside the islands, that of the nearest covered
    pixel."""
    normal: Float[np.ndarray, "size size 3"]
    """Unit normals in the source's tangent space."""
    covered: Bool[np.ndarray, "size size"]
    """Pixels whose centre a face covers."""
    overlap: float
    """Fraction of covered pixels with several faces: mirrored or stacked islands."""


def bake(
    source: Mesh,
    displacement: Float[np.ndarray, " vertices"],
    vertices: Float[np.ndarray, "vertices 3"],
    size: int,
) -> Maps:
    """Bake ``displacement`` and the normals of ``vertices``, the result's, into the source's UVs.

    Raises `UserError` for a source without texture coordinates.
    """
    from scipy.ndimage import distance_transform_edt

    uv, corners = coordinates(source)
    base = vertex_normals(source.vertices, source.faces)
    bent = vertex_normals(vertices, source.faces)
    tangent, sign = tangents(source.vertices, source.faces, base, uv, corners)

    height = np.zeros((size, size))
    normal = np.zeros((size, size, 3))
    covered = np.zeros((size, size), bool)
    taken = np.zeros(size * size, np.int64)
    for face, row, column, weights in pixels(uv[corners], size):
        at = row % size, column % size

        def mix(values: np.ndarray, weights: np.ndarray = weights) -> np.ndarray:
            return np.einsum("nk,nk...->n...", weights, values)

        of = source.faces[face]
        height[at] = mix(displacement[of])
        n = _unit(mix(base[of]))
        t = mix(tangent[corners[face]])
        t = _unit(t - n * (n * t).sum(1, keepdims=True))
        b = np.cross(n, t) * sign[face][:, None]
        m = _unit(mix(bent[of]))
        normal[at] = np.stack([(m * each).sum(1) for each in (t, b, n)], axis=1)
        covered[at] = True
        deep = weights.min(axis=1) > INSIDE
        np.add.at(taken, (at[0] * size + at[1])[deep], 1)
    if not covered.any():
        raise UserError(
            f"no pixel of {size} x {size} lies on a face of '{source.name}': its texture "
            "coordinates have no area; unwrap it again."
        )
    # Filtering at an island's border, at any mip level, sees the border's value.
    nearest = distance_transform_edt(~covered, return_distances=False, return_indices=True)
    height, normal = height[tuple(nearest)], normal[tuple(nearest)]
    return Maps(height, normal, covered, (taken > 1).sum() / max(1, (taken > 0).sum()))


def coordinates(source: Mesh) -> tuple[Float[np.ndarray, "rows 2"], Int[np.ndarray, "faces 3"]]:
    """The file's texture coordinates, and each face's indices into them, wound as ``source.faces``.

    Raises `UserError` if there are none.
    """
    carrier = source.carrier
    if carrier is None or carrier.uv is None or not np.ptp(carrier.uv, axis=0).all():
        raise UserError(
            f"the source '{source.name}' has no texture coordinates to bake to: unwrap it (in "
            "Blender: Edit Mode, UV > Smart UV Project), export it as OBJ or GLB and run again, "
            "without source.remesh, which drops them."
        )
    corners = carrier.corners.copy()
    corners[carrier.flipped] = corners[carrier.flipped][:, ::-1]
    return carrier.uv, corners


def tangents(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    normals: Float[np.ndarray, "vertices 3"],
    uv: Float[np.ndarray, "rows 2"],
    corners: Int[np.ndarray, "faces 3"],
) -> tuple[Float[np.ndarray, "rows 3"], Float[np.ndarray, " faces"]]:
    """Tangent (direction of u) at every texture coordinate, and each face's handedness: 1, or -1
    where the texture is mirrored.

    Like MikkTSpace, a face's tangent, projected onto the plane of each corner's normal, is weighted
    by the corner's angle. Coordinates shared by mirrored and unmirrored faces are not split.
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    ua, ub, uc = (uv[corners[:, k]] for k in range(3))
    du, dv = ub - ua, uc - ua
    area = du[:, 0] * dv[:, 1] - du[:, 1] * dv[:, 0]
    sign = np.where(area < 0, -1.0, 1.0)
    along = ((b - a) * dv[:, 1:] - (c - a) * du[:, 1:]) * sign[:, None]
    found = np.zeros((len(uv), 3))
    for k in range(3):
        n = normals[faces[:, k]]
        here, there, third = (vertices[faces[:, (k + i) % 3]] for i in range(3))
        one, two = _unit(there - here), _unit(third - here)
        angle = np.arccos(np.clip((one * two).sum(1), -1, 1))
        flat = _unit(along - n * (n * along).sum(1, keepdims=True))
        np.add.at(found, corners[:, k], flat * angle[:, None])
    return found, sign


def pixels(
    uv: Float[np.ndarray, "faces 3 2"], size: int
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Yield batches of pixel centres covered by faces: faces, rows, columns (not wrapped) and
    barycentric weights (n, 3)."""
    at = uv * size - 0.5  # pixel centres are whole numbers, y up
    low = np.ceil(at.min(axis=1) - 1e-9).astype(np.int64)
    high = np.floor(at.max(axis=1) + 1e-9).astype(np.int64)
    extent = (high - low).max(axis=1) + 1
    e1, e2 = at[:, 1] - at[:, 0], at[:, 2] - at[:, 0]
    double = e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]
    usable = (high >= low).all(axis=1) & (np.abs(double) > 1e-12)
    side = 1
    while usable.any() and side < 2 * extent[usable].max():
        chosen = np.flatnonzero(usable & (extent <= side) & (extent > side // 2))
        step = max(1, BATCH // side**2)
        grid = np.stack(np.meshgrid(np.arange(side), np.arange(side), indexing="ij"), axis=-1)
        for start in range(0, len(chosen), step):
            face = chosen[start : start + step]
            points = low[face][:, None] + grid.reshape(1, -1, 2)
            p = points - at[face, :1]
            f1, f2, whole = e1[face][:, None], e2[face][:, None], double[face][:, None]
            second = (p[..., 0] * f2[..., 1] - p[..., 1] * f2[..., 0]) / whole
            third = (f1[..., 0] * p[..., 1] - f1[..., 1] * p[..., 0]) / whole
            weights = np.stack([1 - second - third, second, third], axis=-1)
            which, where = np.nonzero((weights >= -1e-9).all(axis=-1))
            hit = points[which, where]
            yield face[which], size - 1 - hit[:, 1], hit[:, 0], weights[which, where]
        side *= 2


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300)


# -------------------------------------------------------------------------------------------- files


def write(maps: Maps, folder: Path, kind: str) -> dict[str, Any]:
    """Write ``height`` and ``normal`` as PNG (16 bits a channel) or EXR (32-bit floats) into
    ``folder``; return their description for ``bake.json``."""
    reach = float(np.abs(maps.height).max())
    height, normal = folder / f"height.{kind}", folder / f"normal.{kind}"
    encoded = maps.normal / 2 + 0.5
    if kind == "png":
        scale, level = 2 * reach or 1.0, 0.5
        files = {
            height: png(_sixteen(maps.height / scale + level)),
            normal: png(_sixteen(encoded)),
        }
        for path, content in files.items():
            atomic.write(path, atomic.data(content))
    else:
        scale, level = 1.0, 0.0
        atomic.write(height, lambda at: _write_exr(at, {"Y": maps.height}))
        channels = {name: encoded[..., k] for k, name in enumerate("RGB")}
        atomic.write(normal, lambda at: _write_exr(at, channels))
    return {
        "size": len(maps.height),
        "height": {
            "file": height.name,
            "displacement": "scale * (value - midlevel), along the source's smooth normals, in "
            "the source's own units",
            "midlevel": level,
            "scale": scale,
            "least": float(maps.height.min()),
            "most": float(maps.height.max()),
        },
        "normal": {
            "file": normal.name,
            "space": "tangent",
            "convention": "OpenGL: green is up (+Y); value = n / 2 + 1/2",
        },
        "colour_space": "none: data, not colours",
        "covered": round(float(maps.covered.mean()), 4),
        "overlap": round(maps.overlap, 4),
    }


def _sixteen(values: np.ndarray) -> np.ndarray:
    return np.round(np.clip(values, 0, 1) * 65535).astype(np.uint16)


def png(picture: UInt16[np.ndarray, ...]) -> bytes:
    """Encode a PNG with 16 bits per channel: (height, width) is grey, (height, width, 3) is RGB,
    which Pillow can't write."""
    height, width = picture.shape[:2]
    rows = picture.astype(">u2").reshape(height, -1).view(np.uint8)
    # Filter "up", the difference to the row above: smooth pictures compress much better.
    above = np.vstack([np.zeros_like(rows[:1]), rows[:-1]])
    filtered = np.hstack([np.full((height, 1), 2, np.uint8), rows - above])

    def chunk(kind: bytes, content: bytes) -> bytes:
        check = struct.pack(">I", zlib.crc32(kind + content))
        return struct.pack(">I", len(content)) + kind + content + check

    colours = 2 if picture.ndim == 3 else 0
    head = struct.pack(">IIBBBBB", width, height, 16, colours, 0, 0, 0)
    packed = zlib.compress(filtered.tobytes(), 6)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", packed) + chunk(b"IEND", b"")
    )


def _write_exr(path: Path, channels: dict[str, np.ndarray]) -> None:
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    content = {name: np.ascontiguousarray(each, np.float32) for name, each in channels.items()}
    with OpenEXR.File(header, content) as file:
        file.write(str(path))
