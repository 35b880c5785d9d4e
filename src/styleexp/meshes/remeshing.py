"""Coarse meshes made dense enough to be displaced."""

from __future__ import annotations

import contextlib
from dataclasses import replace

import numpy as np
import trimesh

from styleexp.errors import UserError
from styleexp.meshes.mesh import Mesh, face_areas, normalisation
from styleexp.meshes.welding import torn


def remesh(mesh: Mesh, target_vertices: int) -> Mesh:
    """Make a coarse mesh dense: about ``target_vertices`` even triangles' vertices on its surface.

    Botsch and Kobbelt's remesher from gpytoolbox, the surface re-projected onto the input. A mesh
    that already has as many vertices comes back as it is. One that the remesher cannot take
    (non-manifold, or it fails) is divided uniformly instead, each face into four, until it has as
    many. Either way ``repairs`` says what was done; attributes, materials and parts are lost.
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
        if "manifold" in reason and (told := torn(mesh.vertices, mesh.faces)):
            reason += f"; {told}"
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
    """Vertices and faces of an even mesh of about ``count`` vertices on the mesh's surface, whether
    it has more or fewer. Raises `UserError` where the remesher can't take it."""
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
    """Why the remesher, which trusts its input, must not be given this mesh."""
    mesh = trimesh.Trimesh(points, faces, process=False)
    if np.unique(mesh.edges_sorted, axis=0, return_counts=True)[1].max() > 2:
        return "it is not manifold (an edge has more than two faces)"
    if (face_areas(points, faces) < 1e-14).any():
        return "it has degenerate faces"
    # The faces around a vertex must be one fan: corners that share an edge are joined.
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
    """Vertices, faces and whether creases were kept; None where the remesher fails."""
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

    # Even triangles of edge h: area sqrt(3)/4 h² each, half as many vertices as faces.
    length = float(np.sqrt(2.0 * face_areas(points, faces).sum() / (np.sqrt(3.0) * target)))
    try:
        best, result = length, run(length, False)
        for _ in range(3):
            ratio = len(result[0]) / target
            if 0.9 < ratio < 1.1:
                break
            # Edges from 4/5 to 4/3 of the length stay: near the input's own it reacts little.
            length *= ratio**0.75
            other = run(length, False)
            if abs(np.log(len(other[0]) / target)) < abs(np.log(ratio)):
                best, result = length, other
    except Exception:  # of several kinds; the caller subdivides instead and says so
        return None
    # Kept creases suit machined shapes; on organic ones they often cost slivers or many vertices.
    with contextlib.suppress(Exception):
        creased = run(best, True)
        areas = face_areas(*creased)
        even = areas.min() > 0.02 * areas.mean() and unfit(*creased) is None
        if even and len(creased[0]) < 1.3 * target:
            return *creased, True
    return *result, False
