"""Measure finished runs, one or many, from their saved files."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from styleexp.config import build
from styleexp.config.sources import load_source, load_style
from styleexp.experiments.metrics import Banks, Judge, measure
from styleexp.experiments.metrics.style import Looks, pattern_distance, relief_distance
from styleexp.inputs import meshes
from styleexp.inputs.style import Style
from styleexp.method.patches import relief_of_result
from styleexp.method.pattern_size import pattern_unit
from styleexp.runs import finding, origins, reading, records, results
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from collections.abc import Callable

    from styleexp.config.schema import Config


def measure_run(folder: Path, judge: Judge | None) -> dict[str, float]:
    """Measure a finished run again, from its ``result.ply``.

    Raises `UserError` if the folder isn't a run's, or its run isn't done.
    """
    _, config, source, style, vertices, faces = finished(folder)
    return measure(config, source, style, vertices, faces, judge)


def measure_board(folder: Path, judge: Judge, write: bool = False) -> dict[str, Any]:
    """Measure every run below ``folder``, and how well their styles can be identified.

    With ``write``, replace each run's ``metrics.json`` by the new values.

    ``identification`` counts the runs whose result is nearest to its own style among all styles on
    the board of the same kind (meshes or images), by `relief_distance`; ``identification_features``
    is the same by the features of `style_distance`. ``of`` is the number of finished runs.
    Unfinished runs are listed as such.
    """
    rows: list[dict[str, Any]] = []
    results: list[tuple[dict[str, Any], Looks]] = []
    goals: dict[str, Looks] = {}
    banks: Banks = {}
    contents: dict[str, str] = {}
    runs = sorted((at for at in finding.folders(folder) if (at / "run.json").is_file()), key=str)
    if not runs:
        raise UserError(f"'{folder}' contains no run: give a run's or a sweep's folder.")
    for run in runs:
        row: dict[str, Any] = {"run": str(run.relative_to(folder))}
        rows.append(row)
        try:
            record, config, source, style, vertices, faces = finished(run)
        except UserError as error:
            row["status"] = str(error)
            continue
        name = _style_name(record, contents)
        row |= {"status": "done", "source": source.name, "style": name}
        found = measure(config, source, style, vertices, faces, judge, banks)
        if write:
            records.RunFolder(run).write_json("metrics.json", found)
        row |= found
        unit = unit_of(config, source, style)
        goals.setdefault(name, judge.style(config, style, unit))
        relief = relief_of_result(source, vertices, faces, unit)
        results.append((row, judge.looks(config, relief, unit)))
    for row, looks in results:
        row["looks_like"] = nearest(looks, row["style"], goals, relief_apart)
        row["looks_like_features"] = nearest(looks, row["style"], goals, pattern_distance)
    done = [row for row, _ in results]
    return {
        "identification": sum(row["looks_like"] == row["style"] for row in done),
        "identification_features": sum(row["looks_like_features"] == row["style"] for row in done),
        "of": len(done),
        "styles": len(goals),
        "min_silhouette_iou": min((row["silhouette_iou"] for row in done), default=None),
        "max_flipped": max((row.get("flipped_faces", 0.0) for row in done), default=None),
        "runs": rows,
    }


def _style_name(record: dict[str, Any], contents: dict[str, str]) -> str:
    """The style's name as typed, made unique among files with the same name and different content.

    ``contents`` maps the names so far to their content, and is updated.
    """
    typed = record["config"]["style"]
    content = str(((record.get("assets") or {}).get("style") or {}).get("sha256"))
    name = str(typed["path"] or typed["name"])
    return name if contents.setdefault(name, content) == content else f"{name} ({content[:8]})"


def nearest(
    looks: Looks, style: str, goals: dict[str, Looks], distance: Callable[[Looks, Looks], float]
) -> str:
    """The style nearest to the result, among those of the same kind (mesh or image) as
    ``style``."""
    is_picture = goals[style].height is None
    rivals = [name for name, goal in goals.items() if (goal.height is None) == is_picture]
    return min(rivals, key=lambda name: distance(looks, goals[name]))


def relief_apart(result: Looks, style: Looks) -> float:
    """`relief_distance`, which identifies most of the imperfect results on the truth boards;
    infinite if there is no window."""
    apart = relief_distance(result, style)
    return math.inf if apart is None else apart


def unit_of(config: Config, source: meshes.Mesh, style: Style) -> float:
    """Size of a unit pattern on the normalised source."""
    return pattern_unit(config.style, source, style)


def finished(
    folder: Path,
) -> tuple[dict[str, Any], Config, meshes.Mesh, Style, np.ndarray, np.ndarray]:
    """Record, configuration, source, style and result of a finished run."""
    run = reading.recorded(folder, "measure")
    if run.status != "done":
        status = run.last_status or run.status
        raise UserError(f"the run in '{folder}' is {status}, not done: there is no result yet.")
    config = origins.restored(run.record, folder, "measure")
    source, style = load_source(config.source), load_style(config.style)
    path = folder / results.NAME
    vertices, faces = read_result(path, source)
    if config.source.refine != "none" and not np.array_equal(faces, source.faces):
        refined = build.subject_of(config, build.separates(config)).source
        again = read_result(path, refined)
        if np.array_equal(again[1], refined.faces):
            return run.record, config, refined, style, *again
    return run.record, config, source, style, vertices, faces


def read_result(path: Path, source: meshes.Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a result's file, in the source's numbering if the topology matches.

    A file may contain the source's vertices, or its file's rows, with vertices split at seams.
    Anything else has another topology and is returned as is.
    """
    result = meshes.load_mesh(path)
    if len(result.vertices) == len(source.vertices) and len(result.faces) == len(source.faces):
        rows = _rows(path)
        if len(rows) == len(source.vertices):
            return rows, source.faces
    if source.carrier is not None:
        rows = _rows(path)
        if len(rows) == len(source.carrier.rows):
            vertices = np.empty_like(source.vertices)
            vertices[source.carrier.rows] = rows
            return vertices, source.faces
    return result.vertices, result.faces


def _rows(path: Path) -> np.ndarray:
    """Vertices in file order."""
    if path.suffix.lower() == ".ply":
        return results.positions(path)
    import trimesh

    loaded = trimesh.load(path, process=False, force="mesh")
    return np.asarray(loaded.vertices, dtype=np.float64)
