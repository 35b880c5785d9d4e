"""What the scripts that draw the documentation's pictures in Blender share."""

from __future__ import annotations

import os
from pathlib import Path

import bpy
from mathutils import Vector


def aimed(thing: bpy.types.Object, at: tuple[float, float, float]) -> None:
    """Turn a camera or a light towards a point."""
    thing.rotation_euler = (Vector(at) - thing.location).to_track_quat("-Z", "Y").to_euler()


def render(target: Path, width: int, height: int) -> None:
    """Render the scene with Cycles on one core; the variables ``SAMPLES`` and ``PERCENT`` make a
    quick look of it."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.samples = "CPU", int(os.environ.get("SAMPLES", "32"))
    scene.cycles.use_denoising = True
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    scene.render.resolution_x, scene.render.resolution_y = width, height
    scene.render.resolution_percentage = int(os.environ.get("PERCENT", "100"))
    scene.render.image_settings.compression = 100
    scene.view_settings.view_transform = "AgX"
    scene.render.filepath = str(target.resolve())
    bpy.ops.render.render(write_still=True)
