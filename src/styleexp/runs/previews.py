"""Pictures of a finished run: ``preview.png``, ``turntable.gif`` and, of a pattern that was laid
along directions, ``direction.png``. Not used in optimisation.

``preview=pyrender`` adds a check view: the result drawn by an independent renderer in another
process, so that faults of the training renderer can't go unnoticed.
"""

from __future__ import annotations

import importlib.util
import json
import math
import os
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from styleexp.inputs import meshes
from styleexp.method.views import orbit, zoom
from styleexp.renderers.base import Cameras, Renderer, RenderOutput, Shading
from styleexp.renderers.soft_raster import SoftRaster
from styleexp.runs.pyrender_view import UNAVAILABLE
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from jaxtyping import Float, Int

    from styleexp.config.schema import Config
    from styleexp.method.base import Result

VIEWS = (
    ("front left", 15.0, 35.0),
    ("right", 10.0, 100.0),
    ("back", 20.0, 190.0),
    ("left", 10.0, 280.0),
)
"""(label, elevation, azimuth) in degrees."""

SUPERSAMPLING = 2
LIGHT = (0.35, 0.45, 0.62)
"""Light direction in camera space, from above right, so that relief is shaded."""

DART = 0.07
"""Distance between the darts that show the pattern's directions, in radii."""
DIRECTED = "the pattern's up, on the source"

CHECK_PLATFORMS = ("egl", "osmesa")
"""Headless OpenGL platforms for pyrender, in order of preference."""
CHECK_TIMEOUT = 600
"""Seconds after which a check view counts as hung."""
LEAST_IOU = 0.98
"""Silhouette IoU below which a warning is issued."""


def render_views(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: np.ndarray,
    elevations: list[float],
    azimuths: list[float],
    size: int,
    frame: Float[np.ndarray, "points 3"] | None = None,
    device: torch.device | str = "cpu",
) -> np.ndarray:
    """Render a mesh in the unit sphere as 8-bit grey (views, size, size), tightly framed: itself,
    or all points of ``frame``, to show several meshes at one size."""
    points = torch.from_numpy(np.ascontiguousarray(vertices)).float()
    within = points if frame is None else torch.from_numpy(np.ascontiguousarray(frame)).float()
    cameras = framed(within, elevations, azimuths)
    return shrunk(render(vertices, faces, cameras, size * SUPERSAMPLING, device).image)


def render(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: np.ndarray,
    cameras: Cameras,
    size: int,
    device: torch.device | str,
) -> RenderOutput:
    """Render a mesh for people to look at."""
    shading = Shading(albedo=0.8, ambient=0.22, light=LIGHT, background=1.0, normals="smooth")
    with torch.no_grad():
        return SoftRaster().render(
            torch.from_numpy(np.ascontiguousarray(vertices)).float().to(device),
            torch.from_numpy(np.ascontiguousarray(faces)).to(device),
            cameras,
            shading,
            (size, size),
        )


def shrunk(image: Float[torch.Tensor, "views large large 1"]) -> np.ndarray:
    """Images as 8-bit grey (views, size, size), `SUPERSAMPLING` times smaller."""
    small = torch.nn.functional.avg_pool2d(image.permute(0, 3, 1, 2), SUPERSAMPLING)
    return (small[:, 0].clamp(0, 1) * 255).round().byte().cpu().numpy()


def framed(
    points: Float[torch.Tensor, "vertices 3"], elevations: list[float], azimuths: list[float]
) -> Cameras:
    """Cameras around the origin, angles in degrees, with one common zoom that just fits all
    points."""
    radians = math.pi / 180
    cameras = orbit(torch.tensor(elevations) * radians, torch.tensor(azimuths) * radians, 3.0, 40.0)
    seen = torch.einsum("nij,vj->nvi", cameras.rotation, points) + cameras.translation[:, None]
    reach = (cameras.focal[:, None] * seen[..., :2] / -seen[..., 2:]).abs().max()
    return zoom(cameras, 0.94 / float(reach))


def write_preview(result: Result, size: int, path: Path) -> None:
    """Draw source, style and result, four labelled views each of ``size`` pixels;
    an image style is shown as is."""
    subject, style = result.subject, result.subject.style
    elevations, azimuths = [v[1] for v in VIEWS], [v[2] for v in VIEWS]

    def shown(vertices: np.ndarray, faces: np.ndarray) -> list[Image.Image]:
        device = subject.surface.vertices.device
        pictures = render_views(vertices, faces, elevations, azimuths, size, device=device)
        return [Image.fromarray(p) for p in pictures]

    source = subject.frame.apply(subject.source.vertices)
    rows = [(f"source: {subject.source.name}", shown(source, subject.source.faces))]
    if style.mesh is not None:
        vertices = meshes.normalisation(style.mesh.vertices).apply(style.mesh.vertices)
        rows.append((f"style: {style.mesh.name}", shown(vertices, style.mesh.faces)))
    else:
        assert style.picture is not None
        picture = Image.fromarray((style.picture * 255).round().astype(np.uint8)).convert("L")
        picture.thumbnail((size, size))
        rows.append((f"style: {Path(style.name).stem}", [picture]))
    generated = subject.frame.apply(result.vertices)
    rows.append(("result", shown(generated, subject.source.faces)))
    sheet(rows, size).save(path)


def write_directions(result: Result, size: int, path: Path) -> None:
    """Draw which way the pattern was laid, four views of ``size`` pixels: darts on the source that
    point to the pattern's up."""
    assert result.directions is not None
    subject = result.subject
    source, faces = subject.frame.apply(subject.source.vertices), subject.source.faces
    normals = subject.surface.normals.double().cpu().numpy()
    points, darts = dart_mesh(source, normals, result.directions)
    elevations, azimuths = [v[1] for v in VIEWS], [v[2] for v in VIEWS]
    out = render(
        np.concatenate([source, points]),
        np.concatenate([faces, len(source) + darts]),
        framed(torch.from_numpy(source).float(), elevations, azimuths),
        size * SUPERSAMPLING,
        subject.surface.vertices.device,
    )
    assert out.face_ids is not None
    dart = (out.face_ids >= len(faces))[..., None]
    pictures = shrunk(torch.where(dart, 0.0, 0.4 + 0.6 * out.image))
    sheet([(DIRECTED, [Image.fromarray(p) for p in pictures])], size).save(path)


def dart_mesh(
    vertices: Float[np.ndarray, "vertices 3"],
    normals: Float[np.ndarray, "vertices 3"],
    directions: Float[np.ndarray, "vertices 3"],
) -> tuple[Float[np.ndarray, "points 3"], Int[np.ndarray, "darts 3"]]:
    """Thin triangles just above the mesh, at vertices `DART` apart, pointing along their
    directions."""
    cells = np.floor(vertices / DART).astype(np.int64)
    some = np.sort(np.unique(cells, axis=0, return_index=True)[1])
    place = vertices[some] + 0.2 * DART * normals[some]
    along = 0.45 * DART * directions[some]
    aside = 0.35 * np.cross(normals[some], along)
    corners = [place + along, place - along + aside, place - along - aside]
    return np.stack(corners, axis=1).reshape(-1, 3), np.arange(3 * len(some)).reshape(-1, 3)


def write_turntable(result: Result, frames: int, size: int, path: Path) -> None:
    """Draw one turn of the result, as an animated GIF."""
    azimuths = [360.0 * i / frames for i in range(frames)]
    generated = result.subject.frame.apply(result.vertices)
    device = result.subject.surface.vertices.device
    pictures = render_views(generated, result.faces, [15.0] * frames, azimuths, size, device=device)
    _write_gif(pictures, path)


@dataclass(frozen=True)
class CheckView:
    """Pictures drawn by pyrender."""

    pictures: np.ndarray
    """(views, size, size), 8-bit grey, with pyrender's lighting."""
    covered: np.ndarray
    """(views, size, size), bool."""
    platform: str
    """``egl`` or ``osmesa``."""
    device: str
    """OpenGL device: a GPU, or ``llvmpipe ...``."""


def check_views(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: np.ndarray,
    cameras: Cameras,
    size: int,
    platform: str = "auto",
) -> CheckView:
    """Draw a mesh with pyrender in a separate process.

    ``platform`` is ``egl``, ``osmesa`` or ``auto`` (EGL, else OSMesa). Raises ``UserError`` if
    pyrender is not installed, no platform works, or the process fails or hangs.
    """
    if importlib.util.find_spec("pyrender") is None:
        raise UserError(
            "preview=pyrender needs a package: pip install 'styleexp[gl]', or choose "
            "preview=builtin."
        )
    job = {
        "vertices": np.asarray(vertices, np.float64),
        "faces": np.asarray(faces),
        "near": cameras.near,
        "size": size,
    }
    for name in ("rotation", "translation", "focal", "center"):
        job[name] = getattr(cameras, name).double().cpu().numpy()
    reasons = []
    for chosen in CHECK_PLATFORMS if platform == "auto" else (platform,):
        with tempfile.TemporaryDirectory(prefix="styleexp-check-") as folder:
            reason = _run_check(job, Path(folder), chosen)
            if reason is None:
                with np.load(Path(folder) / "out.npz") as out:
                    drawn = dict(out)
                return CheckView(drawn["pictures"], drawn["covered"], chosen, str(drawn["device"]))
        reasons.append(f"{chosen}: {reason}")
    raise UserError(
        f"preview=pyrender can't draw ({'; '.join(reasons)}): install OpenGL with EGL or OSMesa "
        "(Debian, Ubuntu: apt-get install libegl1 libgl1 libopengl0 libgl1-mesa-dri libosmesa6), "
        "or choose preview=builtin."
    )


def _run_check(job: dict[str, Any], folder: Path, platform: str) -> str | None:
    """Run a job's process, which writes ``out.npz``. Returns the reason if it fails."""
    np.savez(folder / "in.npz", **job)
    command = [sys.executable, "-m", "styleexp.runs.pyrender_view"]
    try:
        done = subprocess.run(
            [*command, str(folder / "in.npz"), str(folder / "out.npz")],
            env={**os.environ, "PYOPENGL_PLATFORM": platform},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=CHECK_TIMEOUT,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"no picture after {CHECK_TIMEOUT} s"
    if done.returncode == 0:
        return None
    last = (done.stderr.strip().splitlines() or ["no message"])[-1]
    return last if done.returncode == UNAVAILABLE else f"exit code {done.returncode}, {last}"


def check_available(platform: str = "auto") -> None:
    """Raise ``check_views``'s ``UserError`` now instead of at the end of a run."""
    corners = torch.eye(3)
    check_views(
        corners.numpy(), np.array([[0, 1, 2]]), framed(corners, [20.0], [40.0]), 32, platform
    )


def silhouette_iou(
    covered: np.ndarray,
    vertices: Float[np.ndarray, "vertices 3"],
    faces: np.ndarray,
    cameras: Cameras,
    renderer: Renderer,
    device: torch.device | str = "cpu",
) -> tuple[list[float], np.ndarray]:
    """Agreement of a renderer's silhouettes with ``covered`` (views, size, size), bool.

    Returns the IoU of every view, and this renderer's covered pixels.
    """
    with torch.no_grad():
        out = renderer.render(
            torch.from_numpy(np.ascontiguousarray(vertices)).float().to(device),
            torch.from_numpy(np.ascontiguousarray(faces)).to(device),
            cameras,
            Shading(outlines=False),
            (covered.shape[1], covered.shape[2]),
        )
    own = (out.coverage >= 0.5).cpu().numpy()
    both, either = (own & covered).sum((1, 2)), (own | covered).sum((1, 2))
    return np.where(either > 0, both / np.maximum(either, 1), 1.0).tolist(), own


def write_check(
    result: Result,
    renderer: Renderer,
    config: Config,
    write: Callable[[str, Callable[[Path], Any]], Path],
) -> list[Path]:
    """Write ``check.png``, ``check.gif`` and ``check.json``: the result drawn by pyrender.

    ``write`` is ``RunFolder.write``. The training renderer's silhouettes are compared with
    pyrender's at the same cameras; ``check.json`` holds the IoUs, and one below ``LEAST_IOU``
    issues a warning. Returns the files' paths.
    """
    subject, preview = result.subject, config.preview
    faces = result.faces
    vertices = subject.frame.apply(result.vertices)
    points = torch.from_numpy(np.ascontiguousarray(vertices)).float()
    frames = preview.turntable_frames
    elevations = [v[1] for v in VIEWS] + [15.0] * frames
    azimuths = [v[2] for v in VIEWS] + [360.0 * i / frames for i in range(frames)]
    cameras = framed(points, elevations, azimuths)
    size, views = preview.check_resolution, slice(0, len(VIEWS))
    drawn = check_views(vertices, faces, cameras, size, preview.platform)
    ious, own = silhouette_iou(
        drawn.covered[views],
        vertices,
        faces,
        cameras[views],
        renderer,
        subject.surface.vertices.device,
    )

    name = config.renderer.name
    found = {
        "least_iou": min(ious),
        "views": [
            {"view": label, "elevation": elevation, "azimuth": azimuth, "iou": iou}
            for (label, elevation, azimuth), iou in zip(VIEWS, ious, strict=True)
        ],
        "renderer": name,
        "check": f"pyrender, {drawn.platform}, {drawn.device}",
        "resolution": size,
    }
    if min(ious) < LEAST_IOU:
        warnings.warn(
            "the result looks different in the check view: its silhouette seen from the "
            f"{VIEWS[ious.index(min(ious))][0]} has an IoU of {min(ious):.3f} with {name}'s, "
            f"expected at least {LEAST_IOU}; see check.png.",
            stacklevel=2,
        )
    agreed = ", ".join(f"{iou:.4f}" for iou in ious)
    rows = [
        (
            f"result, drawn by pyrender ({drawn.platform}): {', '.join(v[0] for v in VIEWS)}",
            drawn.pictures[views],
        ),
        (
            f"black where {name} disagrees; IoU {agreed}",
            np.where(own != drawn.covered[views], 0, np.where(own, 200, 255)).astype(np.uint8),
        ),
    ]
    drawn_rows = [(label, [Image.fromarray(p) for p in pictures]) for label, pictures in rows]
    return [
        write("check.json", lambda path: path.write_text(json.dumps(found, indent=2) + "\n")),
        write("check.png", lambda path: sheet(drawn_rows, size).save(path)),
        write("check.gif", lambda path: _write_gif(drawn.pictures[len(VIEWS) :], path)),
    ]


def _write_gif(pictures: np.ndarray, path: Path) -> None:
    first, *rest = [Image.fromarray(p) for p in pictures]
    first.save(path, save_all=True, append_images=rest, duration=80, loop=0, optimize=True)


def sheet(rows: list[tuple[str, list[Image.Image]]], size: int) -> Image.Image:
    """Stack labelled rows of pictures, none larger than ``size``."""
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
