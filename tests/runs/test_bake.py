"""Baked maps against the meshes that they are of."""

import json
import re

import imagecodecs
import numpy as np
import pytest
from gpytoolbox import squared_distance
from PIL import Image

from styleexp.cli.bake import main
from styleexp.config.compose import recorded
from styleexp.inputs import meshes
from styleexp.inputs.meshes import face_areas, load_mesh, vertex_normals
from styleexp.runs import bake
from styleexp.runs.origins import describe
from tests.helpers import warm

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
            square = (a, a + 1, a + columns + 1, a + columns)
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


def test_what_cannot_be_baked_is_said_in_one_sentence(tmp_path, capsys):
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
    assert "has no texture coordinates" in told(tmp_path / "run")
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
    normals = vertex_normals(low.vertices, low.faces)
    n = unit((normals[low.faces[face]] * weights).sum(axis=1))
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


@pytest.mark.parametrize("kind", ["obj", "mirrored", "folded_glb", "bare", "textured_glb"])
def test_the_low_poly_mesh_with_its_maps_is_the_result(kind, detailed, tmp_path, capsys):
    """A height of the wrong sign, a flipped green channel, a shift by half a texel or a wrong
    direction of v would show."""
    pytest.importorskip("embreex", reason="Embree is not installed (extra bake)")
    pytest.importorskip("xatlas", reason="xatlas is not installed (extra bake)")
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
    distance, angle, plain = compare(low, maps, moved, fine.faces)
    assert distance < 0.06
    assert angle < 0.8
    assert plain > 7
