"""Meshes: load, check, repair, normalise, remesh, and save in the input's own frame.

A file and an optimiser want different things of a mesh. The optimiser wants one vertex per point of
the surface, so that a displacement cannot tear it open; a file keeps several wherever a texture,
an edge or a colour has a seam. `load_mesh` welds by position and remembers the file's own rows and
all else that it holds in a `Carrier`; `save_mesh` puts moved vertices back into them::

    file rows (position, uv, normal, colour)  ── weld ──►  Mesh.vertices  ── optimise ──┐
              ▲                                                                         │
              └─────────────────────────── un-weld (Carrier.rows) ◄─────────────────────┘

glTF (`gltf`, `gltf_writing`), PLY (`ply`, `ply_meshes`) and OBJ (`obj`) are read and written here,
as no library gives back all that a file has; STL and OFF are read by trimesh.

Coordinates are float64 in the file's frame and scale, a glTF scene's in its world frame. Faces wind
counter-clockwise seen from outside.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, TypeAlias

from styleexp.meshes.mesh import Mesh as Mesh
from styleexp.meshes.mesh import Normalisation as Normalisation
from styleexp.meshes.mesh import face_areas as face_areas
from styleexp.meshes.mesh import mean_edge_length as mean_edge_length
from styleexp.meshes.mesh import normalisation as normalisation
from styleexp.meshes.mesh import vertex_normals as vertex_normals

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np
    import trimesh

    from styleexp.meshes.memory import from_arrays as from_arrays
    from styleexp.meshes.memory import from_memory as from_memory
    from styleexp.meshes.reading import load_mesh as load_mesh
    from styleexp.meshes.refining import refine as refine
    from styleexp.meshes.remeshing import remesh as remesh
    from styleexp.meshes.remeshing import resample as resample
    from styleexp.meshes.writing import save_mesh as save_mesh

    MeshLike: TypeAlias = str | Path | Mesh | trimesh.Trimesh | tuple[np.ndarray, np.ndarray]
    """A name, a file, or a mesh in memory: see `styleexp.stylize`."""

# These need trimesh, which is loaded when the first of them is used.
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
        raise AttributeError(f"module 'styleexp.meshes' has no attribute '{name}'")
    return getattr(importlib.import_module(f"styleexp.meshes.{_HOMES[name]}"), name)
