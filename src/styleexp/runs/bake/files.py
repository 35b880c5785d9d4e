"""Write baked maps as pictures: PNG (16 bits a channel) or EXR (32-bit floats)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from styleexp.runs.bake.detail import RAYS, SEED, ahead
from styleexp.system import atomic

if TYPE_CHECKING:
    from jaxtyping import Float

    from styleexp.runs.bake import Maps

WITHIN = 99.5
"""Percentile of the curvature's magnitude that a PNG still tells apart, so that a few sharp corners
don't use up its range."""


def write(maps: Maps, folder: Path, kind: str) -> dict[str, Any]:
    """Write the maps as ``height.png`` or ``.exr`` and so on into ``folder``; return their
    description for ``bake.json``."""
    told: dict[str, Any] = {"size": len(maps.height)}
    pictures = {"normal": maps.normal / 2 + np.float32(0.5)}
    most = float(np.abs(maps.height).max())
    pictures["height"], coding = _signed(maps.height, most, kind)
    told["height"] = {
        "file": f"height.{kind}",
        "displacement": "scale * (value - midlevel), along the mesh's smooth normals, in its own "
        "units",
        **coding,
        "least": float(maps.height.min()),
        "most": float(maps.height.max()),
    }
    told["normal"] = {
        "file": f"normal.{kind}",
        "space": "tangent (MikkTSpace)",
        "convention": "OpenGL: green is up (+Y); value = n / 2 + 1/2",
    }
    if maps.occlusion is not None:
        pictures["occlusion"] = maps.occlusion
        told["occlusion"] = {
            "file": f"occlusion.{kind}",
            "value": "fraction of rays, cosine-weighted, that meet nothing: 1 is open",
            "rays": RAYS,
            "seed": SEED,
        }
    if maps.curvature is not None:
        most = float(np.percentile(np.abs(maps.curvature[maps.covered]), WITHIN))
        pictures["curvature"], coding = _signed(maps.curvature, most, kind)
        told["curvature"] = {
            "file": f"curvature.{kind}",
            "mean_curvature": "scale * (value - midlevel), in 1 / the mesh's own unit; lighter is "
            "convex",
            **coding,
        }
    told["colour_space"] = "none: data, not colours"
    told["covered"] = round(float(maps.covered.mean()), 4)
    told["overlap"] = round(maps.overlap, 4)

    def saved(name: str) -> None:
        atomic.write(folder / f"{name}.{kind}", _writer(pictures[name], kind))

    for _ in ahead(saved, pictures):
        pass
    return told | maps.told


def _signed(values: np.ndarray, most: float, kind: str) -> tuple[np.ndarray, dict[str, float]]:
    """Values from -``most`` to ``most`` as a picture, and how to read it: an EXR holds them as they
    are."""
    if kind == "exr":
        return values, {"midlevel": 0.0, "scale": 1.0}
    scale = 2 * most or 1.0
    return values / np.float32(scale) + np.float32(0.5), {"midlevel": 0.5, "scale": scale}


def _writer(picture: Float[np.ndarray, "size size *channels"], kind: str) -> Callable[[Path], Any]:
    if kind == "png":
        return atomic.data(png(picture, np.uint16))
    if picture.ndim == 2:
        return lambda path: _write_exr(path, {"Y": picture})
    return lambda path: _write_exr(path, {name: picture[..., k] for k, name in enumerate("RGB")})


def png(
    picture: Float[np.ndarray, "size size *channels"], depth: type[np.unsignedinteger]
) -> bytes:
    """Encode values in [0, 1] as a grey or RGB PNG of ``depth``, uint8 or uint16. (Pillow can't
    write 16-bit RGB.)"""
    import imagecodecs

    top = np.iinfo(depth).max
    whole = np.empty(picture.shape, depth)
    for row in range(0, len(picture), 64):  # in pieces that fit into the processor's cache
        some = np.clip(picture[row : row + 64], 0, 1) * np.float32(top) + np.float32(0.5)
        whole[row : row + 64] = some
    return bytes(imagecodecs.png_encode(whole, level=4))


def _write_exr(path: Path, channels: dict[str, np.ndarray]) -> None:
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    content = {name: np.ascontiguousarray(each, np.float32) for name, each in channels.items()}
    with OpenEXR.File(header, content) as file:
        file.write(str(path))
