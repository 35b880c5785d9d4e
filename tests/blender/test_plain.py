"""What of the Blender extension needs no Blender."""

import stat
import sys
import time
import tomllib
import zipfile

import numpy as np
import pytest

import styleexp
from styleexp.cli.studio import settings as studio
from styleexp.inputs import meshes, shapes
from tests.helpers import ROOT, extension

command, surface = extension.load("command"), extension.load("surface")
Fault = extension.load("errors").ExtensionError


# ------------------------------------------------------------------------------------- the command


def test_settings_are_those_of_the_studio():
    given = {"strength": 0.5, "scale": 2.0, "direction": "up", "rotation": -30.0, "falloff": 0.1,
             "mask": "attribute:mask", "invert": True, "seed": 7}  # fmt: skip
    for some in ({}, given, {"falloff": 0.1}):
        ours = command.overrides(command.Settings("scales", **some))
        assert ours == studio.Settings(style="scales").changed(some).overrides
    assert set(command.DIRECTIONS) <= set(studio.DIRECTIONS)
    assert all(studio.LIMITS[name] == limits for name, limits in command.LIMITS.items())
    assert set(command.STYLES) <= set(shapes.STYLES)


def test_words_leave_the_artists_overrides_the_last_say():
    given = command.Settings("/my styles/a=b.jpg", refine="none", more="report=true 'field.x=a b'")
    words = command.words("styleexp", given)
    assert words[:3] == ["styleexp", "source.ply", "/my styles/a=b.jpg"]
    assert "report=false" not in words
    assert words[-4:] == ["source.refine=none", "report=true", "field.x=a b", "hydra.run.dir=run"]
    own = command.words("styleexp", command.Settings("scales", more="source.refine=9000"))
    assert [each for each in own if "refine" in each] == ["source.refine=9000"]
    with pytest.raises(Fault, match="'--help' is not a style"):
        command.words("styleexp", command.Settings("--help"))


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("optim.seed", "'optim.seed' is not an override"),
        ("--help", "'--help' is not an override"),
        ("hydra.run.dir=/tmp", "sets hydra.run.dir itself"),
        ("style=bubble", "sets style itself"),
        ("a='b", "a quote without its partner"),
    ],
)
def test_overrides_that_cannot_be(text, told):
    with pytest.raises(Fault, match=told):
        command.overrides(command.Settings("scales", more=text))


def script(path, text):
    path.write_text(f"#!{sys.executable}\n{text}\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


def test_finding_the_command(tmp_path, monkeypatch):
    (tmp_path / "bin").mkdir()
    new = script(tmp_path / "bin" / "styleexp", "print('styleexp 0.1.0')")
    assert command.executable(str(new)) == str(new)
    assert command.executable(str(tmp_path)) == str(new)  # the environment's folder
    monkeypatch.setenv("PATH", str(new.parent))
    assert command.executable("") == str(new)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(Fault, match="styleexp was not found on PATH: install it"):
        command.executable("")
    with pytest.raises(Fault, match="is not at '/nowhere'"):
        command.executable("/nowhere")
    with pytest.raises(Fault, match=r"is older than 0\.1\.0: upgrade it"):
        command.executable(str(script(tmp_path / "old", "print('styleexp 0.0.9')")))
    with pytest.raises(Fault, match="is not the command styleexp"):
        command.executable(str(script(tmp_path / "other", "print('Python 3.11.7')")))
    (tmp_path / "data").write_text("no program")
    with pytest.raises(Fault, match="doesn't start"):
        command.executable(str(tmp_path / "data"))


@pytest.mark.parametrize(
    ("line", "stage", "fraction"),
    [
        ("reading the source 'source.ply' ...", "reading the source 'source.ply'", None),
        ("refining the source for the style: 12 s", "refining the source for the style", None),
        ("covering it, round 3 of 12 ...", "covering it, round 3 of 12", 0.25),
        ("step 40/160  loss 0.1  1.00 steps/s  120 s left", "step 40 of 160", 0.25),
    ],
)  # fmt: skip
def test_progress(line, stage, fraction):
    others = ["note: refined from 967 to 20,000 faces", "silhouette_iou 0.98  flipped_faces 0"]
    assert command.progress([]) == command.Progress("starting")
    assert command.progress([line, *others]) == command.Progress(stage, fraction)


def test_failures_are_the_commands_own_sentence(tmp_path):
    log = tmp_path / "log.txt"
    lines = ["Traceback ...", "styleexp: unknown style 'scals': did you mean 'scales'?", ""]
    assert command.failure(lines, log) == "unknown style 'scals': did you mean 'scales'?"
    assert command.failure(["Killed"], log) == f"styleexp ended unexpectedly (Killed): see '{log}'."
    assert "nothing was printed" in command.failure([], log)


def ended(process, seconds=20):
    begun = time.monotonic()
    while (code := process.poll()) is None:
        assert time.monotonic() - begun < seconds
        time.sleep(0.02)
    return code


def test_process_is_followed_and_stopped(tmp_path, monkeypatch):
    said = "import time\nprint('reading ...', flush=True)\n"
    done = command.Process([str(script(tmp_path / "done", said + "print('caf\\u00e9')"))], tmp_path)
    assert ended(done) == 0
    assert done.lines == ["reading ...", "café"]
    assert (tmp_path / "log.txt").read_text("utf-8").splitlines()[1:] == done.lines
    assert not done.stopped

    monkeypatch.setattr(command, "PATIENCE", 0.2)
    deaf = "import signal\nsignal.signal(signal.SIGINT, signal.SIG_IGN)\n"
    for name, text in (("polite", said), ("deaf", deaf + said)):
        process = command.Process([str(script(tmp_path / name, text + "time.sleep(60)"))], tmp_path)
        while not process.lines:
            time.sleep(0.01)
        process.stop()
        assert process.stopped
        assert ended(process) != 0
    with pytest.raises(Fault, match="doesn't start"):
        command.Process([str(tmp_path / "nothing")], tmp_path)


# ------------------------------------------------------------------------------------- the surface


def quads():
    """A tube of quads with a seam in its texture coordinates, its corners in a source."""
    count, rings = 12, 5
    angle = np.arange(count) * 2 * np.pi / count
    ring = np.stack([np.cos(angle), np.sin(angle)], 1)
    points = np.concatenate([np.column_stack([ring, np.full(count, z)]) for z in range(rings)])
    corners, uv = [], []
    for z in range(rings - 1):
        for k in range(count):
            after = (k + 1) % count
            corners.append(
                [z * count + k, z * count + after, (z + 1) * count + after, (z + 1) * count + k]
            )
            uv += [[k / count, z / 4], [(k + 1) / count, z / 4],
                   [(k + 1) / count, (z + 1) / 4], [k / count, (z + 1) / 4]]  # fmt: skip
    loops = 4 * np.repeat(np.arange(len(corners)), 2)[:, None] + np.tile(
        [[0, 1, 2], [0, 2, 3]], (len(corners), 1)
    )
    return surface.Source(
        points.astype(np.float32), np.array(corners).ravel()[loops], loops,
        np.repeat(np.arange(len(corners)), 2), np.array(uv, np.float32),
        proportions=surface.proportions((1, 1, 2)),
    )  # fmt: skip


def test_axes_and_proportions():
    points = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    sent = surface.to_command(points, (1, 1, 1))
    np.testing.assert_array_equal(sent[:, 1], points[:, 2].astype(float))  # Z is up
    assert np.linalg.det(np.linalg.lstsq(points, sent, rcond=None)[0]) > 0  # not mirrored
    np.testing.assert_array_equal(surface.from_command(sent, (1, 1, 1)), points)
    assert surface.proportions((2, 2, 2.0000002)) == (1, 1, 1)
    assert surface.proportions((0, 1, 1)) == (1, 1, 1)
    np.testing.assert_allclose(surface.proportions((-1, 1, 8)), (0.5, 0.5, 4))


def saved(source, folder, move, refine):
    """As the command does it: read, refine, move, save."""
    surface.write_source(folder / "source.ply", source)
    mesh = meshes.load_mesh(folder / "source.ply")
    if refine:
        mesh = meshes.refine(mesh, 0.3)
    height = move(mesh.vertices)
    normals = meshes.vertex_normals(mesh.vertices, mesh.faces)
    moved = mesh.vertices + height[:, None] * normals
    meshes.save_mesh(mesh, moved, folder / "result.ply", height)
    return mesh, moved


def test_unrefined_result_moves_the_meshs_own_vertices(tmp_path):
    source = quads()
    _, moved = saved(source, tmp_path, lambda at: np.where(at[:, 1] > 3.5, 0.2, 0.0), False)
    found = surface.result(tmp_path / "result.ply", source)
    assert isinstance(found, surface.Moved)
    upper = source.points[:, 2] > 2
    np.testing.assert_array_equal(found.points[~upper], source.points[~upper])  # bit for bit
    np.testing.assert_allclose(found.displacement, np.where(upper, 0.2, 0), atol=1e-7)
    back = surface.from_command(moved, source.proportions)
    assert np.abs(found.points[upper, :2]).max() > 1.1
    assert len(back) == len(found.points)
    np.testing.assert_allclose(np.sort(back, axis=0), np.sort(found.points, axis=0), atol=1e-6)


def test_refined_result_knows_its_place_on_the_original(tmp_path):
    source = quads()
    mesh, _ = saved(source, tmp_path, lambda at: np.where(at[:, 1] > 3.5, 0.2, 0.0), True)
    found = surface.result(tmp_path / "result.ply", source)
    assert isinstance(found, surface.Refined)
    assert len(found.points) == len(mesh.vertices)  # nothing torn at seams
    assert len(found.faces) == len(mesh.faces) > 4 * len(source.triangles)
    # Linear along the tube, but for what the curves across its triangles, whose diagonals lean
    # to one side, move along it.
    height = source.points[:, 2]
    np.testing.assert_allclose(
        found.of_vertices(source, height)[found.displacement == 0],
        found.points[found.displacement == 0, 2], atol=1e-3,
    )  # fmt: skip
    # Texture coordinates have no triangle across the seam, and are those the command interpolates.
    uv = found.of_corners(source, source.uv).reshape(-1, 3, 2)
    assert np.ptp(uv[..., 0], axis=1).max() < 1.01 / 12
    table = surface.read_ply(tmp_path / "result.ply")
    theirs = np.stack([table.vertex["s"], table.vertex["t"]], 1)[table.faces]
    np.testing.assert_allclose(uv, theirs, atol=1e-6)
    # Every polygon keeps its area of the texture.
    polygon = found.of_faces(source, np.arange(48))
    edges = np.diff(uv, axis=1)
    area = np.bincount(polygon, np.abs(np.linalg.det(edges)) / 2)
    np.testing.assert_allclose(area, 1 / 48, rtol=1e-4)
    # Every edge is in pieces, which lie on it; the diagonals of quads are none.
    old = np.unique(np.sort(source.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1), axis=0)
    around = np.ptp(source.points[old, 2], axis=1) == 0  # the rings' edges
    new = np.unique(np.sort(found.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1), axis=0)
    pieces = found.of_edges(source, old[around], new)
    lies = np.abs(found.points[new, 2] - np.rint(found.points[new, 2])).max(1) < 1e-3
    lies &= np.ptp(np.rint(found.points[new, 2]), axis=1) == 0
    low = found.points[new, 2].max(1) < 1.5  # where nothing was moved
    np.testing.assert_array_equal((pieces >= 0)[low], lies[low])
    assert set(pieces) == {-1, *range(around.sum())}
    # Whole numbers aren't interpolated.
    assert set(np.unique(found.of_vertices(source, np.arange(60)))) == set(range(60))


def test_unknown_places_and_damaged_files(tmp_path):
    source = quads()
    mesh, _ = saved(source, tmp_path, lambda at: 0 * at[:, 0], False)
    bare = meshes.from_arrays(mesh.vertices, mesh.faces)
    meshes.save_mesh(bare, bare.vertices, tmp_path / "bare.ply")
    found = surface.result(tmp_path / "bare.ply", source)
    assert found.triangle is None
    assert len(found.faces) == len(source.triangles)
    content = (tmp_path / "result.ply").read_bytes()
    for damaged in (
        b"",
        content[:200],
        content[:-5],
        content.replace(b"float triangle", b"float tri_ngle"),
    ):
        (tmp_path / "damaged.ply").write_bytes(damaged)
        if b"tri_ngle" in damaged:
            assert surface.result(tmp_path / "damaged.ply", source).triangle is None
            continue
        with pytest.raises(Fault, match=r"damaged.ply' is missing or damaged: run again"):
            surface.result(tmp_path / "damaged.ply", source)
    fewer = surface.Source(
        source.points, source.triangles[:4], source.loops[:4], source.polygons[:4]
    )
    with pytest.raises(Fault, match="not the result of this object"):
        surface.result(tmp_path / "result.ply", fewer)
    empty = np.zeros((0, 3), int)
    with pytest.raises(Fault, match="the object has no faces"):
        surface.write_source(
            tmp_path / "x.ply", surface.Source(source.points, empty, empty, empty[:, 0])
        )


# ----------------------------------------------------------------------------------------- the zip


def test_zip_is_complete_and_reproducible(tmp_path):
    import runpy

    build = runpy.run_path(str(ROOT / "blender" / "build.py"))["build"]
    one, two = build(tmp_path / "one"), build(tmp_path / "two")
    assert one.name == f"styleexp-blender-{styleexp.__version__}.zip"
    assert one.read_bytes() == two.read_bytes()
    with zipfile.ZipFile(one) as archive:
        names = set(archive.namelist())
        manifest = tomllib.loads(archive.read("blender_manifest.toml").decode())
    assert names == {path.name for path in extension.FOLDER.iterdir() if path.is_file()} | {
        "LICENSE"
    }
    assert manifest["blender_version_min"] == "4.2.0"
    assert len(manifest["tagline"]) <= 64
    assert manifest["tagline"][-1].isalnum()


def test_nothing_but_the_standard_library_blender_and_numpy_is_imported():
    import ast

    allowed = {*sys.stdlib_module_names, "bpy", "numpy", None}
    for path in extension.FOLDER.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Import):
                assert {each.name.split(".")[0] for each in node.names} <= allowed, path
            elif isinstance(node, ast.ImportFrom) and not node.level:
                assert node.module.split(".")[0] in allowed, path
