"""From the configured name or path to a mesh or picture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from styleexp import assets, images, meshes, plugins, shapes
from styleexp.errors import UserError, unknown_name

if TYPE_CHECKING:
    import numpy as np

    from styleexp.config import Config, SourceConfig, StyleConfig

IMAGE_SUFFIXES = (
    *(".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff"),
    *(".bmp", ".gif", ".ppm", ".pgm", ".jp2", ".avif"),
)


def load_source(config: SourceConfig) -> meshes.Mesh:
    """The source mesh, remeshed if so configured."""
    mesh = _load("source", config.name, config.path, config.weld)
    if not isinstance(mesh, meshes.Mesh):
        raise UserError(f"the source '{config.path or config.name}' is an image: give a mesh.")
    return meshes.remesh(mesh, config.remesh) if config.remesh else mesh


def load_style(config: StyleConfig) -> meshes.Mesh | np.ndarray:
    """The style: a mesh, or an image of shape (height, width, 3) in [0, 1]."""
    if config.path is None and plugins.known("style", config.name):
        return _checked(plugins.build("style", config), config.name)
    return _load("style", config.name, config.path)


def _checked(style: meshes.Mesh | np.ndarray, name: str | None) -> meshes.Mesh | np.ndarray:
    """What a style's factory returned, if it can be used."""
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
    """The file behind a source or style; None for an analytic shape or a plugin's style."""
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
    found = locate(kind, name, path)
    if found is None:
        assert name is not None
        return shapes.make(name)
    if found.suffix.lower() in IMAGE_SUFFIXES:
        return images.load_image(found)
    if kind == "style" and found.suffix.lower() not in (*assets.SUFFIXES["mesh"], ""):
        raise UserError(
            f"the style '{found}' ends in '{found.suffix}': give a mesh "
            f"({', '.join(assets.SUFFIXES['mesh'])}) or a picture ({', '.join(IMAGE_SUFFIXES)})."
        )
    return meshes.load_mesh(found, weld)


def describe(config: Config) -> dict[str, dict[str, str | None]]:
    """Name, file and sha256 of the source and style, for the run's record; analytic shapes have no
    file, their definition is this version's."""
    found = {}
    for kind, part in (("source", config.source), ("style", config.style)):
        path = locate(kind, part.name, part.path)
        found[kind] = {
            "name": part.name,
            "path": str(path) if path else None,
            "sha256": assets.sha256(path) if path else None,
        }
    return found
