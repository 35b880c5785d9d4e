"""Remesh coarse meshes densely enough for displacement."""

from __future__ import annotations

import contextlib
from dataclasses import replace

import numpy as np
import trimesh

from styleexp.inputs.meshes.mesh import Mesh, face_areas, normalisation
from styleexp.inputs.meshes.welding import torn
from styleexp.system.errors import UserError


def remesh(mesh: Mesh, target_vertices: int) -> Mesh:
    """Remesh a coarse mesh to about ``target_vertices`` vertices of uniform triangles.

    Uses Botsch and Kobbelt's remesher from gpytoolbox, which projects onto the input. A mesh with
    enough vertices is returned unchanged. If the remesher can't handle the mesh (non-manifold, or
    it fails), each face is subdivided into four until there are enough vertices. ``repairs`` says
    what was done. Attributes, materials and parts are lost.
    """
    before = len(mesh.vertices)
    if before >= target_vertices:
        note = f"not remeshed: it has {before} vertices already"
        return replace(mesh, repairs=(*mesh.repairs, note))
    frame = normalisation(mesh.vertices)
    points = frame.apply(mesh.vertices)
    reason = unfit(points, mesh.faces)
    result = None if reason else _botsch(points, mesh.faces, target_vertices)
    if result is None:
        reason = reason or "the remesher failed"
        if "manifold" in reason and (note := torn(mesh.vertices, mesh.faces)):
            reason += f"; {note}"
        vertices, faces, times = points, mesh.faces, 0
        while len(vertices) < target_vertices:
            vertices, faces = trimesh.remesh.subdivide(vertices, faces)
            times += 1
        how = f"divided each face into {4**times} because {reason}"
    else:
        vertices, faces, creases = result
        how = "remeshed evenly, creases kept" if creases else "remeshed evenly"
    note = f"{how}: {before} to {len(vertices)} vertices"
    carrier = mesh.carrier
    if carrier is not None and (
        carrier.uv is not None or carrier.colors is not None or carrier.materials
    ):
        note += "; texture coordinates, colours and materials are not kept"
    return Mesh(mesh.name, frame.invert(vertices), faces, (*mesh.repairs, note))


def resample(mesh: Mesh, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Resample a mesh, up or down, to about ``count`` uniform vertices; return vertices and faces.
    Raises `UserError` if the remesher can't handle it."""
    frame = normalisation(mesh.vertices)
    points = frame.apply(mesh.vertices)
    reason = unfit(points, mesh.faces)
    result = None if reason else _botsch(points, mesh.faces, count)
    if result is None:
        raise UserError(
            f"'{mesh.name}' can't be resampled to {count} vertices: "
            f"{reason or 'the remesher failed'}; repair it, or choose another mesh."
        )
    return frame.invert(result[0]), result[1]


def unfit(points: np.ndarray, faces: np.ndarray) -> str | None:
    """Why the remesher, which doesn't validate its input, can't be used on this mesh."""
    mesh = trimesh.Trimesh(points, faces, process=False)
    if np.unique(mesh.edges_sorted, axis=0, return_counts=True)[1].max() > 2:
        return "it is not manifold (an edge has more than two faces)"
    if (face_areas(points, faces) < 1e-14).any():
        return "it has degenerate faces"
    # The faces around a vertex must form a single fan: join corners that share an edge.
    ends = mesh.face_adjacency_edges[:, :, None]
    f, g = (
        3 * face[:, None] + (faces[face][:, None] == ends).argmax(axis=2)
        for face in mesh.face_adjacency.T
    )
    pairs = np.stack([f.ravel(), g.ravel()], axis=1)
    fans = trimesh.graph.connected_component_labels(pairs, node_count=faces.size).max() + 1
    if fans != len(np.unique(faces)):
        return "it is not manifold (a vertex joins several sheets)"
    return None


def _botsch(
    points: np.ndarray, faces: np.ndarray, target: int
) -> tuple[np.ndarray, np.ndarray, bool] | None:
    """Vertices, faces and whether creases were kept; None if the remesher fails."""
    import gpytoolbox

    def run(length: float, creases: bool) -> tuple[np.ndarray, np.ndarray]:
        vertices, new_faces = gpytoolbox.remesh_botsch(
            points,
            faces.astype(np.int32),
            5,
            length,
            True,
            detect_feature_edges=creases,
            feature_dihedral_threshold=60.0,
        )
        if len(new_faces) == 0 or not np.isfinite(vertices).all():
            raise ValueError("nothing left")
        return np.asarray(vertices, dtype=np.float64), np.asarray(new_faces, dtype=np.int64)

    # Uniform triangles of edge h: area sqrt(3)/4 h² each, half as many vertices as faces.
    length = float(np.sqrt(2.0 * face_areas(points, faces).sum() / (np.sqrt(3.0) * target)))
    try:
        best, result = length, run(length, False)
        for _ in range(3):
            ratio = len(result[0]) / target
            if 0.9 < ratio < 1.1:
                break
            # Edges of 4/5 to 4/3 of the target length stay, so near the input's own it changes
            # little.
            length *= ratio**0.75
            other = run(length, False)
            if abs(np.log(len(other[0]) / target)) < abs(np.log(ratio)):
                best, result = length, other
    except Exception:  # several kinds; the caller subdivides instead and says so
        return None
    # Preserving creases suits machined shapes; on organic ones it often costs slivers or many
    # vertices.
    with contextlib.suppress(Exception):
        creased = run(best, True)
        areas = face_areas(*creased)
        even = areas.min() > 0.02 * areas.mean() and unfit(*creased) is None
        if even and len(creased[0]) < 1.3 * target:
            return *creased, True
    return *result, False
