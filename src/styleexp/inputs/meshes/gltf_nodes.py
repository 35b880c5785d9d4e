"""World transforms of a glTF file's nodes, and skinning."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from styleexp.inputs.meshes import accessors
from styleexp.inputs.meshes.accessors import item
from styleexp.system.errors import UserError

LOOKS = re.compile(
    r"KHR_materials_\w+|KHR_texture_\w+|EXT_texture_\w+|KHR_lights_punctual"
    r"|KHR_xmp\w*|KHR_animation_pointer|KHR_mesh_quantization"
)
"""Required glTF extensions that don't affect the surface and may be ignored."""


def world(tree: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Each node's world matrix (nodes, 4, 4), its parent (nodes,), -1 for none, and the scene's
    nodes with a mesh, in order.

    Raises `UserError` if the nodes don't form trees, or a transform is invalid.
    """
    nodes = tree.get("nodes", [])
    parent = np.full(len(nodes), -1)
    for k, node in enumerate(nodes):
        for child in node.get("children", ()):
            item(tree, "nodes", child)
            if parent[child] >= 0:
                raise UserError(
                    f"has nodes[{child}] as a child of two nodes, or twice of one: export the mesh "
                    "again."
                )
            parent[child] = k
    order = [k for k in range(len(nodes)) if parent[k] < 0]
    for k in order:  # the list grows; parents come before their children
        order += nodes[k].get("children", ())
    if len(order) < len(nodes):
        raise UserError("has a cycle of nodes: export the mesh again.")
    matrices = np.tile(np.eye(4), (len(nodes), 1, 1))
    for k in order:
        matrices[k] = _local(nodes[k], k)
        if parent[k] >= 0:
            matrices[k] = matrices[parent[k]] @ matrices[k]
    if not np.isfinite(matrices).all():
        raise UserError("has node transforms that are NaN or infinite: export the mesh again.")
    if not tree.get("scenes"):
        return matrices, parent, []
    scene = item(tree, "scenes", tree.get("scene", 0))
    seen = list(dict.fromkeys(scene.get("nodes", ())))
    inside = {item(tree, "nodes", k) is not None and k for k in seen}
    for k in seen:  # the list grows
        more = [child for child in nodes[k].get("children", ()) if child not in inside]
        inside.update(more)
        seen += more
    return matrices, parent, [k for k in range(len(nodes)) if k in inside and "mesh" in nodes[k]]


def names(tree: dict[str, Any], parent: np.ndarray, shown: list[int]) -> list[str]:
    """Unique names of the nodes with a mesh.

    A mesh that was split into one node per material gets its parent's name.
    """
    given: dict[int, str] = {}
    taken: dict[str, int] = {}
    result = []
    for k in shown:
        mesh = item(tree, "meshes", tree["nodes"][k]["mesh"])
        extras = mesh.get("extras")
        divided = isinstance(extras, dict) and extras.get("from_gltf_primitive")
        owner = int(parent[k]) if divided and parent[k] >= 0 else k
        if owner not in given:
            own = str(tree["nodes"][owner].get("name") or mesh.get("name") or f"node {owner}")
            name = own
            while name in taken:
                taken[own] += 1
                name = f"{own}_{taken[own]}"
            taken[name] = 0
            given[owner] = name
        result.append(given[owner])
    return result


def skinning(
    tree: dict[str, Any],
    buffers: list[bytes],
    skin: Any,
    attributes: dict[str, int],
    matrices: np.ndarray,
) -> np.ndarray:
    """World matrix of each vertex, (vertices, 4, 4): the weighted sum of its joints'.

    The mesh's own node is ignored (glTF 2.0, 3.7.3.3).
    """
    found = item(tree, "skins", skin)
    joints = np.array([k for k in found["joints"] if item(tree, "nodes", k) is not None])
    bind = np.tile(np.eye(4), (len(joints), 1, 1))
    if "inverseBindMatrices" in found:
        stored = accessors.real(tree, buffers, found["inverseBindMatrices"])
        if len(stored) < len(joints) or stored.shape[1] != 16:
            raise UserError("has a skin with too few matrices: export the mesh again.")
        bind = stored[: len(joints)].reshape(-1, 4, 4).swapaxes(1, 2)
    posed = matrices[joints] @ bind
    posed[:, 3] = [0, 0, 0, 1]
    names = sorted(key[7:] for key in attributes if key.startswith("JOINTS_"))
    which = [accessors.read(tree, buffers, attributes[f"JOINTS_{k}"]) for k in names]
    share = [accessors.real(tree, buffers, attributes[f"WEIGHTS_{k}"]) for k in names]
    index, weights = np.concatenate(which, axis=1).astype(np.int64), np.concatenate(share, axis=1)
    index = np.where(weights == 0, 0, index)
    if index.shape != weights.shape or index.max(initial=0) >= len(joints):
        raise UserError("has weights for joints that its skin does not have: export it again.")
    total = weights.sum(axis=1, keepdims=True)
    if (total <= 0).any():
        raise UserError("has skinned vertices without weights: export the mesh again.")
    result = np.zeros((len(index), 4, 4))
    for k in range(index.shape[1]):
        result += (weights[:, k : k + 1] / total)[:, :, None] * posed[index[:, k]]
    return result


def _local(node: dict[str, Any], index: int) -> np.ndarray:
    """A node's matrix to its parent's frame."""
    try:
        if "matrix" in node:
            return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
        x, y, z, w = np.array(node.get("rotation", (0, 0, 0, 1)), dtype=np.float64)
        scale = np.array(node.get("scale", (1, 1, 1)), dtype=np.float64)
        matrix = np.eye(4)
        turn = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
        matrix[:3, :3] = np.array(turn) * scale
        matrix[:3, 3] = node.get("translation", (0, 0, 0))
    except (TypeError, ValueError):
        raise UserError(
            f"has an invalid transform in nodes[{index}]: export the mesh again."
        ) from None
    return matrix
