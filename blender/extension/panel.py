"""Settings, preferences and the panel."""

import bpy
from bpy.props import (
    BoolProperty,
    EnumProperty,
    FloatProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from . import command, work
from .errors import ExtensionError

LIMITS = command.LIMITS


def _limits(name):
    least, most = LIMITS[name]
    return {"min": least, "max": most}


class StyleexpSettings(bpy.types.PropertyGroup):
    """An object's settings, saved with it."""

    style_from: EnumProperty(
        name="Style",
        items=(
            ("NAME", "Name", "A style that styleexp knows"),
            ("FILE", "File", "A mesh or a picture"),
            ("OBJECT", "Object", "Another object of this scene, with its modifiers"),
        ),
    )
    style_name: StringProperty(
        name="Name",
        description="Name of a style; styleexp-assets list prints all",
        default="scales",
        search=lambda self, context, text: [n for n in command.STYLES if text.lower() in n],
        search_options={"SUGGESTION"},
    )
    style_file: StringProperty(
        name="File",
        description="Mesh (OBJ, PLY, STL, OFF, GLB, glTF) or picture",
        subtype="FILE_PATH",
    )
    style_object: PointerProperty(
        name="Object",
        type=bpy.types.Object,
        poll=lambda self, thing: thing.type == "MESH" and thing != self.id_data,
    )
    strength: FloatProperty(
        name="Strength", description="Height of the relief; negative is inwards", default=1.0,
        **_limits("strength"),
    )  # fmt: skip
    scale: FloatProperty(
        name="Scale", description="Size of the pattern: 0.5 is half as large", default=1.0,
        **_limits("scale"),
    )  # fmt: skip
    direction: EnumProperty(
        name="Direction",
        items=(
            ("auto", "Auto", "What suits the pattern"),
            ("up", "Up", "The pattern's up is the object's Z wherever the surface allows"),
            ("flow", "Flow", "Along the form"),
        ),
    )
    rotation: FloatProperty(
        name="Rotation",
        description="Degrees, counter-clockwise seen from outside",
        **_limits("rotation"),
    )
    mask: StringProperty(
        name="Mask", description="Vertex group whose weights multiply the relief; empty: everywhere"
    )
    falloff: FloatProperty(
        name="Falloff", description="Width of the mask's border, in radii of the object",
        default=0.05, **_limits("falloff"),
    )  # fmt: skip
    invert: BoolProperty(
        name="Invert", description="Bumps become dents; of a picture, dark is high"
    )
    seed: IntProperty(
        name="Seed", description="Another number, another variation", **_limits("seed")
    )
    refine: EnumProperty(
        name="Mesh",
        items=(
            ("auto", "Refine", "Add as many vertices as the relief needs"),
            ("faces", "Refine to", "Refine to about this number of triangles"),
            ("none", "Keep", "Move the mesh's own vertices: its polygons stay"),
        ),
    )
    faces: IntProperty(name="Triangles", default=50_000, min=100, max=4_000_000)
    smooth: BoolProperty(
        name="Shade Smooth",
        description="Of a refined mesh; else the original's shading",
        default=True,
    )
    stack: BoolProperty(
        name="On Top", description="Start from the present result instead of from the original mesh"
    )
    more: StringProperty(
        name="Overrides",
        description="Further KEY=VALUE words of the styleexp command, separated by spaces",
    )

    def settings(self):
        """The settings for the command. Raises `ExtensionError` if there is no style."""
        if self.style_from == "OBJECT":
            style = command.STYLE if self.style_object else ""
        elif self.style_from == "FILE":
            style = bpy.path.abspath(self.style_file)
        else:
            style = self.style_name.strip()
        if not style:
            raise ExtensionError(f"there is no style: choose the {self.style_from.lower()}.")
        return command.Settings(
            style,
            # Single precision, as Blender has it, is not what the artist typed.
            *(float(f"{getattr(self, name):.6g}") for name in ("strength", "scale")),
            self.direction,
            float(f"{self.rotation:.6g}"),
            "attribute:mask" if self.mask else "",
            float(f"{self.falloff:.6g}"),
            self.invert,
            self.seed,
            str(self.faces) if self.refine == "faces" else self.refine,
            self.more,
        )


class StyleexpPreferences(bpy.types.AddonPreferences):
    """Where the command is, and where its runs go."""

    bl_idname = __package__

    executable: StringProperty(
        name="Command",
        description="The styleexp executable, or the folder of the environment it is installed in; "
        "empty: found on PATH",
        subtype="FILE_PATH",
    )
    folder: StringProperty(
        name="Runs",
        description="Folder for the runs; // is beside the .blend file; empty: a temporary one, "
        "which Blender removes when it closes",
        subtype="DIR_PATH",
    )

    def draw(self, context):
        """Draw the preferences."""
        layout = self.layout
        layout.use_property_split = True
        layout.prop(self, "executable")
        layout.operator("preferences.styleexp_check", icon="CHECKMARK")
        layout.prop(self, "folder")


class VIEW3D_PT_styleexp(bpy.types.Panel):
    """The panel in the 3D view's sidebar."""

    bl_label = "styleexp"
    bl_category = "styleexp"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"

    def draw(self, context):
        """Draw the panel."""
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        if work.current is not None:
            told, fraction = work.current.told()
            layout.label(text=work.current.name)
            if fraction is None:
                layout.label(text=told, icon="SORTTIME")
            else:
                layout.progress(factor=fraction, text=told)
            layout.operator("object.styleexp_cancel", icon="CANCEL")
            return
        thing = context.object
        if thing is None or thing.type != "MESH":
            layout.label(text="Select a mesh object", icon="INFO")
            return
        choice = thing.styleexp
        layout.prop(choice, "style_from", expand=True)
        layout.prop(choice, f"style_{choice.style_from.lower()}", text=" ")
        column = layout.column(align=True)
        for name in ("strength", "scale", "direction", "rotation", "seed"):
            column.prop(choice, name)
        layout.prop(choice, "invert")
        layout.prop_search(choice, "mask", thing, "vertex_groups")
        if choice.mask:
            layout.prop(choice, "falloff")
        column = layout.column(align=True)
        column.prop(choice, "refine")
        if choice.refine == "faces":
            column.prop(choice, "faces")
        if choice.refine != "none":
            layout.prop(choice, "smooth")
        if thing.data.styleexp_original is not None:
            layout.prop(choice, "stack")
        layout.prop(choice, "more")
        layout.operator("object.styleexp_stylize", icon="MOD_NOISE")
        layout.operator("object.styleexp_restore", icon="LOOP_BACK")


CLASSES = (StyleexpSettings, StyleexpPreferences, VIEW3D_PT_styleexp)
