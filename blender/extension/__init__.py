"""styleexp for Blender: put the local geometry of a mesh or a picture onto the active object.

The `styleexp` command does the work, in a process of its own; here are its settings, and what
makes the result the same object again.
"""

import bpy

from . import operators, panel, work

CLASSES = (*panel.CLASSES, *operators.CLASSES)


def register():
    """Add everything to Blender."""
    for each in CLASSES:
        bpy.utils.register_class(each)
    bpy.types.Object.styleexp = bpy.props.PointerProperty(type=panel.StyleexpSettings)
    bpy.types.Mesh.styleexp_original = bpy.props.PointerProperty(type=bpy.types.Mesh)
    bpy.types.Mesh.styleexp_kept = bpy.props.BoolProperty()


def unregister():
    """Remove it again, and end what runs."""
    work.over()
    del bpy.types.Mesh.styleexp_kept
    del bpy.types.Mesh.styleexp_original
    del bpy.types.Object.styleexp
    for each in reversed(CLASSES):
        bpy.utils.unregister_class(each)
