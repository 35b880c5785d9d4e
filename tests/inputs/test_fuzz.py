"""Random meshes, files, overrides and cameras: no other error than one sentence.

A short run with the same examples each time is in CI; `make stress` runs STYLEEXP_FUZZ times as
many, other ones each time. What either finds is added to `corpus.py`, or below as an example.
"""

from __future__ import annotations

import contextlib
import math
import os
import string
import subprocess
import sys
from unittest import mock

import numpy as np
import pytest
import torch

from styleexp.config.checks import check
from styleexp.config.compose import compose
from styleexp.config.explain import explain
from styleexp.config.schema import Config
from styleexp.inputs import meshes
from styleexp.inputs.images import load_image
from styleexp.method.views import look_at, orbit
from styleexp.renderers.base import Shading
from styleexp.renderers.soft_raster import SoftRaster, contour, deferred
from styleexp.system.errors import UserError
from tests.helpers import ROOT
from tests.helpers.corpus.writers import obj, picture, whole_files

hypothesis = pytest.importorskip("hypothesis", reason="hypothesis is not installed")
from hypothesis import HealthCheck, example, given, settings  # noqa: E402
from hypothesis import strategies as st  # noqa: E402

TIMES = int(os.environ.get("STYLEEXP_FUZZ", "1"))
pytestmark = pytest.mark.filterwarnings("ignore")


def examples(count):
    """So many of them; each may take a minute, then it counts as hanging."""
    return settings(
        max_examples=count * TIMES,
        derandomize=TIMES == 1,
        database=None,
        deadline=60_000,
        suppress_health_check=list(HealthCheck),
    )


# ------------------------------------------------------------------------------------- meshes

coordinate = st.one_of(
    st.sampled_from([0.0, 1.0, -1.0, 1e-30, 1e30, -1e7, 1e-7, math.nan, math.inf]),
    st.floats(-10, 10, width=32),
)


@st.composite
def soups(draw):
    """Vertices and polygons that need not fit together."""
    count = draw(st.integers(0, 9))
    points = draw(st.lists(st.tuples(coordinate, coordinate, coordinate), min_size=count,
                           max_size=count))  # fmt: skip
    last = max(count - 1, 0)
    index = st.integers(0, last) if draw(st.booleans()) else st.integers(-3, last + 3)
    sizes = st.integers(3, 3) if draw(st.booleans()) else st.integers(0, 6)
    polygons = draw(st.lists(sizes.flatmap(lambda n: st.tuples(*[index] * n)), max_size=12))
    return np.array(points, dtype=float).reshape(-1, 3), polygons


@examples(100)
@given(soups())
@example((np.eye(3), [(0, 1, 2), (0, 1, 2), (2, 1, 0), (0, 0, 1)]))
def test_random_topology_is_kept_or_refused(tmp_path_factory, soup):
    folder = tmp_path_factory.getbasetemp()
    path = folder / "soup.obj"
    path.write_bytes(obj(*soup))
    try:
        mesh = meshes.load_mesh(path)
    except UserError as told:
        assert str(told).startswith(f"'{path}' ")  # noqa: PT017
        return
    assert len(mesh.faces) == sum(max(len(polygon) - 2, 0) for polygon in soup[1])
    assert np.isfinite(meshes.normalisation(mesh.vertices).apply(mesh.vertices)).all()
    normals = meshes.vertex_normals(mesh.vertices, mesh.faces)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-9)
    for suffix in ("obj", "ply", "glb"):
        out = folder / f"soup.out.{suffix}"
        meshes.save_mesh(mesh, mesh.vertices, out)
        # Single precision may bring a face's corners together, down to nothing being left.
        with contextlib.suppress(UserError) if suffix != "obj" else contextlib.nullcontext():
            assert len(meshes.load_mesh(out).faces) == len(mesh.faces)


# -------------------------------------------------------------------------------------- files

WHOLE = {kind: content if isinstance(content, bytes) else content()
         for kind, content in whole_files().items()}  # fmt: skip
PICTURES = {kind: picture(kind)() for kind in ("PNG", "JPEG", "WEBP", "TIFF", "GIF", "BMP")}

edits = st.lists(
    st.tuples(
        st.sampled_from(["set", "insert", "delete", "repeat", "digits"]),
        st.floats(0, 1, exclude_max=True),
        st.binary(min_size=1, max_size=8),
    ),
    min_size=1,
    max_size=5,
)


def edited(data: bytes, changes) -> bytes:
    for kind, where, new in changes:
        at = int(where * len(data))
        if kind == "set":
            data = data[:at] + new + data[at + len(new) :]
        elif kind == "insert":
            data = data[:at] + new + data[at:]
        elif kind == "delete":
            data = data[:at] + data[at + 8 * len(new) :]
        elif kind == "repeat":
            data = data[:at] + data[max(0, at - 40) : at] * len(new) + data[at:]
        else:  # a number becomes another
            digits = str(int.from_bytes(new, "big")).encode()
            begin = next((k for k in range(at, len(data)) if data[k : k + 1].isdigit()), at)
            end = next((k for k in range(begin, len(data)) if not data[k : k + 1].isdigit()), begin)
            data = data[:begin] + digits + data[end:]
    return data


@pytest.mark.parametrize("kind", WHOLE)
def test_mutated_meshes_are_read_or_refused(kind, tmp_path):
    path = tmp_path / f"mutated.{kind}"

    @examples(30)
    @given(edits)
    def attempt(changes):
        path.write_bytes(edited(WHOLE[kind], changes))
        with contextlib.suppress(UserError):
            mesh = meshes.load_mesh(path)
            assert np.isfinite(mesh.vertices).all()
            assert mesh.faces.min() >= 0
            assert mesh.faces.max() < len(mesh.vertices)

    attempt()


@pytest.mark.parametrize("kind", PICTURES)
def test_mutated_pictures_are_read_or_refused(kind, tmp_path):
    path = tmp_path / "mutated.png"

    @examples(30)
    @given(edits)
    def attempt(changes):
        path.write_bytes(edited(PICTURES[kind], changes))
        with contextlib.suppress(UserError):
            pixels = load_image(path)
            assert pixels.min() >= 0
            assert pixels.max() <= 1

    attempt()


# ---------------------------------------------------------------------------------- overrides


def _keys(value, prefix=""):
    import dataclasses

    for each in dataclasses.fields(value):
        inner = getattr(value, each.name)
        yield prefix + each.name
        if dataclasses.is_dataclass(inner):
            yield from _keys(inner, f"{prefix}{each.name}.")


values = st.one_of(
    st.integers(-5, 5).map(str),
    st.sampled_from([str(10**n) for n in (4, 9, 20)]),
    st.floats(allow_nan=True).map(str),
    st.sampled_from(["null", "true", "''", "[]", "{}", "[1,2", "a b", "${x}", "${oc.env:HOME}",
                     "critter", "bubble", "flat", "1e400", "-0.0", "[conv1_1]", "{a:1}"]),
    st.text(string.printable, max_size=6),
)  # fmt: skip
overrides = st.lists(
    st.one_of(
        st.tuples(st.sampled_from(sorted(_keys(Config()))), values).map("=".join),
        st.text(string.printable, min_size=1, max_size=12),
    ),
    min_size=1,
    max_size=3,
)


@examples(30)
@given(overrides)
@example(["strength=nan"])
@example(["views.count=1000000000"])
@example(["loss.lambda_global=inf"])
@example(["+hydra.callbacks.x._target_=os.system"])
def test_random_overrides_make_a_configuration_or_one_sentence(chosen):
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    try:
        config = compose(["method=robust", "profile=smoke", *chosen])
        check(config)
    except UserError as told:
        assert str(told)  # noqa: PT017
    except (HydraException, OmegaConfBaseException) as error:
        assert explain(error)  # noqa: PT017
    else:
        assert math.isfinite(config.strength)
        assert config.views.count <= 4096


# ----------------------------------------------------------------------------------- renderer


@st.composite
def renders(draw):
    """A mesh whose corners may lie a billion radii away, cameras in, on and around it, a size."""
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**31)))
    count, faces = draw(st.integers(0, 30)), draw(st.integers(0, 60))
    vertices = torch.randn(max(count, 1), 3, generator=generator)
    far = torch.rand(len(vertices), generator=generator) < draw(st.floats(0, 1))
    vertices[far] *= 10.0 ** draw(st.integers(-9, 9))
    if draw(st.booleans()):
        vertices = vertices.round()  # coincident, collinear, right on pixels' edges
    index = torch.randint(len(vertices), (faces, 3), generator=generator)
    views = draw(st.integers(1, 4))
    eyes = torch.randn(views, 3, generator=generator)
    eyes = eyes / eyes.norm(dim=1, keepdim=True) * draw(st.sampled_from([0.01, 0.5, 2.0, 1e3]))
    cameras = look_at(eyes, torch.zeros_like(eyes), draw(st.sampled_from([0.1, 20.0, 60.0, 170.0])))
    size = draw(st.integers(1, 40)), draw(st.integers(1, 40))
    shading = Shading(normals=draw(st.sampled_from(["flat", "smooth"])),
                      outlines=draw(st.booleans()))  # fmt: skip
    return vertices, index, cameras, shading, size


@examples(100)
@given(renders())
def test_any_render_is_finite(scene):
    vertices, faces, cameras, shading, size = scene
    vertices.requires_grad_()
    out = SoftRaster().render(vertices, faces, cameras, shading, size)
    assert out.image.shape == (len(cameras), *size, 1)
    for values in (out.image, out.coverage):
        assert torch.isfinite(values).all()
        assert values.min() >= 0
        assert values.max() <= 1
    assert (out.depth > 0).all()  # inf on the background, never NaN
    (gradient,) = torch.autograd.grad(out.image.square().sum() + out.coverage.sum(), vertices)
    assert torch.isfinite(gradient).all()


def test_coordinates_near_the_end_of_float32_raise_nothing():
    generator = torch.Generator().manual_seed(0)
    eyes = torch.eye(3)[:2] * 2
    for power in (12, 18, 30, 38):
        vertices = torch.randn(30, 3, generator=generator) * 10.0**power
        faces = torch.randint(30, (60, 3), generator=generator)
        cameras = look_at(eyes, torch.zeros_like(eyes), 60.0)
        out = SoftRaster().render(vertices, faces, cameras, Shading(), (33, 40))
        assert not torch.isnan(out.depth).any()


@examples(60)
@given(
    st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.floats(1e-3, 1e3),
    st.sampled_from([-90.0, -85.0, -80.0, 80.0, 85.0, 90.0, None]),
)  # fmt: skip
def test_cameras_have_a_frame_everywhere_poles_included(elevation, azimuth, distance, pole):
    angles = torch.tensor([elevation if pole is None else math.radians(pole)])
    cameras = orbit(angles, torch.tensor([azimuth]), distance, 60.0)
    product = cameras.rotation @ cameras.rotation.transpose(1, 2)
    torch.testing.assert_close(product, torch.eye(3)[None], atol=1e-5, rtol=0)
    assert torch.linalg.det(cameras.rotation)[0] > 0.99
    # The origin lies ahead, in the middle.
    torch.testing.assert_close(cameras.translation[0, :2] / distance, torch.zeros(2), atol=1e-4,
                               rtol=0)  # fmt: skip


# ------------------------------------------------------------------------------------- memory


def pile(count):
    """One triangle that fills the screen, again and again, and slivers through all of it."""
    generator = torch.Generator().manual_seed(0)
    angle = torch.rand(count, generator=generator) * math.pi
    ray = 5 * torch.stack([angle.cos(), angle.sin(), 0 * angle], 1)
    whole = torch.tensor([[-9.0, -9, 0], [9, -9, 0], [0, 9, 0]])
    vertices = torch.cat([whole, ray, -ray, 0.01 - ray])
    slivers = torch.arange(count)[:, None] + torch.tensor([3, 3 + count, 3 + 2 * count])
    return vertices, torch.cat([torch.tensor([[0, 1, 2]] * (count // 4)), slivers])


def views(count):
    generator = torch.Generator().manual_seed(1)
    around = torch.rand(2, count, generator=generator)
    return orbit(around[0] - 0.5, 6 * around[1], 2.0, 60.0)


def test_bounds_on_memory_change_no_bit():
    vertices, faces = pile(60)
    light = torch.rand(6, 3, generator=torch.Generator().manual_seed(2))

    def render():
        out = SoftRaster().render(vertices, faces, views(6), Shading(light=light), (48, 40))
        return out.image, out.coverage, out.face_ids, out.depth

    whole = render()
    with (
        mock.patch.object(contour, "MOST_CROSSINGS", 50),
        mock.patch.object(contour, "chunks", lambda counts: [7] * (len(counts) // 7 + 1)),
        mock.patch.dict(deferred.MOST_PAIRS, cpu=2 * len(faces)),
    ):
        for one, other in zip(render(), whole, strict=True):
            assert torch.equal(one, other)


MEASURE = """
import resource
import torch
from tests.inputs.test_fuzz import pile, views
from styleexp.testing import rendering
from styleexp.testing import renderers as testing
from styleexp.renderers.base import Shading
from styleexp.renderers.soft_raster import SoftRaster
vertices, faces = {mesh}
def peak(): return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
with torch.no_grad():
    SoftRaster().render(*pile(4), views(1), Shading(), (8, 8))
    before = peak()
    SoftRaster().render(vertices, faces, views({views}), Shading(), ({size}, {size}))
print(peak() - before)
"""
MOST_MEGABYTES = 500
"""What a render without gradients may take, however many views there are and however large its
triangles, as long as one view's faces are below `deferred.MOST_PAIRS`."""


@pytest.mark.parametrize(
    ("mesh", "count", "size"),
    [("pile(1500)", 12, 64), ("rendering.icosphere(6)", 384, 9)],
    ids=["huge triangles", "many views"],
)
def test_memory_is_bounded(mesh, count, size):
    code = MEASURE.format(mesh=mesh, views=count, size=size)
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert float(done.stdout) < MOST_MEGABYTES
