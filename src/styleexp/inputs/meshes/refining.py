"""Refine a mesh for a relief, preserving its surface and attributes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from styleexp.inputs.meshes.flipping import flipped
from styleexp.inputs.meshes.mesh import Carrier, Mesh, vertex_normals
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

ROUNDS = 30
"""Maximum number of rounds."""
NEARLY = 0.7
"""An edge is split once it is longer than this share of the longest edge of every face at it, so
that thin triangles become shorter before they become smaller."""
CREASE = 0.8
"""Cosine between a vertex normal and a face normal below which the vertex is on a crease; its edges
stay straight."""
MOST_FACES = 4_000_000


def refine(mesh: Mesh, longest: float) -> Mesh:
    """Refine until no edge is longer than ``longest``, in the mesh's own units: longer edges are
    split in half, and their faces into two to four.

    New vertices lie on a cubic curve through the ends of their edge, perpendicular to the normals
    there (as in Vlachos et al. 2001), so smooth parts stay smooth; at creases and boundaries they
    are edge midpoints. Texture coordinates with their seams, colours, custom vertex attributes,
    materials, parts and groups are preserved. Other data of a PLY or glTF file is dropped, with a
    note in ``repairs``. A mesh that is fine enough is returned unchanged.

    Raises `UserError` if more than `MOST_FACES` faces would be needed.
    """
    if not longest > 0:
        raise ValueError(f"edges of at most {longest}")
    carrier = mesh.carrier or Carrier(
        mesh.faces,
        np.arange(len(mesh.vertices)),
        np.zeros(len(mesh.faces), bool),
        parts=(mesh.name,),
    )
    before = len(mesh.faces)
    vertices = mesh.vertices
    for _ in range(ROUNDS):
        faces = carrier.rows[carrier.corners]
        edges, of_face = _edges(faces)
        length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
        split = length > longest
        if not split.any():
            break
        of_faces = length[of_face]
        split[of_face[of_faces < NEARLY * of_faces.max(axis=1, keepdims=True)]] = False
        if len(faces) + 2 * split.sum() > MOST_FACES:
            raise UserError(
                f"'{mesh.name}' would need more than {MOST_FACES:,} faces for this relief: "
                "increase style.scale."
            )
        outward = np.where(carrier.flipped[:, None], faces[:, ::-1], faces)
        vertices, carrier = _split(vertices, carrier, outward, edges, of_face, split)
        carrier = flipped(vertices, carrier, longest)
    if len(carrier.corners) == before:
        return mesh
    left_out = _gltf_alone(carrier) if carrier.document else ""
    left_out = _ply_alone(carrier) if carrier.ply else left_out
    note = f"refined from {before:,} to {len(carrier.corners):,} faces"
    if left_out:
        note += f", without {left_out}"
    carrier = replace(carrier, ply=None, document=None)
    faces = carrier.rows[carrier.corners]
    faces = np.where(carrier.flipped[:, None], faces[:, ::-1], faces)
    repairs = (*mesh.repairs, note)
    return Mesh(mesh.name, vertices, np.ascontiguousarray(faces), repairs, carrier)


def _edges(
    faces: Int[np.ndarray, "faces 3"],
) -> tuple[Int[np.ndarray, "edges 2"], Int[np.ndarray, "faces 3"]]:
    """Unique edges, and the three edge indices of each face, from corner 0 to 1, 1 to 2, 2 to 0."""
    pairs = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1).astype(np.int64)
    base = int(faces.max()) + 1
    keys, inverse = np.unique(pairs[:, 0] * base + pairs[:, 1], return_inverse=True)
    return np.stack([keys // base, keys % base], axis=1), inverse.reshape(-1, 3)


def _split(
    vertices: Float[np.ndarray, "vertices 3"],
    carrier: Carrier,
    outward: Int[np.ndarray, "faces 3"],
    edges: Int[np.ndarray, "edges 2"],
    of_face: Int[np.ndarray, "faces 3"],
    split: Bool[np.ndarray, " edges"],
) -> tuple[Float[np.ndarray, "more 3"], Carrier]:
    """One round: insert a vertex in the middle of every edge to split."""
    new_vertex = np.full(len(edges), -1)
    new_vertex[split] = len(vertices) + np.arange(split.sum())
    middles = _middles(vertices, outward, edges[split])

    # Likewise for the file's rows: a seam edge has one midpoint per side.
    row_edges, of_corner = _edges(carrier.corners)
    vertex_edge = np.empty(len(row_edges), dtype=np.int64)
    vertex_edge[of_corner.ravel()] = of_face.ravel()
    chosen = split[vertex_edge]
    new_row = np.full(len(row_edges), -1)
    new_row[chosen] = len(carrier.rows) + np.arange(chosen.sum())
    a, b = row_edges[chosen].T

    corners, parent = _cut(carrier.corners, new_row[of_corner])
    of_rows = _halves(a, b)
    return np.concatenate([vertices, middles]), replace(
        carrier,
        corners=corners,
        rows=np.concatenate([carrier.rows, new_vertex[vertex_edge[chosen]]]),
        flipped=carrier.flipped[parent],
        uv=of_rows(carrier.uv),
        normals=_unit(of_rows(carrier.normals)),
        colors=of_rows(carrier.colors),
        shades=of_rows(carrier.shades),
        attributes={name: _given(of_rows(values)) for name, values in carrier.attributes.items()},
        face_part=_taken(carrier.face_part, parent),
        face_material=_taken(carrier.face_material, parent),
        face_colors=_taken(carrier.face_colors, parent),
        labels={word: (texts, of[parent]) for word, (texts, of) in carrier.labels.items()},
    )


def _cut(
    corners: Int[np.ndarray, "faces 3"], middle: Int[np.ndarray, "faces 3"]
) -> tuple[Int[np.ndarray, "more 3"], Int[np.ndarray, " more"]]:
    """Split faces at the midpoints of their edges (-1 for unsplit edges); also return the original
    face of each, in order."""
    found, parents = [], []
    count = (middle >= 0).sum(axis=1)
    # Rotate so that the edges to split, or the one not to split, come first.
    first = np.where(count == 1, (middle >= 0).argmax(1), (middle < 0).argmin(1))
    first = np.where(count == 2, ((middle < 0).argmax(1) + 1) % 3, first)
    turn = (first[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(corners, turn, axis=1).T
    ab, bc, ca = np.take_along_axis(middle, turn, axis=1).T
    pieces = {
        0: [(a, b, c)],
        1: [(a, ab, c), (ab, b, c)],
        2: [(ab, b, bc), (a, ab, bc), (a, bc, c)],
        3: [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)],
    }
    for number, triangles in pieces.items():
        of = np.flatnonzero(count == number)
        for triangle in triangles:
            found.append(np.stack([each[of] for each in triangle], axis=1))
            parents.append(of)
    parent = np.concatenate(parents)
    order = np.argsort(parent, kind="stable")
    return np.concatenate(found)[order], parent[order]


def _middles(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    edges: Int[np.ndarray, "edges 2"],
) -> Float[np.ndarray, "edges 3"]:
    """Midpoints of the edges' curves."""
    normals = vertex_normals(vertices, faces)
    a, b = edges.T
    along = vertices[b] - vertices[a]
    flat = (vertices[a] + vertices[b]) / 2
    smooth = _smooth(vertices, normals, faces)
    curved = (along * normals[b]).sum(1, keepdims=True) * normals[b]
    curved -= (along * normals[a]).sum(1, keepdims=True) * normals[a]
    return flat + np.where((smooth[a] & smooth[b])[:, None], curved / 8, 0.0)


def _smooth(
    vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray
) -> Bool[np.ndarray, " vertices"]:
    """Whether all faces at a vertex agree with its normal, and it isn't on a boundary."""
    corners = [vertices[faces[:, k]] for k in range(3)]
    flat = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    length = np.linalg.norm(flat, axis=1, keepdims=True)
    flat /= length.clip(min=1e-300)
    smooth = np.ones(len(vertices), dtype=bool)
    for k in range(3):
        away = (flat * normals[faces[:, k]]).sum(1) < CREASE
        smooth[faces[away & (length[:, 0] > 0), k]] = False
    edges, of_face = _edges(faces)
    open_ = np.bincount(of_face.ravel(), minlength=len(edges)) == 1
    smooth[edges[open_].ravel()] = False
    return smooth


def _halves(a: np.ndarray, b: np.ndarray) -> Callable[[np.ndarray | None], np.ndarray | None]:
    """Return a function that appends the means of row pairs to a column, keeping its dtype."""

    def extended(column: np.ndarray | None) -> np.ndarray | None:
        if column is None:
            return None
        mean = (column[a].astype(np.float64) + column[b]) / 2
        if np.issubdtype(column.dtype, np.integer):
            mean = mean.round()
        return np.concatenate([column, mean.astype(column.dtype)])

    return extended


def _given(column: np.ndarray | None) -> np.ndarray:
    assert column is not None
    return column


def _ply_alone(carrier: Carrier) -> str:
    """Data of a PLY file that only its own tables hold."""
    vertex = [each for each in carrier.ply.own if each not in carrier.attributes
              and each[:-1].removesuffix("_") not in carrier.attributes]  # fmt: skip
    parts = [
        f"vertex properties ({', '.join(vertex)})" if vertex else "",
        f"face properties ({', '.join(carrier.ply.own_faces)})" if carrier.ply.own_faces else "",
    ]
    return " and ".join(filter(None, parts))


def _gltf_alone(carrier: Carrier) -> str:
    """Data of a glTF file that only its own document holds."""
    tree = carrier.document.tree
    materials = tree.get("materials", [])
    primitives = [each for mesh in tree.get("meshes", []) for each in mesh.get("primitives", [])]
    surfaces = [each.get("pbrMetallicRoughness", {}) for each in materials]
    stored = {name for each in primitives for name in each["attributes"]}
    found = {
        "skins": tree.get("skins"),
        "animations": tree.get("animations"),
        "cameras": tree.get("cameras"),
        "lights": "KHR_lights_punctual" in tree.get("extensions", {}),
        "morph targets": any(each.get("targets") for each in primitives),
        "further texture coordinates": "TEXCOORD_1" in stored,
        "normal maps": any("normalTexture" in each for each in materials),
        "occlusion maps": any("occlusionTexture" in each for each in materials),
        "emission maps": any("emissiveTexture" in each for each in materials),
        "roughness maps": any("metallicRoughnessTexture" in each for each in surfaces),
        "extensions of materials": any(each.get("extensions") for each in materials),
    }
    *most, last = [name for name, there in found.items() if there] or [""]
    return f"{', '.join(most)} and {last}" if most else last


def _unit(normals: np.ndarray | None) -> np.ndarray | None:
    if normals is None:
        return None
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(length > 1e-12, length, 1.0)


def _taken(column: np.ndarray | None, parent: np.ndarray) -> np.ndarray | None:
    return None if column is None else column[parent]
