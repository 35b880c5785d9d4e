"""What is told about a result that is to be printed."""

import numpy as np
import pytest
import trimesh

from styleexp.runs import prints


def tube(inner, outer):
    made = trimesh.creation.annulus(inner, outer, height=40, sections=256)
    return np.asarray(made.vertices), np.asarray(made.faces)


def test_the_thickness_is_that_of_a_wall():
    pytest.importorskip("embreex", reason="embreex is not installed (extra bake)")
    vertices, faces = tube(9.0, 11.0)
    depth, places = prints.thickness(vertices, faces)
    side = np.abs(places[:, 2]) < 15
    assert np.median(depth[side]) == pytest.approx(2.0, abs=0.05)
    closed, told = prints.notes("the result", vertices, faces)
    assert closed == "the result is watertight"
    assert "1 % of its surface is thinner than 2 units" in told or "than 1.9" in told
    # Another frame and unit, the same wall.
    moved, _ = prints.thickness(1000 * vertices + 5e4, faces)
    assert np.median(moved) == pytest.approx(1000 * np.median(depth), rel=0.02)


@pytest.mark.parametrize(
    ("fault", "told"),
    [
        ("hole", "open edges: 3"),
        ("fin", "more than two faces: 1"),
        ("turned", "wound against each other: 3"),
    ],
)
def test_what_is_not_watertight_is_counted(fault, told):
    vertices, faces = tube(9.0, 11.0)
    if fault == "hole":
        faces = faces[1:]
    elif fault == "fin":
        vertices = np.concatenate([vertices, [[50.0, 0, 0]]])
        faces = np.concatenate([faces, [[*faces[0, :2], len(vertices) - 1]]])
    else:
        faces = np.concatenate([faces[:1, ::-1], faces[1:]])
    assert told in prints._closed("it", faces)
