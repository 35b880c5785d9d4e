"""Load the mesh or image for a configured name or path; refine the source for a style."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from styleexp import plugins
from styleexp.inputs import assets, images, meshes, shapes
from styleexp.runs import identity
from styleexp.system.errors import UserError, unknown_name
from styleexp.system.progress import doing

if TYPE_CHECKING:
    import numpy as np

    from styleexp.config.schema import Config, SourceConfig, StyleConfig

IMAGE_SUFFIXES = (
    *(".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff"),
    *(".bmp", ".gif", ".ppm", ".pgm", ".jp2", ".avif"),
)
SUFFIXES = (*assets.SUFFIXES["mesh"], *IMAGE_SUFFIXES)
"""Suffixes of readable files."""
EXPORTS = {
    **dict.fromkeys((".fbx", ".blend", ".max", ".ma", ".mb", ".c4d", ".dae", ".abc"), "GLB"),
    **dict.fromkeys((".usd", ".usda", ".usdc", ".usdz", ".vrm", ".x3d", ".wrl"), "GLB"),
    **dict.fromkeys((".3mf", ".amf", ".step", ".stp", ".iges", ".igs", ".brep", ".sldprt"), "STL"),
    **dict.fromkeys((".xyz", ".las", ".laz", ".e57", ".pcd", ".vtk", ".vtp", ".ztl"), "PLY"),
    **dict.fromkeys((".exr", ".hdr", ".psd", ".svg", ".heic", ".raw", ".dng"), "PNG"),
}
"""Formats to export instead, for files of common 3D programs."""

PER_WAVE = 12.0
"""Number of longest edges per wavelength of the style's relief when refining the source; half as
many blur the grooves between bubbles."""
MOST_REFINED = 200_000
"""Maximum number of faces that refining aims for."""
SHORTER = 0.65
"""Ratio of mean to longest edge after refining, which halves edges."""

_GIVEN: ContextVar[Mapping[str, Any]] = ContextVar("given", default=MappingProxyType({}))


@contextmanager
def given(**parts: meshes.Mesh | np.ndarray) -> Iterator[None]:
    """Use a ``source`` or ``style`` from memory, overriding the configuration."""
    token = _GIVEN.set(parts)
    try:
        yield
    finally:
        _GIVEN.reset(token)


def check(config: Config) -> None:
    """Raise `UserError` if a source, style or mask file is missing or has an unsupported type.

    Reads no files and imports nothing heavy, so that a mistyped name is reported at once.
    """
    for kind, part in identity.parts(config).items():
        path = locate(kind, part.name, part.path)
        if path is None:
            continue
        if not path.exists():
            where = "" if path.is_absolute() else f" in '{Path.cwd()}'"
            raise UserError(f"the {kind} '{path}' does not exist{where}: check its name.")
        _check_suffix(kind, path)


def _check_suffix(kind: str, path: Path) -> None:
    if export := EXPORTS.get(path.suffix.lower()):
        raise UserError(
            f"the {kind} '{path}' ends in '{path.suffix}', which is not supported: export it as "
            f"{export} from the program that made it."
        )


def load_source(config: SourceConfig) -> meshes.Mesh:
    """Load the source mesh, remeshed if configured."""
    mesh = _load("source", config.name, config.path, config.weld)
    if not isinstance(mesh, meshes.Mesh):
        raise UserError(f"the source '{config.path or config.name}' is an image: give a mesh.")
    if not config.remesh:
        return mesh
    doing(f"remeshing the source to about {config.remesh:,} vertices", at_once=True)
    return meshes.remesh(mesh, config.remesh)


def refined(mesh: meshes.Mesh, wavelength: float, how: str) -> meshes.Mesh:
    """Refine the mesh until its edges are short enough for a relief of this wavelength, in radii.
    ``how`` is ``source.refine``: a target number of faces, or ``auto``, at most `MOST_REFINED`."""
    scale = meshes.normalisation(mesh.vertices).scale
    area = meshes.face_areas(mesh.vertices, mesh.faces).sum()
    faces = MOST_REFINED if how == "auto" else float(how)
    longest = math.sqrt(area / (faces * math.sqrt(3) / 4)) / SHORTER
    doing("refining the source for the style")
    if how == "auto":
        return meshes.refine(mesh, max(wavelength / PER_WAVE * scale, longest))
    # On a uniform mesh, a tiny change of the length decides if all edges are halved or only some.
    low, high = longest / 2, longest * 2
    fine = mesh
    for _ in range(8):
        longest = math.sqrt(low * high)
        fine = meshes.refine(mesh, longest)
        if abs(math.log(len(fine.faces) / faces)) < 0.1:
            break
        low, high = (longest, high) if len(fine.faces) > faces else (low, longest)
    return fine


def load_style(config: StyleConfig) -> meshes.Mesh | np.ndarray:
    """Load the style: a mesh, or an image of shape (height, width, 3) in [0, 1]."""
    if "style" not in _GIVEN.get() and config.path is None and plugins.known("style", config.name):
        return _checked(plugins.build("style", config), config.name)
    return _load("style", config.name, config.path)


def _checked(style: meshes.Mesh | np.ndarray, name: str | None) -> meshes.Mesh | np.ndarray:
    """Validate the return value of a style's factory."""
    import numpy as np

    if isinstance(style, meshes.Mesh):
        return style
    if isinstance(style, np.ndarray) and style.ndim == 3 and style.shape[2] == 3:
        return style.astype(np.float32, copy=False)
    raise UserError(
        f"the style '{name}' is a {type(style).__name__}: its factory must return a Mesh or an "
        "image of shape (height, width, 3)."
    )


def locate(kind: str, name: str | None, path: str | None) -> Path | None:
    """File of a source or style; None for an analytic shape or a plugin's style."""
    if path is not None:
        return Path(path)
    if name is None:
        raise UserError(f"no {kind} was given: add {kind}=NAME or {kind}.path=FILE.")
    if name in shapes.names() or (kind == "style" and plugins.known(kind, name)):
        return None
    kinds = ("mesh", "image") if kind == "style" else ("mesh",)
    for each in kinds:
        if name in assets.names(each):
            return assets.find(name, each)
    known = [*shapes.names(), *(n for k in kinds for n in assets.names(k))]
    raise unknown_name(kind, name, known)


def _load(
    kind: str, name: str | None, path: str | None, weld: float | None = None
) -> meshes.Mesh | np.ndarray:
    if kind in _GIVEN.get():
        return _GIVEN.get()[kind]
    found = locate(kind, name, path)
    if found is None:
        assert name is not None
        return shapes.make(name)
    _check_suffix(kind, found)
    doing(f"reading the {kind} '{found}'")
    if found.suffix.lower() in IMAGE_SUFFIXES:
        return images.load_image(found)
    if kind == "style" and found.suffix.lower() not in (*assets.SUFFIXES["mesh"], ""):
        raise UserError(
            f"the style '{found}' ends in '{found.suffix}': give a mesh "
            f"({', '.join(assets.SUFFIXES['mesh'])}) or a picture ({', '.join(IMAGE_SUFFIXES)})."
        )
    return meshes.load_mesh(found, weld)
