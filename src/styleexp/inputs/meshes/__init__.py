"""Meshes: load, check, repair, normalise, remesh, and save in the input's own frame.

Files and optimisers need different representations. The optimiser needs one vertex per surface
point, so that a displacement can't tear the surface; files duplicate vertices at texture, normal
and colour seams. `load_mesh` welds by position and keeps the file's own rows and everything else in
a `Carrier`; `save_mesh` writes moved vertices back into them::

    file rows (position, uv, normal, colour)  ── weld ──►  Mesh.vertices  ── optimise ──┐
              ▲                                                                         │
              └─────────────────────────── un-weld (Carrier.rows) ◄─────────────────────┘

glTF (`gltf`, `gltf_writing`), PLY (`ply`, `ply_meshes`) and OBJ (`obj`) have their own readers and
writers here, because no library preserves everything in a file; STL and OFF are read with trimesh.

Coordinates are float64 in the file's frame and scale; for glTF, in the scene's world frame. Faces
wind counter-clockwise seen from outside.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, TypeAlias

from styleexp.inputs.meshes.mesh import Mesh as Mesh
from styleexp.inputs.meshes.mesh import Normalisation as Normalisation
from styleexp.inputs.meshes.mesh import edges_of as edges_of
from styleexp.inputs.meshes.mesh import face_areas as face_areas
from styleexp.inputs.meshes.mesh import mean_edge_length as mean_edge_length
from styleexp.inputs.meshes.mesh import normalisation as normalisation
from styleexp.inputs.meshes.mesh import vertex_normals as vertex_normals

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np
    import trimesh

    from styleexp.inputs.meshes.memory import from_arrays as from_arrays
    from styleexp.inputs.meshes.memory import from_memory as from_memory
    from styleexp.inputs.meshes.reading import load_mesh as load_mesh
    from styleexp.inputs.meshes.refining import refine as refine
    from styleexp.inputs.meshes.remeshing import remesh as remesh
    from styleexp.inputs.meshes.remeshing import resample as resample
    from styleexp.inputs.meshes.writing import save_mesh as save_mesh

    MeshLike: TypeAlias = str | Path | Mesh | trimesh.Trimesh | tuple[np.ndarray, np.ndarray]
    """A name, a file, or a mesh in memory: see `styleexp.stylize`."""

# These import trimesh, lazily.
_HOMES = {
    "from_arrays": "memory",
    "from_memory": "memory",
    "load_mesh": "reading",
    "refine": "refining",
    "remesh": "remeshing",
    "resample": "remeshing",
    "save_mesh": "writing",
}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'styleexp.inputs.meshes' has no attribute '{name}'")
    return getattr(importlib.import_module(f"styleexp.inputs.meshes.{_HOMES[name]}"), name)
