"""Convert a file's rows to a validated, welded, outward-facing mesh."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import trimesh

from styleexp.inputs.meshes import joining
from styleexp.inputs.meshes.heads import NO_FACES
from styleexp.inputs.meshes.mesh import Carrier, Mesh, face_areas
from styleexp.system.errors import UserError

LEAST = 1e-9
"""Merge distance for double-precision files, as a fraction of the extent; accounts for rounding by
node transforms and exporters."""
GAP = 1e-4
"""Open edges closer than this fraction of the extent were probably not meant to be open."""


def plural(count: int, one: str, many: str) -> str:
    """``1 face`` or ``2 faces``."""
    return f"{count} {one if count == 1 else many}"


def check_indices(corners: np.ndarray, count: int) -> None:
    """Raise `UserError` if a corner refers to a vertex beyond ``count``."""
    bad = corners[(corners < 0) | (corners >= count)]
    if bad.size:
        raise UserError(
            f"has a face that refers to vertex {bad.flat[0]} (counted from 0), but there are only "
            f"{count} vertices: export the mesh again."
        )


def weld(
    name: str,
    points: np.ndarray,
    carrier: Carrier,
    notes: list[str],
    distance: float | None = None,
) -> Mesh:
    """Merge the rows at ``points`` (rows, 3) to one vertex per position; sets ``carrier.rows``.

    Coincident rows become one vertex; on open edges, so do rows within ``distance``, in the file's
    units, by default the file's numeric precision (`joining.near`).

    Raises `UserError` with a message that lacks its subject, the file's name.
    """
    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    if len(carrier.corners) == 0:
        what = "is a point cloud" if len(points) else "contains no mesh"
        raise UserError(f"{what}: {NO_FACES}")
    infinite = int((~np.isfinite(points).all(axis=1)).sum())
    if infinite:
        number = plural(infinite, "vertex", "vertices")
        raise UserError(
            f"has {number} with NaN or infinite coordinates: repair it in a mesh editor."
        )
    extent = float(np.ptp(points, axis=0).max())
    if extent <= 0.0:
        raise UserError("has no extent: all its vertices coincide; export it again, uncompressed.")
    if not 1e-100 < extent < 1e100:  # outside, squared coordinates underflow or overflow
        raise UserError(
            f"has an extent of {extent:g}, which is too small or too large: scale the mesh."
        )
    if np.abs(points).max() > 1e3 * extent:
        notes.append("is far from the origin, where PLY and GLB round coordinates; OBJ does not")

    # The first occurrence determines a vertex's index and position, so that order is preserved.
    first, rows = joining.exact(points)
    reach = max(LEAST * extent, carrier.precision) if distance is None else distance
    owner = joining.near(points[first], rows[carrier.corners], reach)
    joined = int((owner != np.arange(len(owner))).sum())
    if joined:
        kept, place = np.unique(owner, return_inverse=True)
        first, rows = first[kept], place[rows]
        number = plural(joined, "vertex", "vertices")
        notes.append(f"merged {number} within {reach:.2g} of others on open edges")
    vertices = points[first]
    file_faces = rows[carrier.corners]
    if note := torn(vertices, file_faces):
        notes.append(note)

    unit = (vertices - vertices.mean(axis=0)) / extent
    degenerate = int((face_areas(unit, file_faces) <= 1e-20).sum())
    if degenerate == len(file_faces):
        raise UserError("has only degenerate, zero-area faces: export the mesh again.")
    if degenerate:
        number = plural(degenerate, "degenerate face", "degenerate faces")
        notes.append(f"ignored {number} for the normals")
    flipped = _inside_out(unit, file_faces, notes)
    faces = np.where(flipped[:, None], file_faces[:, ::-1], file_faces)

    carrier = replace(carrier, rows=rows, flipped=flipped)
    columns = (carrier.uv, carrier.normals, carrier.colors, carrier.ply, carrier.document)
    if all(column is None for column in columns) and not carrier.attributes:
        carrier = replace(carrier, corners=file_faces, rows=np.arange(len(vertices)))
    return Mesh(name, vertices, np.ascontiguousarray(faces), tuple(notes), carrier)


def torn(vertices: np.ndarray, faces: np.ndarray) -> str:
    """One sentence on open edges that nearly coincide; empty if there are none."""
    extent = float(np.ptp(vertices, axis=0).max())
    count, gap = joining.nearly_closed(vertices, faces, GAP * extent)
    if not count:
        return ""
    unit = 10.0 ** (np.floor(np.log10(gap)) - 1) if gap > 0 else 1.0
    wide = np.ceil(gap * 1.01 / unit) * unit  # two digits, rounded up
    return (
        f"{plural(count, 'open edge nearly coincides', 'open edges nearly coincide')} with others, "
        f"up to {gap:.2g} apart: source.weld={wide:g} merges them"
    )


def _inside_out(points: np.ndarray, faces: np.ndarray, notes: list[str]) -> np.ndarray:
    """Which faces to flip so that components are consistent and, if closed, face outwards.

    Follows the majority of each component, whereas trimesh's ``fix_winding`` follows one face.
    """
    n = len(faces)
    mesh = trimesh.Trimesh(points, faces, process=False)
    point_like = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    sound = ~point_like[mesh.face_adjacency].any(axis=1)
    (f, g), shared = mesh.face_adjacency[sound].T, mesh.face_adjacency_edges[sound]

    def forward(face: np.ndarray) -> np.ndarray:
        at = (faces[face] == shared[:, :1]).argmax(axis=1)
        return faces[face, (at + 1) % 3] == shared[:, 1]

    # Two nodes per face, original and flipped; edges connect consistent neighbours. Components of
    # this graph come in mirrored pairs unless the surface is one-sided.
    agree = forward(f) != forward(g)
    pairs = [
        np.stack([f, np.where(agree, g, g + n)], axis=1),
        np.stack([f + n, np.where(agree, g + n, g)], axis=1),
    ]
    label = trimesh.graph.connected_component_labels(np.concatenate(pairs), node_count=2 * n)
    as_is, turned = label[:n], label[n:]
    votes = np.bincount(np.minimum(as_is, turned), np.sign(turned - as_is))
    flipped = (as_is < turned) != (votes >= 0)[np.minimum(as_is, turned)]
    flipped &= as_is != turned
    remark = " (saved files keep the input's winding)"
    if flipped.any():
        number = plural(int(flipped.sum()), "face", "faces")
        notes.append(f"flipped {number} inconsistent with their neighbours{remark}")

    agreed = np.where(flipped[:, None], faces[:, ::-1], faces)
    mesh = trimesh.Trimesh(points, agreed.copy(), process=False)
    trimesh.repair.fix_inversion(mesh, multibody=True)
    inward = (mesh.faces != agreed).any(axis=1)
    if inward.any():
        which = "the mesh" if inward.all() else plural(int(inward.sum()), "face", "faces")
        notes.append(f"flipped {which}, because the faces pointed inwards{remark}")
    return flipped ^ inward
