"""Third-party renderers on the same task. Imported on demand.

Each is used as in its own examples: one light, smooth normals, anti-aliased outlines with
gradients. Views are rendered one by one if it doesn't support batches.
"""

from __future__ import annotations

import importlib.util
import warnings

import numpy as np

from styleexp.experiments.bench.task import Contender, Rendered, Task
from styleexp.system.errors import UserError

INSTALL = {
    "deodr": "pip install 'styleexp[bench]'",
    "pytorch3d": "see pytorch3d's INSTALL.md",
    "nvdiffrast": "see nvdiffrast's documentation; it needs CUDA",
}


def _need(name: str) -> None:
    if importlib.util.find_spec(name) is None:
        raise UserError(f"the peer '{name}' is not installed: {INSTALL[name]}.")


def deodr(task: Task) -> Contender:
    """DEODR (BSD): C++ on the CPU, float64, one view at a time."""
    _need("deodr")
    with warnings.catch_warnings(action="ignore"):  # about its own docstrings
        from deodr.differentiable_renderer import Camera, Scene3D
        from deodr.triangulated_mesh import ColoredTriMesh

    cameras, size = task.cameras, task.resolution
    vertices = task.vertices.double().numpy()
    grey = np.full((len(vertices), 1), task.shading.albedo)
    mesh = ColoredTriMesh(task.faces.numpy().astype(np.uint32), vertices, colors=grey)
    turn = np.diag([1.0, -1.0, -1.0])  # its cameras look along +Z with +Y down
    views, lights = [], []
    for i in range(len(cameras)):
        rotation = _nearest_rotation(cameras.rotation[i].double().numpy())
        shift = cameras.translation[i].double().numpy()
        x, y = (cameras.focal[i].double().numpy() * size / 2).tolist()
        inner = np.array([[x, 0, size / 2], [0, y, size / 2], [0, 0, 1]])
        views.append(Camera(np.column_stack([turn @ rotation, turn @ shift]), inner, size, size))
        lights.append(-rotation.T @ np.asarray(task.shading.light))
    weights = task.weights.double().numpy()[..., None]

    def run() -> Rendered:
        images, gradient = [], np.zeros_like(vertices)
        for camera, light, weight in zip(views, lights, weights, strict=True):
            scene = Scene3D(sigma=1.0, integer_pixel_centers=False)
            mesh.set_vertices(vertices)
            scene.set_mesh(mesh)
            scene.set_background_color([task.shading.background])
            scene.set_light(light, task.shading.ambient)
            images.append(scene.render(camera)[..., 0])
            scene.clear_gradients()
            scene.render_backward(weight)
            gradient += mesh._vertices_b
        return Rendered(np.stack(images), gradient)

    return run


def _nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """Nearest exact rotation; DEODR rejects rotations with float32 rounding."""
    u, _, v = np.linalg.svd(matrix)
    return u @ v


PEERS = {"deodr": deodr}
"""Third-party renderers. Built-in backends can be compared too, by name."""
