"""The picture in docs/blender.md: Suzanne before and after, rendered by Cycles.

    STYLEEXP_COMMAND=.venv/bin/styleexp .venv-bpy/bin/python blender/picture.py out.png

Needs .venv-bpy (`make blender-test`). A second argument is a folder to keep the run in. The one in
the documentation was then cropped to 505 rows, made 960 wide and rounded to 7 bits, for 260 kB.
"""

from __future__ import annotations

import os
import runpy
import shutil
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
os.environ["BLENDER_USER_RESOURCES"] = tempfile.mkdtemp(prefix="styleexp-blender-")
import bpy  # noqa: E402 - reads the variable
from staging import aimed, render  # noqa: E402

NAME = "bl_ext.user_default.styleexp"
STYLE, SCALE, STRENGTH, SEED = "scales", 0.75, 0.8, 0


def installed(folder: str) -> None:
    """Install the extension from its zip; its runs go to ``folder``."""
    archive = runpy.run_path(str(ROOT / "blender" / "build.py"))["build"](Path(tempfile.mkdtemp()))
    bpy.ops.extensions.package_install_files(
        filepath=str(archive), repo="user_default", enable_on_install=True
    )
    preferences = bpy.context.preferences.addons[NAME].preferences
    preferences.executable = os.environ.get("STYLEEXP_COMMAND", "")
    preferences.folder = folder


def suzanne(place: float) -> bpy.types.Object:
    """A smooth Suzanne with a vertex group without the eyes, which are parts of their own.

    She is subdivided first: creases of the coarse form would show under the pattern.
    """
    bpy.ops.mesh.primitive_monkey_add(location=(place, 0, 0), rotation=(0, 0, 0))
    thing = bpy.context.object
    bpy.ops.object.shade_smooth()
    thing.modifiers.new("Subdivision", "SUBSURF").levels = 2
    bpy.ops.object.modifier_apply(modifier="Subdivision")
    owner = list(range(len(thing.data.vertices)))
    for _ in range(len(owner)):
        changed = False
        for edge in thing.data.edges:
            a, b = edge.vertices
            least = min(owner[a], owner[b])
            changed |= owner[a] != owner[b]
            owner[a] = owner[b] = least
        if not changed:
            break
    skin = max(set(owner), key=owner.count)
    group = thing.vertex_groups.new(name="skin")
    group.add([k for k, each in enumerate(owner) if each == skin], 1.0, "REPLACE")
    for name, color, rough in (
        ("skin", (0.055, 0.19, 0.15, 1), 0.38),
        ("eyes", (0.9, 0.55, 0.08, 1), 0.15),
    ):
        material = bpy.data.materials.get(name) or bpy.data.materials.new(name)
        material.use_nodes = True
        surface = material.node_tree.nodes["Principled BSDF"].inputs
        surface["Base Color"].default_value, surface["Roughness"].default_value = color, rough
        thing.data.materials.append(material)
    for polygon in thing.data.polygons:
        polygon.material_index = int(owner[polygon.vertices[0]] != skin)
    return thing


def stage() -> None:
    """A floor, a camera and three lights."""
    scene = bpy.context.scene
    bpy.ops.mesh.primitive_plane_add(size=60, location=(0, 0, -1.0))
    floor = bpy.data.materials.new("floor")
    floor.use_nodes = True
    floor.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (
        0.6,
        0.6,
        0.62,
        1,
    )
    bpy.context.object.data.materials.append(floor)
    bpy.ops.object.camera_add(location=(0.7, -8.6, 1.3))
    scene.camera = bpy.context.object
    scene.camera.data.lens = 57
    aimed(scene.camera, (0.03, 0, -0.03))
    for place, power, size in (
        ((-5, -3.5, 4.5), 620, 1.0),
        ((6, -4, 1.5), 90, 3),
        ((0, 5, 4), 380, 2),
    ):
        bpy.ops.object.light_add(type="AREA", location=place)
        bpy.context.object.data.energy, bpy.context.object.data.size = power, size
        aimed(bpy.context.object, (0, 0, 0))
    scene.world = bpy.data.worlds.new("world")
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.5, 0.55, 0.6, 1)
    scene.world.node_tree.nodes["Background"].inputs["Strength"].default_value = 0.2


def main(target: Path, folder: str) -> None:
    """Stylise and render."""
    installed(folder)
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True, load_ui=False)
    suzanne(-1.45)
    thing = suzanne(1.45)
    choice = thing.styleexp
    choice.style_name, choice.scale, choice.strength, choice.seed = STYLE, SCALE, STRENGTH, SEED
    choice.mask = "skin"
    bpy.ops.object.styleexp_stylize()
    stage()
    render(target, 1200, 560)
    shutil.rmtree(os.environ["BLENDER_USER_RESOURCES"])


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2] if len(sys.argv) > 2 else "")
