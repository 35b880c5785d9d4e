"""Files to meshes: trimesh reads, and one sentence says what is wrong."""

from __future__ import annotations

import io
import os
from pathlib import Path

import numpy as np
import trimesh

from styleexp.errors import UserError
from styleexp.meshes.mesh import Carrier, Mesh
from styleexp.meshes.obj import read_obj, surface
from styleexp.meshes.welding import check_indices, plural, weld

READABLE = (".obj", ".ply", ".stl", ".off", ".glb", ".gltf")


def load_mesh(path: str | os.PathLike[str]) -> Mesh:
    """Load an OBJ, PLY, STL, OFF, GLB or glTF file as one welded triangle mesh.

    Faces keep the file's order, quads and n-gons triangulated in place (but a PLY or OFF file that
    mixes them gives its triangles first). Vertices at one position become one; vertices that no
    face uses are left out. All geometries of a glTF scene are joined in world space. Parts whose
    faces point inwards, or disagree among themselves, are turned for the optimisation and saved
    with the file's own winding. Open, non-manifold and multi-component meshes are accepted,
    degenerate faces are kept.

    Raises `UserError`, one sentence with the file's name and a remedy, for anything that is not a
    mesh with a surface.
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
        raise UserError(f"'{path}' may not be read: change the file's permissions.") from None
    except OSError as error:
        raise UserError(f"'{path}' cannot be read ({error.strerror or error}).") from None
    if not data.strip():
        raise UserError(f"'{path}' is empty: export the mesh again.")
    try:
        # Junk may hold numbers that overflow on the way; `weld` speaks about them.
        with np.errstate(all="ignore"):
            points, carrier, notes = (read_obj if kind == ".obj" else _read)(data, path)
        return weld(path.stem, points, carrier, notes)
    except UserError as error:
        raise UserError(f"'{path}' {error}") from None
    except (MemoryError, KeyboardInterrupt):
        raise
    except Exception as error:
        detail = " ".join(str(error).split())[:120]
        remedy = "as OBJ, or with triangles only" if kind == ".ply" else "with all files it needs"
        raise UserError(
            f"'{path}' is not a readable {kind[1:].upper()} file "
            f"({type(error).__name__}: {detail}): export the mesh again, {remedy}."
        ) from None


def _read(data: bytes, path: Path) -> tuple[np.ndarray, Carrier, list[str]]:
    """The rows' positions, the rest, and notes, of any format that trimesh reads."""
    kind = path.suffix.lower()[1:]
    resolver = trimesh.resolvers.FilePathResolver(str(path.absolute()))
    scene = trimesh.load_scene(
        io.BytesIO(data), file_type=kind, resolver=resolver, process=False, metadata={}
    )
    notes: list[str] = []
    shapes = _own_geometries(scene, notes)
    gltf = kind in ("glb", "gltf")
    if not shapes:
        points = [g.vertices for g in scene.geometry.values()]
        return np.concatenate([np.zeros((0, 3)), *points]), _carrier([], [], [0]), notes

    start, unused = [0], 0
    points, corners, uv, colors, normals = [], [], [], [], []
    parts: dict[str, int] = {}
    face_part, materials, face_material = [], [], []
    for node, shape, matrix in shapes:
        check_indices(shape.faces, len(shape.vertices))
        if kind == "ply" and len(shape.faces) < _declared_faces(shape):
            raise UserError("ends too early: export the mesh again.")
        if kind in ("ply", "off"):
            shape.faces = _in_file_order(shape.faces)
        unused += len(shape.vertices)
        shape.remove_unreferenced_vertices()
        unused -= len(shape.vertices)
        n = len(shape.vertices)
        points.append(trimesh.transform_points(shape.vertices, matrix))
        # The specification: a mirrored node winds the other way.
        faces = shape.faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else shape.faces
        corners.append(np.asarray(faces) + start[-1])
        start.append(start[-1] + n)

        visual = shape.visual
        given = getattr(visual, "uv", None)
        uv.append(None if given is None else np.asarray(given, dtype=np.float64)[:, :2])
        color = visual.vertex_colors if visual.kind == "vertex" else None
        if visual.kind == "face":
            color = trimesh.visual.color.face_to_vertex_color(shape, visual.face_colors)
        if visual.kind == "texture":
            color = visual.vertex_attributes.get("color")
        colors.append(None if color is None else trimesh.visual.color.to_rgba(color))
        if gltf:
            normals.append(shape.vertex_normals @ np.linalg.pinv(matrix[:3, :3]))

        part = node if gltf or len(shapes) > 1 else path.stem
        if shape.metadata.get("from_gltf_primitive"):
            part = scene.graph.transforms.parents[node]
        face_part.append(np.full(len(faces), parts.setdefault(part, len(parts))))
        material = getattr(visual, "material", None)
        if not gltf and material is not None:  # a PLY file's texture, if it has one
            material = surface("material", material.image) if material.image else None
        hashes = [hash(each) for each in materials]
        if material is not None and hash(material) not in hashes:
            materials.append(material)
            hashes.append(hash(material))
        number = -1 if material is None else hashes.index(hash(material))
        face_material.append(np.full(len(faces), number))

    if unused:
        notes.append(f"left out {plural(unused, 'vertex', 'vertices')} that no face uses")
    lengths = np.diff(start)
    carrier = _carrier(
        corners,
        [uv, colors, normals],
        lengths,
        parts=tuple(parts),
        face_part=np.concatenate(face_part),
        materials=tuple(materials),
        face_material=np.concatenate(face_material),
        scene=scene if gltf else None,
    )
    return np.concatenate(points), carrier, notes
