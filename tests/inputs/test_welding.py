"""Vertices that rounding has torn apart are joined, and nothing else is."""

from __future__ import annotations

import numpy as np
import pytest

from styleexp.config.checks import check
from styleexp.config.compose import compose
from styleexp.config.sources import load_source
from styleexp.inputs import meshes
from styleexp.inputs.meshes import precision
from styleexp.system.errors import UserError
from tests.helpers.corpus.writers import obj, ply, stl


def torus(columns=40, rows=20, radius=10.0, tube=4.0):
    """Vertices (columns * rows, 3) and faces, closed."""
    a, b = np.meshgrid(
        np.arange(columns) * 2 * np.pi / columns, np.arange(rows) * 2 * np.pi / rows, indexing="ij"
    )
    ring = radius + tube * np.cos(b)
    points = np.stack([ring * np.cos(a), ring * np.sin(a), tube * np.sin(b)], axis=-1)
    k = np.arange(columns * rows).reshape(columns, rows)
    right, up = np.roll(k, -1, axis=0), np.roll(k, -1, axis=1)
    both = np.roll(right, -1, axis=1)
    faces = np.stack([k, right, both, k, both, up], axis=-1).reshape(-1, 3)
    return points.reshape(-1, 3), faces


def turned(rng, points):
    """Any way round."""
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return points @ q


def torn_apart(rng, points, faces, ulps=1):
    """A soup of single precision whose corners are off by some units in the last place."""
    corners = points[faces].reshape(-1, 3).astype(np.float32)
    for _ in range(ulps):
        way = rng.choice([-np.inf, 0, np.inf], corners.shape).astype(np.float32)
        corners = np.where(way == 0, corners, np.nextafter(corners, way))
    return corners.astype(float), np.arange(len(corners)).reshape(-1, 3)


@pytest.mark.parametrize("offset", [0, 100, 3000])
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", ["stl", "ply", "obj"])
def test_singles_off_by_a_unit_in_the_last_place_are_one(tmp_path, kind, seed, offset):
    rng = np.random.default_rng(seed)
    points, faces = torus()
    points = turned(rng, points) + rng.normal(size=3) * offset
    soup = torn_apart(rng, points, faces)
    path = tmp_path / f"a.{kind}"
    path.write_bytes({"stl": stl, "ply": ply, "obj": obj}[kind](*soup))
    apart = len(np.unique(soup[0], axis=0))
    assert apart > 2 * len(points)
    mesh = meshes.load_mesh(path)
    assert len(mesh.vertices) == len(points)
    told = [note for note in mesh.repairs if "origin" not in note]
    assert len(told) == 1
    assert told[0].startswith(f"merged {apart - len(points)} vertices within ")
    exact = meshes.load_mesh(path, 0)
    assert len(exact.vertices) == apart
    assert any("nearly coincide" in note for note in exact.repairs)


@pytest.mark.parametrize("digits", [6, 7, 8])
@pytest.mark.parametrize("style", ["f", "g"])
def test_written_digits_count(tmp_path, digits, style):
    """As an exporter writes corners that it has computed in two ways."""
    rng = np.random.default_rng(digits)
    points, faces = torus()
    corners = points[faces].reshape(-1, 3)
    corners = corners + rng.uniform(-0.6, 0.6, corners.shape) * 10.0 ** -(digits - 2)
    places = digits - 2 if style == "f" else digits
    lines = [
        f"v {x:.{places}{style}} {y:.{places}{style}} {z:.{places}{style}}" for x, y, z in corners
    ]
    lines += [f"f {k + 1} {k + 2} {k + 3}" for k in range(0, len(corners), 3)]
    path = tmp_path / "a.obj"
    path.write_text("\n".join(lines) + "\n")
    assert len(meshes.load_mesh(path, 0).vertices) > 1.5 * len(points)
    assert len(meshes.load_mesh(path).vertices) == len(points)


def test_precision_of_text():
    def of(*words):
        return precision.of_text(words, np.array([[float(w) for w in words]]))

    assert of("1.5", "-0.25", "12") == pytest.approx(4 * 2**-20)  # fewer digits than singles have
    assert of("0.123456789012", "1.000000000001") == pytest.approx(2e-12)
    assert of("1234567.12345678", "1.5") == pytest.approx(2e-8)
    assert of("100", "250.5") == pytest.approx(4 * 2**-16)


def plate(thickness, offset=0.0):
    """A closed box of side 1, and its faces."""
    low, high = np.zeros(3), np.array([1.0, 1.0, thickness])
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = np.array([t for a, b, c, d in quads for t in ([a, b, c], [a, c, d])])
    return low + corners * high + offset, faces


@pytest.mark.parametrize("thickness", [1e-2, 1e-5, 2.0**-22])
def test_the_sides_of_a_thin_part_stay_two(tmp_path, thickness):
    points, faces = plate(thickness)
    path = tmp_path / "a.stl"
    path.write_bytes(stl(points, faces))
    for distance in (None, 10 * thickness):
        mesh = meshes.load_mesh(path, distance)
        assert len(mesh.vertices) == 8
        assert mesh.repairs == ()


@pytest.mark.parametrize("gap", [1e-3, 1e-5])
def test_open_sheets_above_each_other_stay_two(tmp_path, gap):
    k = np.arange(100).reshape(10, 10)
    one = np.stack([k // 10, k % 10, 0 * k], axis=-1).reshape(-1, 3).astype(float)
    a, b, c, d = (x.ravel() for x in (k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    points = np.concatenate([one, one + np.array([0, 0, gap])])
    path = tmp_path / "a.ply"
    path.write_bytes(ply(points, np.concatenate([faces, faces[:, ::-1] + 100])))
    mesh = meshes.load_mesh(path)
    assert len(mesh.vertices) == 200


def test_small_triangles_keep_their_edges(tmp_path):
    """An open fan whose edges are shorter than singles' noise where it lies."""
    angle = np.linspace(0, 5, 12)
    fan = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1) * 2e-4 + [1000, 0, 0]
    points = np.concatenate([[[1000, 0, 0]], fan, [[0, 0, 0], [0, 1, 0], [1, 0, 0]]])
    faces = [(0, k, k + 1) for k in range(1, 12)] + [(13, 14, 15)]
    path = tmp_path / "a.stl"
    path.write_bytes(stl(points.astype("f4"), faces))
    exact = len(np.unique(points.astype("f4"), axis=0))
    for distance in (None, 1e-3, 1.0):
        mesh = meshes.load_mesh(path, distance)
        assert len(mesh.vertices) == exact
        assert (mesh.faces != np.roll(mesh.faces, 1, axis=1)).all()


def test_no_edge_collapses_however_far_is_joined(tmp_path):
    rng = np.random.default_rng(0)
    points, faces = torus()
    soup = torn_apart(rng, points, faces, ulps=3)
    path = tmp_path / "a.stl"
    path.write_bytes(stl(*soup))
    for distance in (1e-4, 1e-2, 1.0, 1e3):
        mesh = meshes.load_mesh(path, distance)
        assert len(mesh.vertices) == len(points)
        assert (mesh.faces != np.roll(mesh.faces, 1, axis=1)).all()


def test_seams_stay_seams(tmp_path):
    """Rows whose positions differ by rounding are one vertex with two texture coordinates."""
    points, faces = torus()
    rng = np.random.default_rng(1)
    soup, corners = torn_apart(rng, points, faces)
    uv = rng.random((len(soup), 2)).round(4)
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in soup.tolist()]
    lines += [f"vt {u} {v}" for u, v in uv.tolist()]
    lines += ["f " + " ".join(f"{k + 1}/{k + 1}" for k in f) for f in corners]
    path = tmp_path / "a.obj"
    path.write_text("\n".join(lines) + "\n")
    mesh = meshes.load_mesh(path)
    assert len(mesh.vertices) == len(points)
    meshes.save_mesh(mesh, mesh.vertices * 2, tmp_path / "b.obj")
    back = meshes.load_mesh(tmp_path / "b.obj")
    np.testing.assert_array_equal(back.carrier.uv[back.carrier.corners].reshape(-1, 2), uv)
    assert len(back.vertices) == len(points)


def test_wide_gaps_are_named_and_joined_when_asked(tmp_path):
    points, faces = torus()
    half = np.isin(faces // 20, range(20)).all(axis=1)
    cut = np.concatenate([points, points + np.array([0, 0, 3e-4])])
    both = np.concatenate([faces[half], faces[~half] + len(points)])
    path = tmp_path / "a.ply"
    path.write_bytes(ply(cut, both))
    mesh = meshes.load_mesh(path)
    told = next(note for note in mesh.repairs if "nearly coincide" in note)
    assert told.startswith("80 open edges nearly coincide with others, up to 0.0003 apart")
    assert told in " ".join(meshes.remesh(fanned(mesh), 3000).repairs)
    distance = float(told.split("source.weld=")[1].split()[0])
    closed = meshes.load_mesh(path, distance)
    assert len(closed.vertices) == len(points)
    assert any(note.startswith("merged 40 vertices within ") for note in closed.repairs)


def fanned(mesh):
    """The mesh with a third face at an edge."""
    extra = np.array([[mesh.faces[0, 0], mesh.faces[0, 1], mesh.faces[-1, 2]]])
    return meshes.Mesh("a", mesh.vertices, np.concatenate([mesh.faces, extra]), (), mesh.carrier)


def test_the_key_sets_it(tmp_path):
    points, faces = torus()
    path = tmp_path / "a.stl"
    path.write_bytes(stl(*torn_apart(np.random.default_rng(2), points, faces)))
    config = compose([f"source.path={path}", "style=bubble", "source.weld=0"])
    assert len(load_source(config.source).vertices) > 2000
    config.source.weld = None
    assert len(load_source(config.source).vertices) == len(points)
    config.source.weld = -1.0
    with pytest.raises(UserError, match=r"source\.weld=-1"):
        check(config)


def test_a_heap_of_points_needs_no_more_memory_than_it_has(tmp_path):
    """A hundred thousand open triangles within what is joined."""
    rng = np.random.default_rng(3)
    heap = rng.random((60_000, 3)) * 1e-5
    points = np.concatenate([heap, [[1, 0, 0], [0, 1, 0], [0, 0, 1]]])
    faces = np.arange(len(points)).reshape(-1, 3)
    path = tmp_path / "a.stl"
    path.write_bytes(stl(points, faces))
    mesh = meshes.load_mesh(path, 1e-2)
    assert (mesh.faces != np.roll(mesh.faces, 1, axis=1)).all()
