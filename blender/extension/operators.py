"""The operators: stylise, cancel, restore, check."""

import time

import bpy

from . import command, exchange, work
from .errors import ExtensionError

EVERY = 0.25
"""Seconds between looks at the command."""


class OBJECT_OT_styleexp_stylize(bpy.types.Operator):
    """Put the style's local geometry onto the active object. Esc stops"""

    bl_idname = "object.styleexp_stylize"
    bl_label = "Stylize"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        """Only for a mesh in object mode, and for one at a time."""
        thing = context.object
        if thing is None or thing.type != "MESH" or thing.mode != "OBJECT":
            cls.poll_message_set("Select a mesh in Object Mode")
            return False
        if work.current is not None:
            cls.poll_message_set("styleexp is running")
            return False
        return True

    def execute(self, context):
        """Start; without a window, wait for the end."""
        try:
            work.begin(context, context.object)
        except ExtensionError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if bpy.app.background:
            try:
                while not work.current.ended():
                    time.sleep(EVERY / 5)
                return self._finish(context)
            finally:
                work.over()
        manager = context.window_manager
        self._timer = manager.event_timer_add(EVERY, window=context.window)
        manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        """Look at the command now and then; everything else is the artist's."""
        if work.current is None:  # the extension was disabled
            self._clear(context)
            return {"CANCELLED"}
        if event.type == "ESC" and event.value == "PRESS" and not work.current.process.stopped:
            work.current.process.stop()
            return {"RUNNING_MODAL"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        now = work.current
        ended = now.ended()
        thing = bpy.data.objects.get(now.name)
        waits = ended and thing is not None and thing.mode != "OBJECT"
        told = "leave the mode to see the result" if waits else now.told()[0]
        context.workspace.status_text_set(f"styleexp: {told}. Esc stops")
        for window in context.window_manager.windows:
            for area in window.screen.areas:
                if area.type == "VIEW_3D":
                    area.tag_redraw()
        if not ended or (waits and not now.process.stopped):
            return {"PASS_THROUGH"}
        try:
            return self._finish(context)
        finally:
            self._clear(context)

    def cancel(self, context):
        """Blender closes the window or the file."""
        self._clear(context)

    def _finish(self, context):
        try:
            notes = work.current.finish()
        except ExtensionError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if notes is None:
            self.report({"INFO"}, "styleexp was stopped")
            return {"CANCELLED"}
        for note in notes:
            self.report({"INFO"}, note)
        return {"FINISHED"}

    def _clear(self, context):
        context.window_manager.event_timer_remove(self._timer)
        if context.workspace is not None:
            context.workspace.status_text_set(None)
        work.over()


class OBJECT_OT_styleexp_cancel(bpy.types.Operator):
    """Stop styleexp; the object stays as it is"""

    bl_idname = "object.styleexp_cancel"
    bl_label = "Cancel"

    @classmethod
    def poll(cls, context):
        """Only while it runs."""
        return work.current is not None

    def execute(self, context):
        """Ask the command to stop."""
        work.current.process.stop()
        return {"FINISHED"}


class OBJECT_OT_styleexp_restore(bpy.types.Operator):
    """Give the active object the mesh it had before styleexp"""

    bl_idname = "object.styleexp_restore"
    bl_label = "Restore Original"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        """Only for a result."""
        thing = context.object
        result = thing is not None and thing.type == "MESH" and thing.mode == "OBJECT"
        return result and thing.data.styleexp_original is not None and work.current is None

    def execute(self, context):
        """Restore the original mesh."""
        exchange.restore(context.object)
        return {"FINISHED"}


class PREFERENCES_OT_styleexp_check(bpy.types.Operator):
    """Look whether the styleexp command is there and new enough"""

    bl_idname = "preferences.styleexp_check"
    bl_label = "Check"

    def execute(self, context):
        """Report the command's path, or what is wrong."""
        given = context.preferences.addons[__package__].preferences.executable
        try:
            found = command.executable(bpy.path.abspath(given))
        except ExtensionError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"found '{found}'")
        return {"FINISHED"}


CLASSES = (
    OBJECT_OT_styleexp_stylize,
    OBJECT_OT_styleexp_cancel,
    OBJECT_OT_styleexp_restore,
    PREFERENCES_OT_styleexp_check,
)
