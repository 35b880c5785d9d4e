"""The Python interface: `stylize`."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from styleexp import plugins
from styleexp.config import build, sources, unread
from styleexp.config.compose import compose
from styleexp.config.explain import explain
from styleexp.config.overrides import is_file
from styleexp.inputs import meshes
from styleexp.system import process
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from styleexp.config.schema import Config
    from styleexp.inputs.meshes import MeshLike
    from styleexp.method.base import Result


def stylize(source: MeshLike, style: MeshLike | np.ndarray, *overrides: str) -> Result:
    """Put the local geometry of ``style``, a mesh or picture, onto the mesh ``source``.

    Args:
        source: a name, a file (a string with a suffix or folder, or an existing path), a `Mesh`, a
            ``trimesh.Trimesh``, or ``(vertices, faces)`` of shapes (vertices, 3) and (faces, 3).
        style: as for ``source``, or an image array of shape (height, width) or (height, width,
            channels), row 0 at the top: 8- or 16-bit integers, or floats in [0, 1].
        overrides: as on the command line: ``stylize("my.obj", "bubble", "strength=0.5",
            "style.scale=2")``.

    Returns:
        The generated mesh. Nothing is written to disk; use ``save``.

    Raises:
        UserError: for any error that the command line would report.

    Warns:
        UserWarning: for everything that the command line prints as a note: repairs, vertices
            removed or merged (the result then has other vertices than the input, but the same
            faces), a mesh that is too coarse, overrides that the method ignores.

    Process state is restored: torch's number of threads (``threads=`` applies to this call only),
    its random state, and the state of a calling Hydra application.
    """
    config, given = configured(source, style, overrides)
    with sources.given(**given), process.undisturbed(config.threads, config.optim.seed):
        if (note := unread.note([config], overrides)) is not None:
            warnings.warn(note, stacklevel=2)
        method, scene = build.prepare(config)
        for note in (*scene.subject.notes, *scene.notes):
            warnings.warn(note, stacklevel=2)
        state = method.start(scene)
        if state is not None:
            for _ in method.optimise(scene, state):
                pass
        return method.finish(scene, state)


def configured(
    source: MeshLike,
    style: MeshLike | np.ndarray,
    overrides: Sequence[str],
    composed: Callable[[Sequence[str]], Config] = compose,
) -> tuple[Config, dict[str, Any]]:
    """The configuration of a run, and the in-memory source and style, by key."""
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    for override in overrides:
        if not isinstance(override, str) or not re.match(r"[~+]*[\w@./-]+=|~\w", override):
            raise UserError(f"the override {override!r} is not KEY=VALUE.")
        if re.match(r"(source|style)(\.path|\.name)?=", override):
            raise UserError(f"source and style are given already, so drop '{override}'.")
    named = {"source": source, "style": style}
    known = isinstance(style, str) and plugins.known("style", style)
    try:
        config = composed([*([f"style={style}"] if known else []), *overrides])
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(explain(error)) from error
    given = {}
    for key, what in named.items():
        part = getattr(config, key)
        if isinstance(what, str | Path):
            what = str(what)
            setattr(part, "path" if is_file(key, what) else "name", what)
        else:
            part.name, part.path = "array", None
            given[key] = meshes.from_memory(what, key)
    return config, given


def configure(source: str | Path, style: str | Path, overrides: Sequence[str]) -> Config:
    """Build the configuration of a run, from names or files and command-line overrides."""
    return configured(source, style, overrides)[0]
