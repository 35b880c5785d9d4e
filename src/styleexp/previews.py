"""Pictures of a finished run: ``preview.png`` and ``turntable.gif``. Never seen by gradients."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from styleexp import meshes
from styleexp.renderers.base import Shading
from styleexp.renderers.soft_raster import SoftRaster
from styleexp.views import orbit, zoom

if TYPE_CHECKING:
    from jaxtyping import Float

    from styleexp.stylize import Result

VIEWS = (
    ("front left", 15.0, 35.0),
    ("right", 10.0, 100.0),
    ("back", 20.0, 190.0),
    ("left", 10.0, 280.0),
)
"""(label, elevation, azimuth) in degrees."""

SUPERSAMPLING = 2
LIGHT = (0.35, 0.45, 0.62)
"""Camera space: from above right, so that relief throws shade."""


def render_views(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: np.ndarray,
    elevations: list[float],
    azimuths: list[float],
    size: int,
) -> np.ndarray:
    """Pictures (views, size, size), 8-bit grey, of a mesh in the unit sphere, framed tightly."""
    shading = Shading(albedo=0.8, ambient=0.22, light=LIGHT, background=1.0, normals="smooth")
    radians = math.pi / 180
    cameras = orbit(torch.tensor(elevations) * radians, torch.tensor(azimuths) * radians, 3.0, 40.0)
    points = torch.from_numpy(np.ascontiguousarray(vertices)).float()
    seen = torch.einsum("nij,vj->nvi", cameras.rotation, points) + cameras.translation[:, None]
    reach = (cameras.focal[:, None] * seen[..., :2] / -seen[..., 2:]).abs().max()
    cameras = zoom(cameras, 0.94 / float(reach))
    large = size * SUPERSAMPLING
    with torch.no_grad():
        out = SoftRaster().render(
            points,
            torch.from_numpy(np.ascontiguousarray(faces)),
            cameras,
            shading,
            (large, large),
        )
        small = torch.nn.functional.avg_pool2d(out.image.permute(0, 3, 1, 2), SUPERSAMPLING)
    return (small[:, 0].clamp(0, 1) * 255).round().byte().numpy()


def write_preview(result: Result, path: Path) -> None:
    """Source, style and result, four views each, labelled; an image style is shown as it is."""
    scene, size = result.scene, result.scene.config.preview.resolution
    elevations, azimuths = [v[1] for v in VIEWS], [v[2] for v in VIEWS]

    def shown(vertices: np.ndarray, faces: np.ndarray) -> list[Image.Image]:
        pictures = render_views(vertices, faces, elevations, azimuths, size)
        return [Image.fromarray(p) for p in pictures]

    source = scene.frame.apply(scene.source.vertices)
    rows = [(f"source: {scene.source.name}", shown(source, scene.source.faces))]
    if isinstance(scene.style, meshes.Mesh):
        style = meshes.normalisation(scene.style.vertices).apply(scene.style.vertices)
        rows.append((f"style: {scene.style.name}", shown(style, scene.style.faces)))
    else:
        picture = Image.fromarray((scene.style * 255).round().astype(np.uint8)).convert("L")
        picture.thumbnail((size, size))
        chosen = scene.config.style
        rows.append((f"style: {Path(chosen.path or str(chosen.name)).stem}", [picture]))
    generated = scene.frame.apply(result.vertices)
    rows.append(("result", shown(generated, scene.source.faces)))
    _sheet(rows, size).save(path)


def write_turntable(result: Result, path: Path) -> None:
    """The result turning once, as an animated GIF."""
    preview = result.scene.config.preview
    frames = preview.turntable_frames
    azimuths = [360.0 * i / frames for i in range(frames)]
    generated = result.scene.frame.apply(result.vertices)
    pictures = render_views(
        generated, result.scene.source.faces, [15.0] * frames, azimuths, preview.resolution
    )
    first, *rest = [Image.fromarray(p) for p in pictures]
    first.save(path, save_all=True, append_images=rest, duration=80, loop=0, optimize=True)


def _sheet(rows: list[tuple[str, list[Image.Image]]], size: int) -> Image.Image:
    band = max(18, size // 12)
    font = ImageFont.load_default(size=band * 0.62)
    columns = max(len(pictures) for _, pictures in rows)
    sheet = Image.new("L", (columns * size, len(rows) * (size + band)), 255)
    draw = ImageDraw.Draw(sheet)
    for row, (label, pictures) in enumerate(rows):
        top = row * (size + band)
        draw.rectangle((0, top, sheet.width, top + band), fill=232)
        draw.text((band * 0.4, top + band * 0.15), label, fill=20, font=font)
        for column, picture in enumerate(pictures):
            left = column * size + (size - picture.width) // 2
            sheet.paste(picture, (left, top + band + (size - picture.height) // 2))
    return sheet
