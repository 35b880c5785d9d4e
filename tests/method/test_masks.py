"""style.mask: where the relief goes."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

import styleexp
from styleexp.config import build, sources
from styleexp.config.compose import compose
from styleexp.config.overrides import understood
from styleexp.inputs import meshes
from styleexp.method import masks
from styleexp.method.options import StyleConfig
from styleexp.method.synthesis.method import begin, directions
from styleexp.runs import identity, origins
from styleexp.system.errors import UserError
from tests.helpers import warm

MAP = ("method=displacement_map", "source.refine=none")
CHEAP = ("method=synthesis", "baseline.bank=500", "source.refine=none")


def mask_of(mesh, mask, falloff=0.0):
    return masks.weights(StyleConfig(mask=mask, falloff=falloff), mesh)


def painted_ball(**attributes):
    ball = trimesh.creation.icosphere(4)
    ball.vertex_attributes |= {name: f(ball.vertices) for name, f in attributes.items()}
    return ball


def right(vertices):
    return (vertices[:, 0] > 0).astype(np.float32)


@pytest.fixture(scope="module")
def ball():
    return meshes.from_memory(painted_ball(right=right), "source")


@pytest.fixture(scope="module")
def unwrapped():
    """A grid over the unit square, u to the right and v up, its left half red."""
    across = np.linspace(0, 1, 33)
    x, y = np.meshgrid(across, across)
    number = np.arange(x.size).reshape(x.shape)
    a, b, c, d = (number[i, j].ravel() for i, j in np.ndindex(2, 2) for i, j in [
        (slice(i, 32 + i), slice(j, 32 + j))])  # fmt: skip
    faces = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])
    points = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1)
    mesh = meshes.from_arrays(points, faces)
    colors = np.full((len(points), 4), 255, np.uint8)
    colors[:, 1:3] = np.where(points[:, :1] < 0.5, 0, 255)
    carrier = meshes.mesh.Carrier(
        mesh.faces,
        np.arange(len(points)),
        np.zeros(len(faces), bool),
        uv=points[:, :2],
        colors=colors,
    )
    return meshes.Mesh("grid", mesh.vertices, mesh.faces, (), carrier)


def test_each_kind_selects_what_it_says(ball, unwrapped, tmp_path):
    x, y = ball.vertices[:, 0], ball.vertices[:, 1]
    assert (mask_of(ball, "attribute:right") == (x > 0)).all()
    assert (mask_of(ball, "not:attribute:right") == (x <= 0)).all()
    assert (mask_of(ball, "height:0.5..1") == (y >= 0)).all()
    slope = mask_of(ball, "slope:60") > 0
    assert slope[y > 0.52].all()
    assert not slope[y < 0.48].any()
    both = mask_of(ball, ["attribute:right", "height:0.5..1"])
    assert (both == ((x > 0) & (y >= 0))).all()
    near = mask_of(ball, "near:1/0/0/0.5+-1/0/0/2.5e-1")
    ends = [np.linalg.norm(ball.vertices - [side, 0, 0], axis=1) for side in (1, -1)]
    assert (near == ((ends[0] <= 0.5) | (ends[1] <= 0.25))).all()
    left = unwrapped.vertices[:, 0] < 0.5
    assert (mask_of(unwrapped, "not:color:b") == left).all()
    assert mask_of(unwrapped, "color:luminance")[left] == pytest.approx(0.299, abs=1e-6)
    picture = np.zeros((32, 64), np.uint8)
    picture[:8] = 255  # the upper quarter
    Image.fromarray(picture).save(tmp_path / "upper.png")
    upper = mask_of(unwrapped, f"texture:{tmp_path / 'upper.png'}")
    v = unwrapped.vertices[:, 1]
    assert (upper[v > 0.77] == 1).all()
    assert (upper[v < 0.73] == 0).all()


def test_a_border_is_as_wide_as_it_is_said_and_the_rest_fills_up(ball):
    soft = mask_of(ball, "attribute:right", 0.3)
    x = ball.vertices[:, 0]
    assert (soft[x < -0.2] == 0).all()
    assert (soft[x > 0.2] == 1).all()
    border = soft[np.abs(x) < 0.1]
    assert ((border > 0) & (border < 1)).mean() > 0.9
    rest = mask_of(ball, "not:attribute:right", 0.3)
    assert np.abs(soft + rest - 1).max() < 1e-12


def test_a_thin_parts_other_side_is_not_in_the_border():
    box = trimesh.creation.box([2, 0.02, 2]).subdivide_loop(0)
    for _ in range(5):
        box = box.subdivide()
    mesh = meshes.from_arrays(box.vertices, box.faces)
    soft = mask_of(mesh, "slope:30", 0.2)
    inside = np.abs(mesh.vertices[:, [0, 2]]).max(axis=1) < 0.9
    assert (soft[inside & (mesh.vertices[:, 1] < 0)] == 0).all()
    assert (soft[inside & (mesh.vertices[:, 1] > 0)] == 1).all()


@pytest.mark.slow
@pytest.mark.parametrize("options", [MAP, CHEAP])
def test_beyond_the_mask_no_bit_moves_and_within_it_the_mean_is_zero(options):
    given = painted_ball(right=right)
    result = styleexp.stylize(given, "bubble", *options, "style.mask=attribute:right")
    source, mask = result.subject.source, result.subject.mask.numpy()
    assert (result.vertices[mask == 0] == source.vertices[mask == 0]).all()
    assert (mask == 0).mean() > 0.4
    moved = result.displacement * result.subject.areas.numpy()
    assert result.displacement[mask == 1].std() > 0.005
    assert abs(moved.sum()) < 0.02 * np.abs(moved).sum()  # where no face turned over, 0


@pytest.mark.slow
def test_the_learned_field_keeps_within_the_mask():
    from types import SimpleNamespace

    from styleexp.method.base import State
    from styleexp.method.paper import displace

    config = compose(["source=sphere", "style=bubble", "style.mask=height:0.5..1"])
    subject = build.subject_of(config)
    scene = SimpleNamespace(subject=subject, base=torch.ones(len(subject.areas)) * 0.01)

    def field(points, opened, precision):
        return 0.01 * torch.sin(9 * points[:, 0])

    moved = displace(scene, State(field, None), torch.float32)
    assert (moved[subject.mask == 0] == 0).all()
    assert moved.abs().max() > 0.005
    assert abs(float((moved * subject.areas).sum())) < 1e-4


@pytest.mark.slow
def test_two_runs_with_the_two_halves_put_two_styles_on_one_mesh(tmp_path):
    painted_ball(right=right).export(tmp_path / "ball.ply")
    first = styleexp.stylize(tmp_path / "ball.ply", "stripe", *MAP, "style.mask=attribute:right")
    first.save(tmp_path / "first.ply")
    rest = (*MAP, "style.mask=not:attribute:right")
    second = styleexp.stylize(tmp_path / "first.ply", "bubble", *rest)
    mask = first.subject.mask.numpy()
    assert (second.vertices[mask == 1] == second.subject.source.vertices[mask == 1]).all()
    assert np.abs(second.vertices[mask == 1] - first.vertices[mask == 1]).max() < 1e-6
    alone = styleexp.stylize(tmp_path / "ball.ply", "bubble", *rest)
    there = mask == 0
    alike = np.corrcoef(second.displacement[there], alone.displacement[there])[0, 1]
    assert alike > 0.95


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("style.mask=north",), "style.mask=north is not a mask: give attribute:NAME, color:"),
        (("style.mask=slope:steep",), "give slope: and 0 to 180 degrees"),
        (("style.mask=height:0.7..0.2",), "give height:LOW..HIGH"),
        (("style.mask=near:0/1/0",), "give near:X/Y/Z/RADIUS"),
        (("style.mask=near:0/1/0/0.1+0/1/0/-1",), "the radius above 0"),
        (("style.mask=near:9/9/9/1",), "selects no vertex"),
        (("style.mask=color:red",), "give color:r|g|b|a|luminance"),
        (("style.mask=attribute:left",), "has no such vertex attribute; it has 'right'"),
        (("style.mask=color:r",), "has no vertex colours"),
        (("style.mask=texture:no.png",), "has no texture coordinates"),
        (("style.mask=[slope:20,not:slope:30]",), "slope:20, not:slope:30 selects no vertex"),
        (("style.mask=attribute:right", "source.remesh=9000"), "is lost with source.remesh"),
        (("style.mask=slope:30", "method=geometric_textures"), "remeshes the result"),
        (("style.direction=attribute:left", "method=synthesis"), "it has 'right'"),
        (("style.direction=attribute:right", "method=synthesis"), "a vector (three numbers)"),
        (("style.direction=flow",), "style.direction=flow needs method=synthesis"),
    ],
)
def test_what_is_no_mask_of_this_source_is_said_in_one_sentence(options, told):
    with pytest.raises(UserError) as caught:
        styleexp.stylize(painted_ball(right=right), "bubble", *MAP, *options)
    assert told in str(caught.value)


def test_values_that_are_no_shares_are_refused():
    given = painted_ball(paint=lambda v: 255 * right(v))
    with pytest.raises(UserError, match="range from 0 to 255, but a mask must be in 0 to 1"):
        styleexp.stylize(given, "bubble", *MAP, "style.mask=attribute:paint")


@pytest.mark.slow
def test_a_masks_picture_is_a_file_of_the_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    mask = "style.mask=not:texture:a picture, really.png"
    words = ["sphere", "bubble", *MAP, "hydra.run.dir=out", mask]
    asked = warm.run("-m", "styleexp", *words)
    assert asked.returncode != 0
    assert "the mask 'a picture, really.png' does not exist" in asked.stderr
    assert not (tmp_path / "out").exists()

    picture = tmp_path / "a picture, really.png"
    picture.write_bytes(b"one")
    config = compose(["source=sphere", "style=bubble", *understood([mask])])
    key = identity.job_key(config)
    record = {"config": asdict(config), "assets": origins.describe(config)}
    assert record["assets"]["mask"]["path"] == str(picture)
    monkeypatch.chdir("/")
    again = origins.restored(record, tmp_path, "resume")
    assert again.style.mask == f"not:texture:{picture}"
    picture.write_bytes(b"another")
    assert identity.job_key(again) != key
    with pytest.raises(UserError, match=r"its mask .* has changed since the run began"):
        origins.restored(record, tmp_path, "resume")


def test_paths_of_pictures_are_replaced_in_their_order():
    mask = ["not:texture:a.png", "slope:30", "texture:b.png"]
    assert masks.files(mask) == ["a.png", "b.png"]
    assert masks.with_files(mask, ["/x/a", "/x/b"]) == [
        "not:texture:/x/a",
        "slope:30",
        "texture:/x/b",
    ]
    assert masks.with_files("slope:3", []) == "slope:3"
    assert masks.with_files(None, []) is None


@pytest.mark.slow
def test_a_direction_of_the_file_is_followed_and_turned():
    def around(vertices):  # the x axis
        return 3 * np.cross([1.0, 0.0, 0.0], vertices).astype(np.float32)

    given = meshes.from_memory(painted_ball(way=around), "source")
    ahead = []
    for rotation in (0, 90):
        options = ("method=synthesis", "source.refine=none", "source=sphere", "style=stripe")
        asked = ("style.direction=attribute:way", f"style.rotation={rotation}")
        with sources.given(source=given):
            subject = build.subject_of(compose([*options, *asked]))
        begun = begin(subject)
        ahead.append(directions(subject, begun))
    sheet = begun.sheet
    wish = around(sheet.vertices)
    wish /= np.linalg.norm(wish, axis=1, keepdims=True).clip(1e-9)
    there = np.abs(sheet.vertices[:, 0]) < 0.9
    assert (wish * ahead[0]).sum(1)[there].min() > 0.98
    assert np.abs((wish * ahead[1]).sum(1)[there]).max() < 0.2


def test_a_gltfs_attributes_are_turned_as_its_node(tmp_path):
    given = trimesh.creation.icosphere(1)
    given.vertex_attributes["_way"] = np.tile(np.float32([1, 0, 0]), (len(given.vertices), 1))
    turn = trimesh.transformations.rotation_matrix(np.pi / 2, [0, 0, 1])
    whole = trimesh.Scene()
    whole.add_geometry(given, transform=turn)
    whole.export(tmp_path / "ball.glb")
    read = meshes.load_mesh(tmp_path / "ball.glb")
    assert np.allclose(read.carrier.attributes["way"], [0, 1, 0], atol=1e-6)
