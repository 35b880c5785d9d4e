"""Draw meshes with pyrender in its own process: ``python -m styleexp.runs.pyrender_view IN OUT``.

``previews.write_check`` starts it. Two OpenGL libraries in one process conflict, and this module
must not share code with the renderers that it checks: it imports neither them nor torch.

``PYOPENGL_PLATFORM`` chooses ``egl`` or ``osmesa``. IN is an .npz of

- ``vertices`` (V, 3) in world units, ``faces`` (F, 3), counter-clockwise from outside;
- ``rotation`` (views, 3, 3), ``translation`` (views, 3), ``focal`` (views, 2), ``center``
  (views, 2) and ``near``, as in ``styleexp.renderers.base.Cameras``;
- ``size``: side in pixels.

OUT is an .npz of ``pictures`` (views, size, size), 8-bit grey, ``covered`` (views, size, size),
bool, and ``device``, the name of the OpenGL device. If OpenGL is not available, the exit code is 3
and standard error ends with the reason.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

UNAVAILABLE = 3
"""Exit code if pyrender or OpenGL is missing; any other non-zero code is a failure."""

LIGHTS = ((0.8, 0.7, 0.6, 3.6), (-1.0, 0.2, 0.5, 0.7))
"""Directions towards the lights in camera space (x, y, z), and strengths."""


def draw(job: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Draw every view of a job; see the module's docstring."""
    import pyrender
    import trimesh
    from OpenGL import GL
    from pyrender.constants import RenderFlags

    size = int(job["size"])
    renderer = pyrender.OffscreenRenderer(size, size)
    try:
        device = GL.glGetString(GL.GL_RENDERER).decode()
        scene = pyrender.Scene(ambient_light=(0.1,) * 3, bg_color=(1.0,) * 4)
        material = pyrender.MetallicRoughnessMaterial(
            baseColorFactor=(0.7, 0.7, 0.7, 1.0), metallicFactor=0.1, roughnessFactor=0.6
        )
        mesh = trimesh.Trimesh(job["vertices"], job["faces"], process=False)
        shown = scene.add(pyrender.Mesh.from_trimesh(mesh, material=material, smooth=True))
        pictures, covered = [], []
        for view in range(len(job["rotation"])):
            for node in _camera(scene, job, view, size):
                scene.add_node(node)
            colour, _ = renderer.render(scene)
            # Drawn again: pictures have four samples per pixel, none at its centre.
            mask, _ = renderer.render(scene, RenderFlags.SEG, {shown: 255})
            for node in (*scene.camera_nodes, *scene.light_nodes):
                scene.remove_node(node)
            pictures.append(colour[..., :3].mean(axis=2).round().astype(np.uint8))
            covered.append(mask[..., 0] > 127)
    finally:
        renderer.delete()
    shape = (-1, size, size)
    return {
        "pictures": np.array(pictures, np.uint8).reshape(shape),
        "covered": np.array(covered, bool).reshape(shape),
        "device": device,
    }


def _camera(scene: Any, job: Mapping[str, np.ndarray], view: int, size: int) -> list[Any]:
    """Scene nodes of a view: the camera and the lights that move with it."""
    import pyrender

    rotation, translation = job["rotation"][view], job["translation"][view]
    pose = np.eye(4)
    pose[:3, :3] = rotation.T
    pose[:3, 3] = -rotation.T @ translation
    depth = -(job["vertices"] @ rotation[2] + translation[2])
    (focal_x, focal_y), (center_x, center_y) = job["focal"][view], job["center"][view]
    half = size / 2
    near = max(float(job["near"]), 0.9 * float(depth.min()))
    camera = pyrender.IntrinsicsCamera(
        fx=focal_x * half,
        fy=focal_y * half,
        cx=(1 + center_x) * half,
        cy=(1 - center_y) * half,
        znear=near,
        zfar=max(1.1 * float(depth.max()), 2 * near),
    )
    nodes = [pyrender.Node(camera=camera, matrix=pose)]
    for *direction, strength in LIGHTS:
        light = pyrender.DirectionalLight(color=np.ones(3), intensity=strength)
        nodes.append(pyrender.Node(light=light, matrix=pose @ _towards(np.array(direction))))
    return nodes


def _towards(direction: np.ndarray) -> np.ndarray:
    """Pose whose +Z axis is ``direction``; lights shine along their -Z."""
    z = direction / np.linalg.norm(direction)
    x = np.cross((0.0, 1.0, 0.0), z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    return pose


def main() -> None:
    """Read IN, draw, write OUT."""
    source, target = map(Path, sys.argv[1:])
    with np.load(source) as opened:
        job = dict(opened)
    try:
        drawn = draw(job)
    except Exception as error:  # PyOpenGL passes on whatever ctypes and EGL raise
        reason = str(error).strip() or type(error).__name__
        print(f"{type(error).__name__}: {' '.join(reason.split())}", file=sys.stderr)
        sys.exit(UNAVAILABLE)
    np.savez(target, **drawn)


if __name__ == "__main__":
    main()
