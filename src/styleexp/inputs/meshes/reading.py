"""Load mesh files, with one-sentence errors; STL and OFF through trimesh."""

from __future__ import annotations

import io
import os
import re
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from styleexp.inputs.meshes import heads, precision, truncation, welding
from styleexp.inputs.meshes.gltf import read_gltf
from styleexp.inputs.meshes.mesh import Carrier, Mesh
from styleexp.inputs.meshes.obj import read_obj
from styleexp.inputs.meshes.ply_meshes import read_ply
from styleexp.inputs.meshes.references import Beside
from styleexp.inputs.meshes.welding import check_indices, plural
from styleexp.system.errors import UserError

READERS = {".obj": read_obj, ".ply": read_ply, ".glb": read_gltf, ".gltf": read_gltf}
READABLE = (".obj", ".ply", ".stl", ".off", ".glb", ".gltf")


def load_mesh(path: str | os.PathLike[str], weld: float | None = None) -> Mesh:
    """Load an OBJ, PLY, STL, OFF, GLB or glTF file as one welded triangle mesh.

    ``weld`` is the distance, in the file's units, within which vertices on open edges are merged; 0
    merges only coincident ones. The default is the file's numeric precision: a few units in the
    last place of single precision, or of the written digits.

    Faces keep the file's order; quads and n-gons are triangulated in place (except that an OFF file
    with mixed polygons gives its triangles first). Unused vertices are dropped. All geometries of a
    glTF scene are joined in world space. Parts whose faces point inwards or are inconsistent are
    flipped for the optimisation, but saved with the file's own winding. Open, non-manifold and
    multi-component meshes are accepted; degenerate faces are kept.

    Raises `UserError`, one sentence with the file's name and a remedy, for anything but a mesh with
    a surface.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if path.is_dir():
        raise UserError(f"'{path}' is a folder: give a mesh file ({', '.join(READABLE)}).")
    if kind not in READABLE:
        what = f"ends in '{path.suffix}'" if path.suffix else "has no extension"
        raise UserError(f"'{path}' {what}: supported mesh files are {', '.join(READABLE)}.")
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise UserError(f"'{path}' does not exist: check the path of the mesh.") from None
    except PermissionError:
        raise UserError(f"'{path}' is not readable: change the file's permissions.") from None
    except OSError as error:
        raise UserError(f"'{path}' cannot be read ({error.strerror or error}).") from None
    heads.check(path)
    try:
        # Garbage may contain numbers that overflow; `weld` reports them.
        with np.errstate(all="ignore"):
            read = READERS.get(kind, _read)
            points, carrier, notes = read(data, path)
        return welding.weld(path.stem, points, carrier, notes, weld)
    except UserError as error:
        raise UserError(f"'{path}' {error}") from None
    except MemoryError:
        raise UserError(
            f"'{path}' needs more memory than available: give a smaller mesh, or export it again."
        ) from None
    except Exception as error:
        detail = " ".join(str(error).split())[:120]
        raise UserError(
            f"'{path}' is not a readable {kind[1:].upper()} file "
            f"({type(error).__name__}: {detail}): export the mesh again, with all files it needs."
        ) from None


def _read(data: bytes, path: Path) -> tuple[np.ndarray, Carrier, list[str]]:
    """Read the rows' positions, the carrier, and notes, through trimesh."""
    kind = path.suffix.lower()[1:]
    truncation.check(kind, data)
    resolver = Beside(path)
    scene = trimesh.load_scene(io.BytesIO(data), file_type=kind, resolver=resolver, process=False)
    notes: list[str] = []
    nodes = _own_geometries(scene)
    if len(nodes) < len(scene.graph.nodes_geometry):
        notes.append("left out parts without faces")
    if not nodes:
        nothing = np.zeros((0, 3), dtype=np.int64)
        points = [nothing, *(each.vertices for each in scene.geometry.values())]
        return np.concatenate(points), Carrier(nothing, nothing, nothing), notes

    unused, lengths = 0, [0]
    parts: dict[str, int] = {}
    columns: dict[str, list[Any]] = defaultdict(list)
    materials: dict[int, tuple[int, Any]] = {}
    for node in nodes:
        matrix, name = scene.graph[node]
        shape = scene.geometry[name]
        check_indices(shape.faces, len(shape.vertices))
        declared = _declared_faces(kind, data)
        if len(shape.faces) < declared:
            raise UserError("ends too early: export the mesh again.")
        if 0 < declared < len(shape.faces):
            notes.append("triangulated quads or larger polygons")
        if kind == "off":
            shape.faces = _in_file_order(np.asarray(shape.faces))
        unused += len(shape.vertices)
        shape.remove_unreferenced_vertices()
        unused -= len(shape.vertices)

        # Per the specification, a mirrored node reverses the winding.
        faces = shape.faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else shape.faces
        part = node if len(nodes) > 1 else path.stem
        number, material = -1, _material(shape.visual)
        if material is not None:
            number, _ = materials.setdefault(hash(material), (len(materials), material))
        for column, values in (
            ("points", trimesh.transform_points(shape.vertices, matrix)),
            ("corners", faces + sum(lengths)),
            ("uv", getattr(shape.visual, "uv", None)),
            ("colors", _colors(shape.visual)),
            ("part", np.full(len(faces), parts.setdefault(part, len(parts)))),
            ("material", np.full(len(faces), number)),
        ):
            columns[column].append(values)
        lengths.append(len(shape.vertices))

    if unused:
        notes.append(f"left out {plural(unused, 'vertex', 'vertices')} that no face uses")
    corners = np.concatenate(columns["corners"])
    positions = np.concatenate(columns["points"])
    carrier = Carrier(
        corners,
        np.zeros(sum(lengths), dtype=np.int64),
        np.zeros(len(corners), dtype=bool),
        precision=_precision(kind, data, positions),
        uv=_joined(columns["uv"], lengths[1:], np.zeros(2)),
        colors=_joined(columns["colors"], lengths[1:], np.full(4, 255, dtype=np.uint8)),
        parts=tuple(parts),
        face_part=np.concatenate(columns["part"]),
        materials=tuple(material for _, material in materials.values()),
        face_material=np.concatenate(columns["material"]),
    )
    return positions, carrier, notes


def _precision(kind: str, data: bytes, points: np.ndarray) -> float:
    if kind == "stl" and (b"\0" in data[:1000] or b"facet" not in data[:1000]):
        return precision.of_floats(points)
    words = data[: 1 << 22].replace(b"\r", b"\n").split()
    return precision.of_text(words, points)


def _declared_faces(kind: str, data: bytes) -> int:
    """Number of faces declared by an OFF file, because trimesh accepts truncated files."""
    counts = re.search(rb"^(?:OFF)?[ \t]*\d+[ \t]+(\d+)", data, re.MULTILINE)
    return int(counts[1]) if kind == "off" and counts else 0


def _own_geometries(scene: trimesh.Scene) -> list[str]:
    """Nodes with a surface, in the order of the file's meshes, each with its own copy."""
    position = {name: k for k, name in enumerate(scene.geometry)}
    parents = scene.graph.transforms.parents
    nodes = sorted(scene.graph.nodes_geometry, key=lambda node: position[scene.graph[node][1]])
    shapes: dict[str, Any] = {}
    for node in nodes:
        matrix, name = scene.graph.get(node, frame_from=parents[node])
        shape = scene.geometry[name]
        if name in shapes:
            shape = shape.copy(include_cache=True)
            name = trimesh.util.unique_name(name, {*scene.geometry, *shapes})
            scene.graph.update(node, frame_from=parents[node], matrix=matrix, geometry=name)
        shapes[name] = shape
    scene.geometry.clear()
    scene.geometry.update(shapes)
    return [
        node for node in nodes if len(getattr(scene.geometry[scene.graph[node][1]], "faces", ()))
    ]


def _in_file_order(faces: np.ndarray) -> np.ndarray:
    """Interleave quad halves: trimesh returns the first halves of all quads, then the second
    ones."""
    first, second = faces[: len(faces) // 2], faces[len(faces) // 2 :]
    if len(first) == len(second) and (first[:, [2, 0]] == second[:, [0, 2]]).all():
        return np.stack([first, second], axis=1).reshape(-1, 3)
    return faces


def _colors(visual: Any) -> np.ndarray | None:
    if visual.kind == "texture":
        colors = visual.vertex_attributes.get("color")
    else:
        colors = visual.vertex_colors if visual.kind in ("vertex", "face") else None
    return None if colors is None else trimesh.visual.color.to_rgba(colors)


def _material(visual: Any) -> Any:
    material = getattr(visual, "material", None)
    return material


def _joined(columns: list[Any], lengths: list[int], filler: np.ndarray) -> np.ndarray | None:
    """One attribute for all rows, filled where a part lacks it; None if no part has it."""
    if all(each is None for each in columns):
        return None
    filled: list[np.ndarray] = [
        np.tile(filler, (length, 1)) if each is None else each
        for each, length in zip(columns, lengths, strict=True)
    ]
    return np.concatenate(filled)
