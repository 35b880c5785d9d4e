"""The extension in Blender, without a window: `make blender-test`, which installs bpy.

bpy is Blender as a Python module, 374 MB and GPL: it is in an environment of its own, and what the
extension runs is the `styleexp` command of another (STYLEEXP_COMMAND).
"""

import importlib.util
import os
import runpy
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import pytest

if importlib.util.find_spec("bpy") is None:
    pytest.skip("Blender's module bpy is not installed: make blender-test", allow_module_level=True)

# Before bpy is imported: no preferences and extensions but the test's own.
os.environ["BLENDER_USER_RESOURCES"] = tempfile.mkdtemp(prefix="styleexp-blender-")
import bpy
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
COMMAND = os.environ.get("STYLEEXP_COMMAND") or shutil.which("styleexp")
NAME = "bl_ext.user_default.styleexp"
# The command's own styles with fewer vertices: nobody looks at these results.
os.environ["PYTHONPATH"] = str(ROOT / "tests" / "helpers" / "coarse")


@pytest.fixture(scope="session", autouse=True)
def extension(tmp_path_factory):
    """The zip, built and installed as an artist installs it."""
    archive = runpy.run_path(str(ROOT / "blender" / "build.py"))["build"](
        tmp_path_factory.mktemp("zip")
    )
    done = bpy.ops.extensions.package_install_files(
        filepath=str(archive), repo="user_default", enable_on_install=True
    )
    assert done == {"FINISHED"}
    assert NAME in bpy.context.preferences.addons
    yield
    bpy.ops.preferences.addon_disable(module=NAME)
    assert not hasattr(bpy.types.Object, "styleexp")
    shutil.rmtree(os.environ["BLENDER_USER_RESOURCES"])


@pytest.fixture(autouse=True)
def preferences(tmp_path):
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True, load_ui=False)
    found = bpy.context.preferences.addons[NAME].preferences
    found.executable, found.folder = str(COMMAND), str(tmp_path / "runs")
    return found


def column(collection, name, width=1):
    values = np.empty(len(collection) * width, np.float32)
    collection.foreach_get(name, values)
    return values.reshape(len(collection), -1)


def points(thing):
    return column(thing.data.vertices, "co", 3)


@pytest.fixture
def suzanne():
    """Suzanne with everything that an object can have, and that must not be lost."""
    bpy.ops.object.empty_add(location=(0, 0, 1))
    parent = bpy.context.object
    bpy.ops.mesh.primitive_monkey_add()
    thing = bpy.context.object
    mesh = thing.data
    assert len(mesh.vertices) == 507
    assert len(mesh.polygons) == 500
    thing.name = "Suzanne's head"
    thing.parent = parent
    thing.location, thing.rotation_euler, thing.scale = (1, 2, 3), (0.1, 0.2, 0.3), (1, 1, 1.5)
    for name in ("skin", "eyes"):
        mesh.materials.append(bpy.data.materials.new(name))
    mesh.polygons.foreach_set("material_index", np.arange(500, dtype=np.int32) % 2)
    mesh.polygons.foreach_set("use_smooth", np.arange(500) < 250)
    for edge in mesh.edges[:100]:
        edge.use_seam = edge.use_edge_sharp = True
    thing.modifiers.new("Subdivision", "SUBSURF").levels = 1
    upper, one = thing.vertex_groups.new(name="upper"), thing.vertex_groups.new(name="one")
    for vertex in mesh.vertices:
        if vertex.co.z > 0.2:
            upper.add([vertex.index], 1.0, "REPLACE")
    one.add([7], 0.25, "REPLACE")
    uv = mesh.uv_layers.new(name="second", do_init=True)
    uv.uv.foreach_set("vector", column(uv.uv, "vector", 2).ravel() * 0.5)
    paint = mesh.color_attributes.new("paint", "BYTE_COLOR", "CORNER")
    paint.data.foreach_set("color_srgb", np.tile([1, 0, 0, 1], len(mesh.loops)).astype(np.float32))
    mesh["mine"] = "kept"
    thing.shape_key_add(name="Basis")
    wide = thing.shape_key_add(name="wide")
    wide.data.foreach_set("co", (column(wide.data, "co", 3) * [2, 1, 1]).ravel().astype(np.float32))
    wide.value = 0.0
    thing.styleexp.style_name = "bubble"
    thing.styleexp.seed = 3
    return thing


def seams(thing):
    """Their length together."""
    ends = [tuple(each.vertices) for each in thing.data.edges if each.use_seam]
    a, b = points(thing)[np.array(ends)].transpose(1, 0, 2)
    return np.linalg.norm(a - b, axis=1).sum()


def stylize():
    return bpy.ops.object.styleexp_stylize("EXEC_DEFAULT", True)  # with a step to undo


def uncovered(thing):
    """What belongs to the object itself, not to its shape."""
    return {
        "name": thing.name,
        "parent": thing.parent.name,
        "matrix": [tuple(row) for row in thing.matrix_basis],
        "modifiers": [(each.name, each.type, each.levels) for each in thing.modifiers],
        "materials": [each.material.name for each in thing.material_slots],
        "groups": [each.name for each in thing.vertex_groups],
        "uv": [each.name for each in thing.data.uv_layers],
        "active uv": thing.data.uv_layers.active.name,
        "keys": [each.name for each in thing.data.shape_keys.key_blocks],
        "mine": thing.data["mine"],
    }


def members(thing, name):
    index = thing.vertex_groups[name].index
    return {
        vertex.index: each.weight
        for vertex in thing.data.vertices
        for each in vertex.groups
        if each.group == index
    }


def test_refined_result_is_the_same_object_and_undo_brings_the_mesh_back(suzanne):
    thing, name = suzanne, suzanne.name
    thing.styleexp.refine, thing.styleexp.faces = "faces", 8000
    before, own, old = uncovered(thing), points(thing), thing.data.name
    ratio, length = np.mean(column(thing.data.polygons, "material_index")), seams(thing)
    bpy.ops.ed.undo_push(message="the head")
    assert stylize() == {"FINISHED"}

    mesh = thing.data
    assert uncovered(thing) == before
    assert mesh.name != old
    assert 6000 < len(mesh.polygons) < 11000
    assert not mesh.validate()
    first, height = points(thing), column(mesh.attributes["displacement"].data, "value")
    assert np.isfinite(height).all()
    assert np.ptp(height) > 0.01
    np.testing.assert_allclose(first.min(0), own.min(0), atol=0.25)
    assert abs(np.mean(column(mesh.polygons, "material_index")) - ratio) < 0.25
    assert column(mesh.polygons, "use_smooth").all()
    # Texture coordinates: all there, and the second still half of the first.
    uv, second = (column(mesh.uv_layers[each].uv, "vector", 2) for each in ("UVMap", "second"))
    assert np.ptp(uv, axis=0).min() > 0.5
    np.testing.assert_allclose(second, uv * 0.5, atol=1e-6)
    paint = column(mesh.color_attributes["paint"].data, "color_srgb", 4)
    np.testing.assert_allclose(paint, np.tile([1, 0, 0, 1], (len(paint), 1)), atol=1e-3)
    assert sum(each.use_seam for each in mesh.edges) > 100  # in pieces, together as long
    assert seams(thing) == pytest.approx(length, rel=0.3)
    assert [each.use_seam for each in mesh.edges] == [each.use_edge_sharp for each in mesh.edges]
    # A group's weights between its members; a key moves twice as wide.
    upper = members(thing, "upper")
    assert len(upper) > 500
    assert first[list(upper), 2].min() > -0.1
    assert max(members(thing, "one").values()) == 0.25
    wide = mesh.shape_keys.key_blocks["wide"]
    moved = column(wide.data, "co", 3) - first
    assert np.abs(moved[:, 1:]).max() < 1e-6
    assert np.abs(moved[:, 0]).max() == pytest.approx(np.abs(own[:, 0]).max(), abs=0.02)

    assert thing.data.styleexp_original.name == old
    assert bpy.data.meshes[old].use_fake_user
    # Undo, and it is as before; Blender's references are new ones.
    assert bpy.ops.ed.undo() == {"FINISHED"}
    thing = bpy.data.objects[name]
    assert thing.data.name == old
    np.testing.assert_array_equal(points(thing), own)
    assert uncovered(thing) == before
    assert bpy.ops.ed.redo() == {"FINISHED"}
    thing = bpy.data.objects[name]
    np.testing.assert_array_equal(points(thing), first)

    # Again, from the original: the same bits. And the artist's own mesh back.
    bpy.context.view_layer.objects.active = thing
    assert stylize() == {"FINISHED"}
    np.testing.assert_array_equal(points(thing), first)
    assert len(bpy.data.meshes) == 2
    assert uncovered(thing) == before
    assert bpy.ops.object.styleexp_restore() == {"FINISHED"}
    assert thing.data.name == old
    assert not thing.data.use_fake_user
    np.testing.assert_array_equal(points(thing), own)
    assert uncovered(thing) == before
    assert [each.name for each in bpy.data.meshes] == [old]
    assert not bpy.ops.object.styleexp_restore.poll()


def test_unrefined_result_keeps_the_polygons_and_unmasked_vertices(suzanne, tmp_path):
    thing, choice = suzanne, suzanne.styleexp
    choice.refine, choice.mask, choice.falloff = "none", "upper", 0.0
    choice.style_from, choice.style_file = "FILE", str(tmp_path / "bumps.ply")
    bumps(tmp_path / "bumps.ply")
    before, own, old = uncovered(thing), points(thing), thing.data
    polygons = [tuple(each.vertices) for each in old.polygons]
    groups = members(thing, "upper"), members(thing, "one")
    uv = column(old.uv_layers["UVMap"].uv, "vector", 2)
    assert stylize() == {"FINISHED"}

    assert uncovered(thing) == before
    assert [tuple(each.vertices) for each in thing.data.polygons] == polygons
    assert (members(thing, "upper"), members(thing, "one")) == groups
    np.testing.assert_array_equal(column(thing.data.uv_layers["UVMap"].uv, "vector", 2), uv)
    now = points(thing)
    outside = np.setdiff1d(np.arange(507), list(groups[0]))
    np.testing.assert_array_equal(now[outside], own[outside])
    assert np.abs(now - own).max() > 0.005
    height = column(thing.data.attributes["displacement"].data, "value")
    assert (height[outside] == 0).all()
    assert np.abs(height).max() > 0.005
    keys = thing.data.shape_keys.key_blocks
    step = column(keys["wide"].data, "co", 3) - column(keys["Basis"].data, "co", 3)
    np.testing.assert_allclose(step, own * [1, 0, 0], atol=1e-6)
    np.testing.assert_array_equal(column(keys["Basis"].data, "co", 3), now)

    # On top of it, with another object as the style.
    bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=4)
    ball = bpy.context.object
    spread = np.random.default_rng(0).normal(1, 0.05, (len(ball.data.vertices), 1))
    ball.data.vertices.foreach_set("co", (points(ball) * spread).ravel().astype(np.float32))
    bpy.context.view_layer.objects.active = thing
    choice.style_from, choice.style_object, choice.stack, choice.mask = "OBJECT", ball, True, ""
    assert stylize() == {"FINISHED"}
    assert thing.data.styleexp_original == old
    assert not np.array_equal(points(thing), now)
    assert uncovered(thing) == before
    assert bpy.ops.object.styleexp_restore() == {"FINISHED"}
    np.testing.assert_array_equal(points(thing), own)


def bumps(path):
    """A style file of ours: a bumpy sphere."""
    surface = sys.modules[f"{NAME}.surface"]
    bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=5)
    ball = bpy.context.object
    at = points(ball).astype(np.float64)
    at *= 1 + 0.06 * (np.sin(12 * at[:, :1]) * np.sin(12 * at[:, 1:2]) * np.sin(12 * at[:, 2:]))
    faces = np.array([tuple(each.vertices) for each in ball.data.polygons])
    surface.write_ply(path, dict(zip("xyz", at.T, strict=True)), faces)
    mesh = ball.data
    bpy.data.objects.remove(ball)
    bpy.data.meshes.remove(mesh)
    bpy.context.view_layer.objects.active = bpy.data.objects["Suzanne's head"]


def untouched(thing, act):
    """What ``act`` raises or returns; checks that the scene is as it was."""
    before = (
        uncovered(thing),
        points(thing).tobytes(),
        sorted(each.name for each in bpy.data.meshes),
    )
    try:
        found = act()
    except RuntimeError as error:
        found = str(error).strip()
    after = uncovered(thing), points(thing).tobytes(), sorted(each.name for each in bpy.data.meshes)
    assert after == before
    assert sys.modules[f"{NAME}.work"].current is None
    return found


def test_mistakes_get_one_sentence_and_change_nothing(suzanne, preferences, tmp_path):
    choice = suzanne.styleexp
    told = {}

    def tried(name, **settings):
        for key, value in settings.items():
            setattr(choice, key, value)
        told[name] = untouched(suzanne, stylize)
        for key in settings:
            choice.property_unset(key)

    tried("style", style_name="bubbel")
    tried("file", style_from="FILE", style_file=str(tmp_path / "none.obj"))
    tried("none", style_from="OBJECT")
    tried("mask", mask="nothing")
    tried("words", more="hydra.run.dir=/tmp")
    tried("key", more="style.scal=2")
    preferences.executable = str(tmp_path / "nowhere")
    tried("command")
    assert all(each.startswith("Error: ") and "\n" not in each for each in told.values()), told
    assert "unknown style 'bubbel': did you mean 'bubble'" in told["style"]
    assert "none.obj' does not exist" in told["file"]
    assert "there is no style: choose the object" in told["none"]
    assert "has no vertex group 'nothing'" in told["mask"]
    assert "'hydra.run.dir=/tmp' can't be given here" in told["words"]
    assert "style.scal" in told["key"]
    assert "the command styleexp is not at" in told["command"]


def test_cancel_leaves_the_scene_as_it_was(suzanne, tmp_path):
    work = sys.modules[f"{NAME}.work"]
    begun = time.monotonic()

    def stop():
        while work.current is None or not work.current.process.lines:
            time.sleep(0.05)
        work.current.process.stop()

    suzanne.styleexp.refine, suzanne.styleexp.faces = "faces", 400_000
    thread = threading.Thread(target=stop)
    thread.start()
    assert untouched(suzanne, stylize) == {"CANCELLED"}
    thread.join()
    assert time.monotonic() - begun < 30
    assert list((tmp_path / "runs").iterdir()) == []


class Shown:
    """Takes the place of a layout, a window or an operator, and notes what it is asked for."""

    def __init__(self, **given):
        self.told = []
        self.__dict__ |= given

    def prop(self, owner, name, **more):
        assert name in owner.bl_rna.properties
        self.told.append(name)

    def prop_search(self, owner, name, data, collection, **more):
        assert hasattr(data, collection)
        self.prop(owner, name)

    def operator(self, name, **more):
        group, _, word = name.partition(".")
        assert word in dir(getattr(bpy.ops, group))
        self.told.append(name)

    def label(self, text="", **more):
        self.told.append(text)

    progress = label

    def column(self, **more):
        return self

    def report(self, kinds, text):
        self.told.append((*kinds, text))

    def status_text_set(self, text):
        self.told.append(text)

    def event_timer_remove(self, timer):
        self.told.append(timer)


def drawn(thing):
    panel, layout = sys.modules[f"{NAME}.panel"], Shown()
    panel.VIEW3D_PT_styleexp.draw(Shown(layout=layout), Shown(object=thing))
    return layout.told


def test_with_a_window_blender_stays_usable(suzanne, preferences, tmp_path):
    """What Blender would call: there is no window here, so the events are made up."""
    work, operators = (sys.modules[f"{NAME}.{each}"] for each in ("work", "operators"))
    kind = operators.OBJECT_OT_styleexp_stylize
    thing, choice = suzanne, suzanne.styleexp
    assert {"style_name", "mask", "object.styleexp_stylize"} <= set(drawn(thing))
    assert drawn(None) == ["Select a mesh object"]
    layout = Shown()
    sys.modules[f"{NAME}.panel"].StyleexpPreferences.draw(
        Shown(layout=layout, executable="", folder="", bl_rna=preferences.bl_rna), None
    )
    assert layout.told == ["executable", "preferences.styleexp_check", "folder"]

    context = Shown(workspace=Shown(), window_manager=Shown(windows=[]))

    def begun():
        work.begin(bpy.context, thing)
        assert not bpy.ops.object.styleexp_stylize.poll()
        self = Shown(_timer="timer")
        self._finish, self._clear = (
            lambda at: kind._finish(self, at),
            lambda at: kind._clear(self, at),
        )
        return self

    def event(self, name="TIMER", value="NOTHING"):
        return kind.modal(self, context, Shown(type=name, value=value))

    def until(self, ends):
        deadline = time.monotonic() + 200
        while (now := event(self)) == {"PASS_THROUGH"} and not ends():
            assert time.monotonic() < deadline
            time.sleep(0.1)
        return now

    choice.refine = "none"
    self = begun()
    assert event(self, "MOUSEMOVE") == {"PASS_THROUGH"}
    assert drawn(thing)[0] == thing.name
    assert drawn(thing)[-1] == "object.styleexp_cancel"
    # The result waits for the end of an edit mode.
    own = points(thing)
    bpy.ops.object.mode_set(mode="EDIT")
    assert until(self, lambda: work.current.ended() and event(self)) == {"PASS_THROUGH"}
    assert "leave the mode" in context.workspace.told[-1]
    bpy.ops.object.mode_set(mode="OBJECT")
    np.testing.assert_array_equal(points(thing), own)
    assert event(self) == {"FINISHED"}
    assert not np.array_equal(points(thing), own)
    assert context.workspace.told[-1] is None
    assert context.window_manager.told == ["timer"]
    assert "stack" in drawn(thing)
    thing.vertex_groups.new(name="late")
    choice.mask = "late"
    now = points(thing)
    with pytest.raises(
        RuntimeError, match=r"original mesh of .* has no vertex group 'late': restore"
    ):
        stylize()
    np.testing.assert_array_equal(points(thing), now)
    choice.mask = ""
    assert bpy.ops.object.styleexp_restore() == {"FINISHED"}

    # Esc; a mistake; a mesh that was changed meanwhile, one that was removed.
    self = begun()
    assert event(self, "ESC", "PRESS") == {"RUNNING_MODAL"}
    assert until(self, lambda: False) == {"CANCELLED"}
    assert self.told == [("INFO", "styleexp was stopped")]
    choice.style_name = "bubbel"
    self = begun()
    assert until(self, lambda: False) == {"CANCELLED"}
    assert self.told[0][0] == "ERROR"
    assert "unknown style 'bubbel'" in self.told[0][1]
    np.testing.assert_array_equal(points(thing), own)
    assert list(bpy.data.meshes) == [thing.data]
    for change, told in (("move", "was changed while styleexp ran"), ("remove", "is gone")):
        self = begun()
        work.current.process.end()
        work.current.process = Shown(poll=lambda: 0, stopped=False, lines=[], end=lambda: None)
        if change == "move":
            thing.data.shape_keys.reference_key.data[0].co.x += 1
        else:
            bpy.data.objects.remove(thing)
        assert event(self) == {"CANCELLED"}
        assert told in self.told[0][1]


def test_blenders_own_tool_finds_the_zip_valid(tmp_path):
    archive = runpy.run_path(str(ROOT / "blender" / "build.py"))["build"](tmp_path)
    tool = Path(bpy.utils.system_resource("SCRIPTS")) / "addons_core/bl_pkg/cli/blender_ext.py"
    done = subprocess.run(
        [sys.executable, tool, "validate", archive], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_check_tells_where_the_command_is(preferences, tmp_path):
    assert bpy.ops.preferences.styleexp_check() == {"FINISHED"}
    preferences.executable = str(tmp_path / "nowhere")
    with pytest.raises(RuntimeError, match="install it"):
        bpy.ops.preferences.styleexp_check()
