"""One run: from an object to the command, and from its result to the object."""

import shutil
import time
from pathlib import Path

import bpy

from . import command, exchange, surface
from .errors import ExtensionError

current = None
"""The `Work` that is under way, if any."""


class Work:
    """A running command and the object that waits for it.

    The object is found again by name when the command has ended: in the meantime the artist may
    have undone something, after which Blender's references are no longer valid.
    """

    def __init__(self, context, thing):
        choice = thing.styleexp
        preferences = context.preferences.addons[__package__].preferences
        self.name = thing.name
        self.begun = time.monotonic()
        self.smooth = choice.smooth
        _check(thing)
        again = thing.data.styleexp_original
        self.original = (again if again and not choice.stack else thing.data).name
        settings = choice.settings()
        executable = command.executable(bpy.path.abspath(preferences.executable))
        words = command.words(executable, settings)  # before anything is written
        self.mask = choice.mask
        self.source = self._read(thing)
        self.folder = _folder(preferences.folder, thing.name)
        try:
            surface.write_source(self.folder / command.SOURCE, self.source)
            if choice.style_from == "OBJECT":
                exchange.write_shape(choice.style_object, self.folder / command.STYLE)
            self.process = command.Process(words, self.folder)
        except (OSError, ExtensionError) as error:
            shutil.rmtree(self.folder, ignore_errors=True)
            if isinstance(error, OSError):
                raise ExtensionError(
                    f"'{self.folder}' can't be written: {error.strerror}."
                ) from None
            raise

    def _read(self, thing):
        """The surface that the run starts from: the original's, or the present one."""
        shown = thing.data
        original = bpy.data.meshes.get(self.original)
        if original is None or original == shown:
            return exchange.source_of(thing, self.mask)
        # Vertex groups belong to the mesh.
        thing.data = original
        try:
            if self.mask and self.mask not in thing.vertex_groups:
                raise ExtensionError(
                    f"the original mesh of '{self.name}' has no vertex group '{self.mask}': "
                    "restore the original, and make the group there."
                )
            return exchange.source_of(thing, self.mask)
        finally:
            thing.data = shown

    def told(self):
        """What the command does, for the panel: a text, and a fraction or None."""
        now = command.progress(self.process.lines)
        stage = "stopping" if self.process.stopped else now.stage
        return f"{stage} ({time.monotonic() - self.begun:.0f} s)", now.fraction

    def ended(self):
        """Whether the command has ended."""
        return self.process.poll() is not None

    def finish(self):
        """Put the result on the object; return notes for the artist, or None if it was stopped.

        Raises `ExtensionError`, with the scene as it was.
        """
        if self.process.stopped:
            shutil.rmtree(self.folder, ignore_errors=True)
            return None
        if self.process.poll() != 0:
            raise ExtensionError(command.failure(self.process.lines, self.process.log))
        thing, original = bpy.data.objects.get(self.name), bpy.data.meshes.get(self.original)
        if thing is None or thing.type != "MESH" or original is None:
            raise ExtensionError(f"'{self.name}' is gone: its result is in '{self.folder}'.")
        _check(thing)
        if not self.source.same(self._read(thing)):
            raise ExtensionError(f"'{self.name}' was changed while styleexp ran: run again.")
        found = surface.result(self.folder / command.RUN / "result.ply", self.source)
        first = original.styleexp_original or original
        shown = thing.data
        try:
            thing.data = original  # whose vertex groups the result gets
            told = exchange.apply(thing, first, self.source, found, self.smooth)
        except Exception:
            thing.data = shown
            raise
        if shown not in (original, first) and shown.users == 0:
            bpy.data.meshes.remove(shown)
        return [*command.notes(self.process.lines), *told]


def begin(context, thing):
    """Start a run for an object. Raises `ExtensionError`, with the scene as it was."""
    global current
    current = Work(context, thing)
    return current


def over():
    """Forget the run; end its command if it still lives."""
    global current
    if current is not None:
        current.process.end()
    current = None


def _check(thing):
    """Raise `ExtensionError` for an object whose mesh can't be replaced."""
    for block in (thing, thing.data):
        if block.library is not None or block.override_library is not None:
            raise ExtensionError(
                f"'{block.name}' is linked from another file: make it local first "
                "(Object > Relations > Make Local)."
            )
    if any(each.type == "MULTIRES" and each.total_levels for each in thing.modifiers):
        raise ExtensionError(
            f"'{thing.name}' has sculpted detail in a Multiresolution modifier, which would no "
            "longer fit: apply the modifier first."
        )


def _folder(given, name):
    """A new folder for a run."""
    if not given or (given.startswith("//") and not bpy.data.filepath):
        base = Path(bpy.app.tempdir) / "styleexp"
    else:
        base = Path(bpy.path.abspath(given))
    kept = "".join(letter if letter.isalnum() else "_" for letter in name)
    stem = f"{kept}-{time.strftime('%Y-%m-%d_%H-%M-%S')}"
    for number in range(1, 1000):
        folder = base / (stem if number == 1 else f"{stem}-{number}")
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise ExtensionError(
                f"the runs' folder '{base}' can't be written ({error.strerror}): choose another in "
                "the extension's preferences."
            ) from None
        return folder
    raise ExtensionError(f"'{base}' is full of runs: remove some.")
