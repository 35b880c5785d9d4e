"""3D content of a page: source, style and result, from a live run or its folder."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from styleexp.experiments.reports import glb
from styleexp.inputs import meshes
from styleexp.runs import reading, results
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from jaxtyping import Float, Int

    from styleexp.inputs.style import Style
    from styleexp.method.base import Result
    from styleexp.runs.reading import Run

WITHIN = 99.5
"""Percentile of |displacement| at which the heat map saturates, so that a few spikes don't use up
the colour range."""


@dataclass(frozen=True)
class Shape:
    """A mesh to show, normalised like the mesh it is compared with."""

    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]


@dataclass(frozen=True)
class Shown:
    """Source, style and result, as far as available."""

    source: Shape | None = None
    style: Shape | np.ndarray | None = None
    """A mesh, or a picture of shape (height, width, 3) in [0, 1]."""
    result: Shape | None = None
    displacement: Float[np.ndarray, " vertices"] | None = None
    """Displacement of the result's vertices, in the source's own units."""
    radius: float = 1.0
    """Radius of the source's bounding sphere, in its own units."""
    missing: tuple[str, ...] = ()
    """One sentence for each that is unavailable."""

    @property
    def reach(self) -> float:
        """Displacement at which the heat map saturates."""
        if self.displacement is None or not len(self.displacement):
            return 0.0
        return float(np.percentile(np.abs(self.displacement), WITHIN))

    def files(
        self, bare: bool = False, heat: Float[np.ndarray, " vertices"] | None = None
    ) -> dict[str, bytes]:
        """One GLB per mesh; source and result share a frame. ``heat``, in [-1, 1], colours the
        result instead of its displacement. See `glb.glb` for ``bare``."""
        pair = [shape for shape in (self.source, self.result) if shape is not None]
        reach = max((float(np.abs(shape.vertices).max()) for shape in pair), default=1.0)
        extent = math.ceil(1e4 * reach) / 1e4  # equal for a result read in single precision
        values = heat
        if heat is None and self.displacement is not None and not bare:
            values = np.clip(self.displacement / (self.reach or 1.0), -1, 1)
        made = {}
        if self.source is not None:
            made["source"] = glb.glb(self.source.vertices, self.source.faces, extent, bare=bare)
        if isinstance(self.style, Shape):
            reach = float(np.abs(self.style.vertices).max())
            made["style"] = glb.glb(self.style.vertices, self.style.faces, reach, bare=bare)
        if self.result is not None:
            made["result"] = glb.glb(self.result.vertices, self.result.faces, extent, values, bare)
        return made


def of(result: Result) -> Shown:
    """Content of a run that has just ended."""
    subject = result.subject
    return Shown(
        source=Shape(subject.frame.apply(subject.source.vertices), subject.source.faces),
        style=_style(subject.style),
        result=Shape(subject.frame.apply(result.vertices), result.faces),
        displacement=result.displacement,
        radius=subject.frame.scale,
    )


def read(run: Run) -> Shown:
    """Content of a run's folder. Source and style are read from their original files, if unchanged;
    others are listed in ``missing``."""
    missing: list[str] = []
    source, style = _load(run, missing)
    found: dict[str, Any] = {}
    frame = None
    if source is not None:
        frame = meshes.normalisation(source.vertices)
        found["source"] = Shape(frame.apply(source.vertices), source.faces)
    if style is not None:
        found["style"] = _style(style)
    path = run.folder / results.NAME
    if path.is_file():
        try:
            result = results.read(path)
        except UserError as error:
            missing.append(f"The result can't be shown: {error}")
        else:
            frame = frame or meshes.normalisation(result.vertices)
            found["result"] = Shape(frame.apply(result.vertices), result.faces)
            found["displacement"] = result.displacement
    else:
        missing.append("There is no result: the folder has no result.ply.")
    return Shown(**found, radius=frame.scale if frame else 1.0, missing=tuple(missing))


class OtherVertices(UserError):
    """A result whose vertices are not its source's."""


def read_moved(folder: Path) -> tuple[meshes.Mesh, np.ndarray, np.ndarray]:
    """A finished run's source, moved vertices (vertices, 3), and displacement (vertices,).

    Raises `UserError` if they are unavailable, and `OtherVertices` if the result has others.
    """
    from styleexp.inputs.meshes.writing import ply_rows

    run, missing = reading.readable(folder, "use"), list[str]()
    path = folder / results.NAME
    if not path.is_file():
        raise UserError(f"'{folder}' has no result.ply: give the folder of a finished run.")
    source, _ = _load(run, missing)
    if source is None:
        raise UserError(f"'{folder}' can't be used: {missing[0]}")
    stored = results.read(path)
    rows, corners = np.arange(len(source.vertices)), source.faces
    if source.carrier is not None:
        first, combined = ply_rows(source.carrier)
        rows, corners = source.carrier.rows[first], combined[source.carrier.corners]
    # The same number of vertices in another order, as written by another version, is another mesh.
    if (
        stored.displacement is None
        or len(stored.vertices) != len(rows)
        or not np.array_equal(stored.faces, corners)
    ):
        raise OtherVertices(
            f"'{path}' has other vertices than its source '{source.name}' (it was refined, or "
            "resampled by baseline=geometric_textures), so its displacement is not of the source."
        )
    moved, displacement = np.zeros_like(source.vertices), np.zeros(len(source.vertices))
    moved[rows], displacement[rows] = stored.vertices, stored.displacement
    return source, moved, displacement


def _load(run: Run, missing: list[str]) -> tuple[meshes.Mesh | None, Any]:
    """Source and style of a run's record; None if they are missing or have changed."""
    from styleexp.config import compose, sources
    from styleexp.runs import origins

    if not run.record.get("config"):
        missing.append("Source and style can't be shown: there is no readable run.json.")
        return None, None
    try:
        config = compose.recorded(run.record["config"])
    except Exception as error:
        missing.append(f"Source and style can't be shown: {error}")
        return None, None
    loaders: dict[str, Any] = {
        "source": lambda: sources.load_source(config.source),
        "style": lambda: sources.load_style(config.style),
    }
    found: dict[str, Any] = {}
    for kind, load in loaders.items():
        try:
            if path := origins.find(run.record, config, kind, run.folder):
                getattr(config, kind).path = str(path)
            found[kind] = load()
        except UserError as error:
            missing.append(f"The {kind} can't be shown: {error}")
    return found.get("source"), found.get("style")


def _style(style: Style) -> Shape | np.ndarray:
    if style.mesh is None:
        assert style.picture is not None
        return style.picture
    frame = meshes.normalisation(style.mesh.vertices)
    return Shape(frame.apply(style.mesh.vertices), style.mesh.faces)
