"""Style pictures as heights: photographs, height maps, normal maps."""

from __future__ import annotations

import math

import numpy as np
import pytest
from PIL import Image

import styleexp
from styleexp.config import build, sources
from styleexp.config.compose import compose
from styleexp.method import pictures
from styleexp.method.options import StyleConfig
from styleexp.method.pictures import picture_side
from styleexp.system.errors import UserError

MAP = ("method=displacement_map", "source.refine=none")


def heights_of(picture, **style):
    return pictures.picture_height(StyleConfig(name="picture", **style), picture)


def bumps(size=96, waves=3.0):
    """Heights in pixels that tile where ``waves`` is whole."""
    y, x = np.mgrid[0:size, 0:size] * (2 * np.pi * waves / size)
    return 2.5 * np.sin(x) * np.cos(2 * y) + 1.5 * np.cos(x + y)


def normal_map(height, green=1.0):
    """Its normals as 8-bit colours, green up."""
    down, right = np.gradient(np.pad(height, 1, mode="reflect"))
    down, right = down[1:-1, 1:-1], right[1:-1, 1:-1]
    normals = np.stack([-right, green * down, np.ones_like(down)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return ((normals + 1) * 127.5).round().astype(np.uint8).astype(np.float32) / 255


def grey(height):
    return np.repeat(height.astype(np.float32)[..., None], 3, axis=2)


@pytest.mark.parametrize("waves", [3.0, 2.6])
@pytest.mark.parametrize(("kind", "green"), [("normal", 1), ("normal_dx", -1), ("auto", -1)])
def test_a_normal_map_gives_its_height_back_in_proportion(waves, kind, green):
    height = bumps(waves=waves)
    found = heights_of(normal_map(height, green), kind=kind)
    assert found.kind == ("normal" if kind == "normal" else "normal_dx")
    assert found.in_proportion
    expected = (height - height.mean()) / 96
    error = found.height.numpy() - found.height.numpy().mean() - expected
    inside = np.s_[6:-6, 6:-6]
    assert np.abs(error[inside]).max() < 0.06 * np.ptp(expected)


def test_solved_as_periodic_a_map_that_tiles_still_does():
    found = heights_of(normal_map(bumps()), kind="normal").height.numpy()
    seam = np.abs(found[:, 0] - found[:, -1]).max()
    assert seam < 1.5 * np.abs(np.diff(found, axis=1)).max()


def test_a_height_maps_range_is_the_depth_and_inverting_turns_it_over():
    ramp = grey(np.tile(np.linspace(0, 1, 32), (32, 1)))
    assert np.ptp(heights_of(ramp, kind="height").height.numpy()) == pytest.approx(0.1)
    deep = heights_of(ramp, kind="height", image_depth=0.25, invert=True).height.numpy()
    assert deep[0, 0] - deep[0, -1] == pytest.approx(0.25)
    photo = heights_of(ramp)
    assert photo.kind == "photo"
    assert not photo.in_proportion


@pytest.mark.parametrize("kind", ["height", "normal"])
def test_the_relief_is_as_deep_on_the_source_as_in_the_picture(kind, tmp_path):
    # Waves wide enough for the sphere's edges, 4 % of the picture's side deep.
    size = 128
    y, x = np.mgrid[0:size, 0:size] * (2 * np.pi * 3 / size)
    height = 0.02 * size * np.sin(x) * np.sin(y)
    if kind == "height":
        values = ((height / size / 0.1 + 0.5) * 65535).round().astype(np.uint16)
        Image.fromarray(values).save(tmp_path / "a.png")
    else:
        colors = (normal_map(height) * 255).round().astype(np.uint8)
        Image.fromarray(colors).save(tmp_path / "a.png")
    for scale in (1.0, 0.5):
        tiled = (f"style.image_tile={0.7 * scale}", f"style.kind={kind}")
        result = styleexp.stylize("sphere", tmp_path / "a.png", *MAP, *tiled)
        side = (
            picture_side(result.subject.settings.style, result.subject.unit)
            * result.subject.frame.scale
        )
        low, high = np.percentile(result.displacement, [0.1, 99.9])
        assert high - low == pytest.approx(0.04 * side, rel=0.2)


def test_synthesis_takes_the_same_heights():
    from styleexp.method.synthesis.method import exemplar_of_style

    picture = grey(0.5 + 0.2 * np.sin(np.mgrid[0:64, 0:64][1] * (2 * np.pi / 16)))
    config = compose(
        [
            "source=sphere",
            "style=bubble",
            "method=synthesis",
            "source.refine=none",
            "style.kind=height",
            "style.image_depth=0.05",
            "style.image_tile=0.5",
        ]
    )
    with sources.given(style=picture):
        subject = build.subject_of(config)
    exemplar = exemplar_of_style(subject)
    depth = np.ptp(exemplar.height.numpy())
    assert depth == pytest.approx(0.4 * 0.05 * 0.5 * math.sqrt(4 * math.pi), rel=0.1)


@pytest.mark.parametrize(
    ("picture", "options", "told"),
    [
        (grey(bumps() / 10 + 0.5), ("style.kind=normal",), "is not a tangent-space normal map"),
        (grey(bumps() / 10 + 0.5), ("style.image_depth=0.2",), "only applies to style.kind=height"),
        (grey(np.full((32, 32), 0.5)), ("style.kind=height",), "a picture of uniform tone"),
        ("bubble", ("style.invert=true",), "style.invert=true only applies to pictures"),
        ("bubble", ("style.kind=sketch",), "style.kind"),
        (grey(bumps() / 10 + 0.5), ("style.kind=height", "method=robust"), "add method=synthesis"),
    ],
)
def test_what_can_not_be_read_so_is_said_in_one_sentence(picture, options, told):
    with pytest.raises(UserError, match=told):
        styleexp.stylize("sphere", picture, *MAP, *options)


def test_a_normal_map_is_told_of_and_only_heights_are_read_of_it():
    colors = normal_map(bumps())
    for method, told in (("displacement_map", "green up"), ("robust", "read as tone")):
        with sources.given(style=colors):
            config = compose([f"method={method}", "source=sphere", "style=bubble"])
            subject = build.subject_of(config)
        assert any(told in note for note in subject.notes), subject.notes
