"""Resolve a configuration's source, style and masks to files, and load them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from styleexp import plugins
from styleexp.inputs import assets, images, meshes, shapes
from styleexp.inputs.meshes import heads
from styleexp.inputs.style import Style
from styleexp.system.errors import UserError, unknown_name
from styleexp.system.progress import doing

if TYPE_CHECKING:
    import numpy as np

    from styleexp.config.schema import Config
    from styleexp.inputs.options import SourceConfig
    from styleexp.method.options import StyleConfig

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

FILES = ("source", "style")
"""Configuration sections that may name a file."""


@dataclass(frozen=True)
class Named:
    """A possible file of a run: one of `FILES`, or an image in ``style.mask``."""

    name: str | None
    path: str | None


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
    """Raise `UserError` if a source, style or mask file is missing, has an unsupported type, or
    begins as no such file does.

    Imports nothing heavy, so that a wrong file is reported at once.
    """
    for kind, part in parts(config).items():
        check_part(kind, part)


def check_part(kind: str, part: Named) -> None:
    """`check` one of the configuration's `parts`."""
    path = locate(kind, part.name, part.path)
    if path is None:
        return
    if not path.exists():
        where = "" if path.is_absolute() else f" in '{Path.cwd()}'"
        raise UserError(f"the {kind} '{path}' does not exist{where}: check its name.")
    _check_suffix(kind, path)
    if path.suffix.lower() in IMAGE_SUFFIXES:
        images.check(path)
    else:
        heads.check(path)


def parts(config: Config) -> dict[str, Named]:
    """Possible files of a run, keyed ``source``, ``style`` and, for each image in ``style.mask``,
    ``mask``, ``mask 2`` and so on."""
    from styleexp.method import masks

    found = {kind: Named(getattr(config, kind).name, getattr(config, kind).path) for kind in FILES}
    for k, path in enumerate(masks.files(config.style.mask), 1):
        found["mask" if k == 1 else f"mask {k}"] = Named(None, path)
    return found


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


def load_style(config: StyleConfig) -> Style:
    """Load the style."""
    name = config.path or config.name
    if "style" not in _GIVEN.get() and config.path is None and plugins.known("style", config.name):
        return Style.of(_checked(plugins.build("style", config), config.name), name)
    return Style.of(_load("style", config.name, config.path), name)


def _checked(style: meshes.Mesh | np.ndarray, name: str | None) -> meshes.Mesh | np.ndarray:
    """Validate the return value of a style's factory."""
    import numpy as np

    if isinstance(style, meshes.Mesh):
        return style
    wanted = "its factory must return a Mesh or an image of floats in [0, 1], (height, width, 3)"
    if not isinstance(style, np.ndarray):
        raise UserError(f"the style '{name}' is a {type(style).__name__}: {wanted}.")
    if style.ndim != 3 or style.shape[2] != 3 or style.dtype.kind != "f":
        raise UserError(
            f"the style '{name}' is an array of {style.dtype} of shape {style.shape}: {wanted}."
        )
    if not (style.size and 0 <= style.min() <= style.max() <= 1):  # NaN fails too
        raise UserError(f"the style '{name}' has values outside [0, 1]: {wanted}.")
    return style.astype(np.float32, copy=False)


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
