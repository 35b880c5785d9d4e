"""The picture in the README: a low-poly mesh, the result, and the low-poly mesh with its maps,
rendered by Cycles.

    styleexp critter_low scales hydra.run.dir=outputs/low
    styleexp-bake outputs/low
    .venv-bpy/bin/python blender/low_poly.py MESH.glb outputs/low out.png

MESH.glb is the source's file (`styleexp-assets where critter_low`). Needs .venv-bpy
(`make blender-test`). The one in the documentation was then cropped by 20 rows and stored as WebP.
"""

from __future__ import annotations

import sys
from pathlib import Path

import bpy
from mathutils import Vector
from staging import aimed, render

APART = 0.92
"""Distance between two of them, in heights."""


def brought_in(path: Path, place: float, wires: bool) -> None:
    """Import a GLB at a place along x, 1 high, turned a little; ``wires`` shows its edges."""
    before = set(bpy.data.objects)
    bpy.ops.import_scene.gltf(filepath=str(path))
    for thing in [each for each in bpy.data.objects if each not in before and each.type == "MESH"]:
        corners = [thing.matrix_world @ Vector(each) for each in thing.bound_box]
        low, high = min(each.z for each in corners), max(each.z for each in corners)
        thing.scale = [1 / (high - low)] * 3
        thing.rotation_mode = "XYZ"
        thing.rotation_euler = (thing.rotation_euler.x, 0, 0.62)
        thing.location = (place, 0, -low / (high - low))
        if wires:
            # The edges as thin tubes, a little above the surface.
            copy = thing.copy()
            copy.data = thing.data.copy()
            bpy.context.collection.objects.link(copy)
            copy.data.materials.clear()
            copy.data.materials.append(plain("edges", (0.03, 0.03, 0.03, 1)))
            frame = copy.modifiers.new("Wireframe", "WIREFRAME")
            frame.thickness, frame.offset = 0.006, 0.5


def plain(name: str, color: tuple[float, float, float, float]) -> bpy.types.Material:
    """A rough material of one colour."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    surface = material.node_tree.nodes["Principled BSDF"].inputs
    surface["Base Color"].default_value, surface["Roughness"].default_value = color, 0.9
    return material


def stage() -> None:
    """A floor, a camera and three lights."""
    scene = bpy.context.scene
    bpy.ops.mesh.primitive_plane_add(size=80, location=(0, 0, 0))
    bpy.context.object.data.materials.append(plain("floor", (0.72, 0.72, 0.72, 1)))
    bpy.ops.object.camera_add(location=(0, -9.6, 1.3))
    scene.camera = bpy.context.object
    scene.camera.data.lens = 108
    aimed(scene.camera, (0, 0, 0.5))
    for place, power, size in (
        ((-6, -2.0, 3.4), 560, 0.7),
        ((5, -4, 2.0), 40, 3),
        ((0, 5, 4), 260, 2),
    ):
        bpy.ops.object.light_add(type="AREA", location=place)
        bpy.context.object.data.energy, bpy.context.object.data.size = power, size
        aimed(bpy.context.object, (0, 0, 0.4))
    scene.world = bpy.data.worlds.new("world")
    scene.world.use_nodes = True
    background = scene.world.node_tree.nodes["Background"].inputs
    background["Color"].default_value = (0.8, 0.85, 0.9, 1)
    background["Strength"].default_value = 0.5


def main(mesh: Path, run: Path, target: Path) -> None:
    """Import and render."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True, load_ui=False)
    brought_in(mesh, -APART, True)
    brought_in(run / "result.glb", 0, False)
    brought_in(run / "bake" / "result_low.glb", APART, False)
    stage()
    render(target, 1440, 520)


if __name__ == "__main__":
    main(*(Path(each) for each in sys.argv[1:4]))
