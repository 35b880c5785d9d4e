"""Baked maps against the meshes that they are of."""

import io
import json
import re
import sys

import imagecodecs
import numpy as np
import pytest
import trimesh
from gpytoolbox import squared_distance
from PIL import Image

from styleexp.cli.bake import main
from styleexp.config.compose import recorded
from styleexp.inputs import meshes
from styleexp.inputs.meshes import face_areas, load_mesh, vertex_normals
from styleexp.runs import bake
from styleexp.runs.origins import describe
from tests.helpers import gltf_readers, warm
from tests.helpers.needed import available

SIZE = 256


def grid(rows, columns, shape, across=None):
    """OBJ lines of a (rows x columns) patch with one UV island; ``shape`` maps u, v to a point, and
    ``across`` u to what the file has for it."""
    u, v = np.meshgrid(np.linspace(0, 1, columns), np.linspace(0, 1, rows))
    points = np.stack(shape(u, v), axis=-1).reshape(-1, 3)
    u = across(u) if across else u
    lines = [f"v {x:.9f} {y:.9f} {z:.9f}" for x, y, z in points]
    lines += [f"vt {a:.9f} {b:.9f}" for a, b in zip(u.ravel(), v.ravel(), strict=True)]
    for i in range(rows - 1):
        for j in range(columns - 1):
            a = i * columns + j + 1
            square = [a, a + 1, a + columns + 1, a + columns]
            if across is fold and j >= columns // 2:
                square = square[1:] + square[:1]  # the other diagonal, as in a mirrored mesh
            lines.append("f " + " ".join(f"{k}/{k}" for k in square))
    return "\n".join(lines)


def torus(u, v):
    """Closed: the island's opposite borders are seams."""
    a, b = 2 * np.pi * u, 2 * np.pi * v
    return (1 + 0.4 * np.cos(b)) * np.sin(a), 0.4 * np.sin(b), (1 + 0.4 * np.cos(b)) * np.cos(a)


def plane(u, v):
    """Towards +Z, u along +X, v along +Y."""
    return u, v, 0 * u


def flip(u):
    """A mirrored texture."""
    return 1 - u


def fold(u):
    """A texture that two halves share, one of them mirrored."""
    return np.minimum(u, 1 - u)


def write_run(folder, source, displacement, moved, path=None):
    """A finished run's folder, of these numbers; ``path`` is the file that it was made from."""
    folder.mkdir()
    path = path or folder.parent / f"{source.name}.obj"
    record = {
        "schema": 1,
        "config": {"source": {"path": str(path)}, "style": {"name": "bubble"}},
    }
    record["assets"] = describe(recorded(record["config"]))
    (folder / "run.json").write_text(json.dumps(record))
    (folder / "status.json").write_text('{"status": "done"}')
    meshes.save_mesh(source, moved, folder / "result.ply", displacement)


@pytest.fixture(scope="module")
def baked(tmp_path_factory):
    """A torus with seams and a wave on it, baked by the command."""
    folder = tmp_path_factory.mktemp("bake")
    (folder / "torus.obj").write_text(grid(49, 97, torus))
    source = load_mesh(folder / "torus.obj")
    assert len(source.vertices) == 48 * 96  # the seams are welded
    x, y, z = source.vertices.T
    displacement = 0.03 * np.sin(4 * x) * np.cos(5 * z) + 0.02 * y
    normals = vertex_normals(source.vertices, source.faces)
    moved = source.vertices + displacement[:, None] * normals
    write_run(folder / "run", source, displacement, moved)
    done = warm.run("-m", "styleexp.cli.bake", folder / "run", "--size", SIZE)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return source, displacement, moved, folder / "run"


def sample(texture, uv):
    """Bilinear, repeating, v up: as any renderer reads it."""
    size = len(texture)
    x, y = uv[:, 0] * size - 0.5, (1 - uv[:, 1]) * size - 0.5
    i, j = np.floor(y).astype(int), np.floor(x).astype(int)
    fy, fx = y - i, x - j
    if texture.ndim == 3:
        fy, fx = fy[:, None], fx[:, None]

    def at(a, b):
        return texture[a % size, b % size]

    top = at(i, j) * (1 - fx) + at(i, j + 1) * fx
    return top * (1 - fy) + (at(i + 1, j) * (1 - fx) + at(i + 1, j + 1) * fx) * fy


def test_the_source_displaced_by_the_height_map_is_the_result(baked):
    source, displacement, moved, run = baked
    told = json.loads((run / "bake" / "bake.json").read_text())
    with Image.open(run / "bake" / "height.png") as opened:
        assert opened.mode.startswith("I")  # 16 bits
        assert opened.size == (SIZE, SIZE)
        value = np.asarray(opened, float) / 65535
    rows = source.carrier.rows
    height = told["height"]["scale"] * (
        sample(value, source.carrier.uv) - told["height"]["midlevel"]
    )
    assert np.abs(height - displacement[rows]).max() < 0.02 * np.abs(displacement).max()
    normals = vertex_normals(source.vertices, source.faces)
    again = source.vertices[rows] + height[:, None] * normals[rows]
    assert np.linalg.norm(again - moved[rows], axis=1).max() < 0.001  # of a radius of 1.4
    assert told["height"]["most"] == pytest.approx(displacement.max(), rel=0.02)
    assert told["covered"] == 1
    assert told["overlap"] == 0


def test_the_normal_map_gives_the_results_normals(baked):
    source, _, moved, run = baked
    content = (run / "bake" / "normal.png").read_bytes()
    assert (content[24], content[25]) == (16, 2)  # bits, RGB
    with Image.open(run / "bake" / "normal.png") as opened:
        eight = np.asarray(opened.convert("RGB"), float)  # Pillow keeps the upper bytes
    stored = eight / 255 * 2 - 1
    assert np.abs(np.linalg.norm(stored, axis=-1) - 1).max() < 0.02
    carrier = source.carrier
    base = vertex_normals(source.vertices, source.faces)[carrier.rows]
    # The torus's own directions of u and v, from its formula.
    a, b = 2 * np.pi * carrier.uv.T
    t = np.stack([np.cos(a), 0 * a, -np.sin(a)], axis=1)
    v = np.stack([-np.sin(b) * np.sin(a), np.cos(b), -np.sin(b) * np.cos(a)], axis=1)
    n = sample(stored, carrier.uv)
    found = n[:, :1] * t + n[:, 1:2] * v + n[:, 2:] * base
    wanted = vertex_normals(moved, source.faces)[carrier.rows]
    cosine = (found * wanted).sum(1) / np.linalg.norm(found, axis=1)
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 3
    assert np.degrees(np.arccos(np.clip((base * wanted).sum(1), -1, 1))).max() > 8


def bump(tmp_path, mirrored):
    name = f"plane{mirrored}.obj"
    (tmp_path / name).write_text(grid(33, 33, plane, flip if mirrored else None))
    source = load_mesh(tmp_path / name)
    x, y, _ = source.vertices.T
    height = 0.1 * np.exp(-((x - 0.5) ** 2 + (y - 0.5) ** 2) / 0.02)
    moved = source.vertices + np.stack([0 * x, 0 * x, height], axis=1)
    return bake.bake(source, height, moved, 64)


def test_conventions_of_the_maps(tmp_path):
    """OpenGL's: on a bump, the right flank is red and the upper one green."""
    maps = bump(tmp_path, mirrored=False)
    assert maps.height[32, 32] == pytest.approx(0.1, rel=0.05)
    right, left, up, down = (maps.normal[at] for at in ((32, 40), (32, 23), (23, 32), (40, 32)))
    assert right[0] > 0.3
    assert left[0] < -0.3
    assert up[1] > 0.3  # row 0 is v = 1
    assert down[1] < -0.3
    np.testing.assert_allclose(maps.normal[2, 2], [0, 0, 1], atol=0.01)
    # A mirrored island shows the picture mirrored, and red still points along u.
    other = bump(tmp_path, mirrored=True)
    np.testing.assert_allclose(other.height, maps.height[:, ::-1], atol=0.003)
    flip = maps.normal[:, ::-1] * [-1, 1, 1]
    np.testing.assert_allclose(other.normal, flip, atol=0.06)


def test_islands_grow_over_their_borders_and_overlaps_are_counted(tmp_path):
    uv = "vt 0.25 0.25\nvt 0.75 0.25\nvt 0.25 0.75\n"
    (tmp_path / "one.obj").write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\n{uv}f 1/1 2/2 3/3\n")
    source = load_mesh(tmp_path / "one.obj")
    maps = bake.bake(source, np.array([1.0, 2.0, 3.0]), source.vertices, 64)
    assert maps.covered.mean() == pytest.approx(0.125, abs=0.01)
    assert maps.overlap == 0
    assert maps.height[60, 2] == pytest.approx(1, abs=0.05)  # lower left, outside
    assert maps.height[60, 60] == pytest.approx(2, abs=0.1)
    assert maps.height.min() >= 0.99
    two = "v 0 0 5\nv 1 0 5\nv 0 1 5\n"
    (tmp_path / "two.obj").write_text(
        f"v 0 0 0\nv 1 0 0\nv 0 1 0\n{two}{uv}f 1/1 2/2 3/3\nf 4/1 5/2 6/3\n"
    )
    stacked = load_mesh(tmp_path / "two.obj")
    assert bake.bake(stacked, np.zeros(6), stacked.vertices, 64).overlap > 0.8


def test_exr_holds_the_displacement_itself(baked, tmp_path):
    OpenEXR = pytest.importorskip("OpenEXR", reason="OpenEXR is not installed (extra exr)")
    source, displacement, _, run = baked
    out = tmp_path / "maps"
    assert main([str(run), "--size", "64", "--format", "exr", "--out", str(out)]) == 0
    with OpenEXR.File(str(out / "height.exr")) as file:
        height = file.channels()["Y"].pixels
    assert height.dtype == np.float32
    found = sample(height.astype(float), source.carrier.uv)
    assert np.abs(found - displacement[source.carrier.rows]).max() < 0.005
    told = json.loads((out / "bake.json").read_text())["height"]
    assert (told["midlevel"], told["scale"]) == (0, 1)
    with OpenEXR.File(str(out / "normal.exr")) as file:
        assert file.channels()["RGB"].pixels.shape == (64, 64, 3)


def test_what_cannot_be_baked_is_said_in_one_sentence(tmp_path, capsys, monkeypatch):
    from styleexp.inputs import shapes

    def told(*arguments):
        assert main([str(each) for each in arguments]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        return line

    assert "there is no folder" in told(tmp_path / "none")
    assert "no result.ply" in told(tmp_path)
    ball = shapes.make("torus")
    meshes.save_mesh(ball, ball.vertices, tmp_path / f"{ball.name}.obj")
    ball = load_mesh(tmp_path / f"{ball.name}.obj")
    write_run(tmp_path / "run", ball, np.zeros(len(ball.vertices)), ball.vertices)
    monkeypatch.setitem(sys.modules, "embreex", None)  # to make texture coordinates with
    assert "pip install 'styleexp[bake]'" in told(tmp_path / "run")
    assert "--size 3 is not allowed" in told(tmp_path / "run", "--size", 3)
    assert not (tmp_path / "run" / "bake").exists()


# ---------------------------------------------------------------------------- onto another mesh


def low_poly(folder, kind):
    """The file of a coarse torus with everything that ``kind`` names: a format, ``mirrored`` or
    ``folded`` texture coordinates, ``bare`` without any, ``textured``."""
    across = {"mirrored": flip, "folded": fold}.get(kind.split("_")[0])
    lines = grid(13, 25, torus, across)
    if kind.startswith("bare"):
        lines = re.sub(r"/\d+", "", re.sub(r"vt .*\n", "", lines))
    if "textured" in kind:
        Image.new("RGB", (8, 8), (200, 120, 40)).save(folder / "skin.png")
        (folder / "low.mtl").write_text("newmtl skin\nKd 1 1 1\nmap_Kd skin.png\n")
        lines = f"mtllib low.mtl\nusemtl skin\n{lines}"
    (folder / "low.obj").write_text(lines)
    if not kind.endswith("glb"):
        return folder / "low.obj"
    mesh = load_mesh(folder / "low.obj")
    meshes.save_mesh(mesh, mesh.vertices, folder / "low.glb")
    return folder / "low.glb"


@pytest.fixture(scope="module")
def detailed(tmp_path_factory):
    """A fine torus with a relief that is symmetric in x, and in nothing else, and that run's
    result."""
    folder = tmp_path_factory.mktemp("detailed")
    (folder / "fine.obj").write_text(grid(73, 145, torus))
    mesh = load_mesh(folder / "fine.obj")
    x, y, z = mesh.vertices.T
    height = 0.03 * np.sin(9 * x**2 + 3) * np.cos(5 * z + 4 * y) + 0.01 * y
    moved = mesh.vertices + height[:, None] * vertex_normals(mesh.vertices, mesh.faces)
    return mesh, height, moved


def read_maps(folder):
    """The maps as another program reads them: height in units, the rest as stored in [0, 1]."""
    told = json.loads((folder / "bake.json").read_text())
    maps = {}
    for name in ("height", "normal", "occlusion", "curvature"):
        picture = imagecodecs.png_decode((folder / f"{name}.png").read_bytes())
        assert picture.dtype == np.uint16
        maps[name] = picture / 65535
    coding = told["height"]
    maps["height"] = coding["scale"] * (maps["height"] - coding["midlevel"])
    return maps, told


def compare(low, maps, vertices, faces):
    """The low-poly mesh with its maps against a surface: RMS distance from it after moving by the
    height map, as a fraction of that before, and mean angle in degrees between the normals that a
    shader gets from the normal map and the surface's.

    The shader finds its tangents by derivatives, as those do that are given none.
    """
    rng = np.random.default_rng(1)
    corners = low.carrier.corners.copy()
    corners[low.carrier.flipped] = corners[low.carrier.flipped][:, ::-1]
    face = rng.choice(len(low.faces), 4000, p=(a := face_areas(low.vertices, low.faces)) / a.sum())
    weights = rng.dirichlet([1, 1, 1], len(face))[:, :, None]

    def unit(each):
        return each / np.linalg.norm(each, axis=1, keepdims=True)

    p, uv = low.vertices[low.faces[face]], low.carrier.uv[corners[face]]
    at = (uv * weights).sum(axis=1)
    n = unit((low.carrier.normals[corners[face]] * weights).sum(axis=1))
    base = (p * weights).sum(axis=1)
    moved = base + sample(maps["height"], at)[:, None] * n
    before = squared_distance(base, vertices, faces, use_cpp=True)[0]
    after, there, where = squared_distance(moved, vertices, faces, use_cpp=True)

    (du1, dv1), (du2, dv2) = ((uv[:, k] - uv[:, 0]).T[:, :, None] for k in (1, 2))
    area = du1 * dv2 - du2 * dv1
    t = ((p[:, 1] - p[:, 0]) * dv2 - (p[:, 2] - p[:, 0]) * dv1) / area
    t = unit(t - n * (t * n).sum(axis=1, keepdims=True))
    m = sample(maps["normal"], at) * 2 - 1
    shaded = m[:, :1] * t + m[:, 1:2] * np.cross(n, t) * np.sign(area) + m[:, 2:] * n
    bent = vertex_normals(vertices, faces)[faces[there]]
    wanted = unit((bent * where[:, :, None]).sum(axis=1))
    angle = np.degrees(np.arccos(np.clip((unit(shaded) * wanted).sum(axis=1), -1, 1)))
    plain = np.degrees(np.arccos(np.clip((n * wanted).sum(axis=1), -1, 1)))
    return np.sqrt(after.mean() / before.mean()), angle.mean(), plain.mean()


@pytest.fixture
def rays():
    """Skips without the extra ``bake``."""
    pytest.importorskip("embreex", reason="Embree is not installed (extra bake)")
    pytest.importorskip("xatlas", reason="xatlas is not installed (extra bake)")


@pytest.mark.usefixtures("rays")
@pytest.mark.parametrize("kind", ["obj", "mirrored", "folded_glb", "bare", "textured_glb"])
def test_the_low_poly_mesh_with_its_maps_is_the_result(kind, detailed, tmp_path, capsys):
    """A height of the wrong sign, a flipped green channel, a shift by half a texel or a wrong
    direction of v would show."""
    available(gltf_readers.tools)
    path = low_poly(tmp_path, kind)
    fine, height, moved = detailed
    write_run(tmp_path / "run", fine, height, moved, path)
    size = 256 if kind.startswith(("bare", "folded")) else 128
    assert main([str(tmp_path / "run"), "--size", str(size)]) == 0
    told = capsys.readouterr().err
    assert ("has no texture coordinates: unwrapped" in told) == kind.startswith("bare"), told
    assert ("is shared by several faces" in told) == kind.startswith("folded"), told
    maps, told = read_maps(tmp_path / "run" / "bake")
    assert told["filled_from_neighbours"] == 0
    low = load_mesh(tmp_path / "run" / "bake" / "result_low.glb")
    assert low.vertices.shape == load_mesh(path).vertices.shape
    assert gltf_readers.errors(tmp_path / "run" / "bake" / "result_low.glb") == [[]]
    distance, angle, plain = compare(low, maps, moved, fine.faces)
    assert distance < 0.06
    assert angle < 0.8
    assert plain > 7


def test_tangents_are_blenders():
    """A fan whose quadrants are mirrored by turns: at its centre, two of equal handedness touch
    without an edge between them, and all share one texture coordinate."""
    a = np.arange(8) * np.pi / 4
    rim = np.stack([np.cos(a), np.sin(a), 0.3 * np.sin(3 * a + 1)], axis=1)
    points = np.vstack([[0, 0, 0.4], rim])
    faces = np.stack([0 * np.arange(8), 1 + np.arange(8), 1 + (np.arange(8) + 1) % 8], axis=1)
    flat = np.abs(points[:, :2])
    uv = flat * [1, 0.8] + 0.1 * flat[:, ::-1]
    normals = vertex_normals(points, faces)
    found, sign = bake.tangents.tangents(points[faces], normals[faces], uv[faces])
    assert sign.tolist() == [1, 1, -1, -1, 1, 1, -1, -1]
    # Mesh.calc_tangents of Blender 5.0.1
    theirs = """
      .992 -.124 0     .980 -.111 -.163   .991 -.125 -.053   .992 -.124 0     .991 -.125 -.053
      .972 -.190 -.139 -.992 -.124 0     -.928 -.171 .330   -.986 -.125 -.115 -.992 -.124 0
     -.986 -.125 -.115 -.825 -.105 -.555 -.992 .124 0       -.841 .099 -.532  -.909 .114 -.401
     -.992 .124 0     -.909 .114 -.401   -.968 .023 .250     .992 .124 0       .970 .018 -.241
      .930 .128 -.345  .992 .124 0        .930 .128 -.345    .983 .137 -.123"""
    np.testing.assert_allclose(found.ravel(), np.fromstring(theirs, sep=" "), atol=0.001)


@pytest.mark.usefixtures("rays")
def test_occlusion_and_curvature_of_a_pit_and_a_knob(tmp_path):
    def shape(u, v):
        bumps = [np.exp(-((u - c) ** 2 + (v - 0.5) ** 2) / 0.02) for c in (0.3, 0.7)]
        return u, v, 0.1 * (bumps[1] - bumps[0])

    (tmp_path / "low.obj").write_text(grid(2, 2, plane))
    (tmp_path / "fine.obj").write_text(grid(81, 81, shape))
    fine = load_mesh(tmp_path / "fine.obj")
    maps = bake.bake_onto(
        bake.low(load_mesh(tmp_path / "low.obj")), fine.vertices, fine.faces, 64, cage=0.3
    )
    pit, knob, plain = (32, 19), (32, 44), (8, 8)
    assert maps.height[pit] == pytest.approx(-0.1, abs=0.002)
    assert maps.height[knob] == pytest.approx(0.1, abs=0.002)
    # At the bottom of z = d exp(-r^2 / s) both principal curvatures are 2 d / s.
    assert maps.curvature[pit] == pytest.approx(-10, rel=0.1)
    assert maps.curvature[knob] == pytest.approx(10, rel=0.1)
    assert abs(maps.curvature[plain]) < 1
    # From the bottom, the sky is open above the steepest line to the pit's wall.
    r = np.linspace(0.01, 0.3, 300)
    steepest = (0.1 * (1 - np.exp(-(r**2) / 0.02)) / r).max()
    assert maps.occlusion[pit] == pytest.approx(1 / (1 + steepest**2), abs=0.02)
    assert maps.occlusion[knob] == pytest.approx(1, abs=0.02)
    assert maps.occlusion[plain] > 0.97
    assert maps.told["cage"] == 0.3
    # With a cage that ends on their flanks, pit and knob are filled from there, and it is said.
    again = bake.bake_onto(
        bake.low(load_mesh(tmp_path / "low.obj")), fine.vertices, fine.faces, 64, cage=0.05
    )
    assert 0.01 < again.told["filled_from_neighbours"] < 0.09
    assert np.abs(again.height).max() <= 0.0501


@pytest.mark.usefixtures("rays")
def test_a_files_own_normals_are_baked_for(tmp_path):
    """A cube with hard edges gets a smooth cube's normals: the map undoes the edges."""
    cube = trimesh.creation.box()
    corners = cube.vertices[cube.faces].reshape(-1, 3)
    hard = trimesh.Trimesh(corners, np.arange(36).reshape(-1, 3), process=False)
    place = np.stack(np.divmod(np.arange(12), 2), axis=1) / [6, 2]
    uv = place[:, None] + [[0, 0], [0.15, 0], [0, 0.45]]
    hard.visual = trimesh.visual.TextureVisuals(uv=uv.reshape(-1, 2))
    (tmp_path / "cube.glb").write_bytes(hard.export(file_type="glb", include_normals=True))
    target = bake.low(load_mesh(tmp_path / "cube.glb"))
    assert target.own
    maps = bake.bake_onto(target, cube.vertices, cube.faces, 256, cage=0.1)
    assert np.abs(maps.height).max() < 1e-4
    read = {"height": maps.height, "normal": maps.normal / 2 + 0.5}
    with np.errstate(invalid="ignore", divide="ignore"):  # it is the same surface
        _, angle, plain = compare(target.mesh, read, cube.vertices, cube.faces)
    assert angle < 1
    assert plain > 20


@pytest.mark.usefixtures("rays")
def test_the_sources_own_material_stays_in_the_low_poly_glb(detailed, tmp_path, capsys):
    path = low_poly(tmp_path, "textured_glb")
    fine, height, moved = detailed
    write_run(tmp_path / "run", fine, height, moved, path)

    def materials(*more):
        options = ("--onto", path, "--size", 32, *more)
        assert main([str(tmp_path / "run"), *map(str, options)]) == 0
        tree, binary = gltf_readers.parts(tmp_path / "run" / "bake" / "result_low.glb")
        (material,) = tree["materials"]
        pictures = {}
        for key, entry in (material | material["pbrMetallicRoughness"]).items():
            if key.endswith("Texture"):
                view = tree["bufferViews"][
                    tree["images"][tree["textures"][entry["index"]]["source"]]["bufferView"]
                ]
                start = view.get("byteOffset", 0)
                content = binary[start : start + view["byteLength"]]
                pictures[key] = np.asarray(Image.open(io.BytesIO(content)))
        return material["name"], pictures

    name, pictures = materials()
    assert name == "skin"
    assert pictures["baseColorTexture"][0, 0].tolist() == [200, 120, 40]
    maps, _ = read_maps(tmp_path / "run" / "bake")
    np.testing.assert_allclose(pictures["normalTexture"] / 255, maps["normal"], atol=0.003)
    np.testing.assert_allclose(pictures["occlusionTexture"] / 255, maps["occlusion"], atol=0.003)
    capsys.readouterr()
    _, pictures = materials("--unwrap")
    assert "left out the textures" in capsys.readouterr().err
    assert sorted(pictures) == ["normalTexture", "occlusionTexture"]


@pytest.mark.usefixtures("rays")
def test_what_cannot_be_baked_onto_is_said_in_one_sentence(detailed, tmp_path, capsys, monkeypatch):
    path = low_poly(tmp_path, "obj")
    fine, height, moved = detailed
    write_run(tmp_path / "run", fine, height, moved, path)

    def told(*options):
        assert main([str(each) for each in (tmp_path / "run", "--size", 32, *options)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert not (tmp_path / "run" / "bake").exists()
        return line

    mesh = load_mesh(path)
    for name, points in (("aside", mesh.vertices + 9), ("mm", mesh.vertices * 1000)):
        meshes.save_mesh(mesh, points, tmp_path / f"{name}.obj")
        assert f"'{name}' is not where the result is" in told("--onto", tmp_path / f"{name}.obj")
    meshes.save_mesh(mesh, mesh.vertices * 1e-40, tmp_path / "tiny.obj")
    assert "scale the mesh" in told("--onto", tmp_path / "tiny.obj")
    assert "does not exist" in told("--onto", tmp_path / "none.obj")
    assert "--size 8193 is not allowed" in told("--onto", "source", "--size", 8193)
    assert "--cage -1.0 is not allowed" in told("--cage", -1)
    assert "--cage nan is not allowed" in told("--cage", "nan")
    meshes.save_mesh(mesh, mesh.vertices * [1, 1.3, 1], tmp_path / "tall.obj")
    assert "within reach" in told("--onto", tmp_path / "tall.obj", "--cage", 1e-9)
    monkeypatch.setitem(sys.modules, "embreex", None)
    assert "pip install 'styleexp[bake]'" in told()
