"""Checks of `method.base.Method`: ``check_method(make)``.

``make()`` returns the method, as a plugin's factory does with its options. The checks run it on a
torus of 600 vertices with the style ``bubble``.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from styleexp.inputs import shapes
from styleexp.inputs.style import Style
from styleexp.method.base import Method, Result
from styleexp.method.options import LocalViewsConfig, OptimConfig, Settings, ViewsConfig
from styleexp.method.subject import measure
from styleexp.runs.records import RunFolder
from styleexp.testing import checks

Make = Callable[[], Method[Any]]
STEPS = 3


def _settings(**changed: Any) -> Settings:
    local = LocalViewsConfig(per_view=2, size=64)
    views = ViewsConfig(count=2, resolution=96, local=local)
    settings = Settings(optim=OptimConfig(steps=STEPS), views=views)
    for key, value in changed.items():
        setattr(settings, key, value)
    return settings


def _prepared(method: Method[Any], settings: Settings) -> Any:
    source, style = shapes.make("torus", 600), Style.of(shapes.make("bubble", 2000))
    separate = method.separates_relief
    subject = measure(settings, source, style, torch.device("cpu"), separate=separate)
    return method.prepare(subject)


def _run(make: Make, settings: Settings) -> Result:
    method = make()
    scene = _prepared(method, settings)
    state = method.start(scene)
    if state is not None:
        for _ in method.optimise(scene, state):
            pass
    return method.finish(scene, state)


def it_returns_a_mesh(make: Make) -> None:
    """The result has finite vertices and displacements, one for each vertex of its source."""
    method = make()
    assert isinstance(method, Method), f"{type(method).__name__} is not a Method"
    result = _run(make, _settings())
    assert np.isfinite(result.vertices).all(), "vertices that are not finite"
    assert np.isfinite(result.displacement).all(), "displacements that are not finite"
    assert result.vertices.shape == (len(result.displacement), 3)
    assert result.subject.source.vertices.shape == result.vertices.shape
    assert 0 <= result.faces.min() <= result.faces.max() < len(result.vertices)


def equal_seeds_give_equal_results(make: Make) -> None:
    """Two runs give the same bits."""
    one, other = _run(make, _settings()), _run(make, _settings())
    assert np.array_equal(one.vertices, other.vertices)


def no_strength_is_no_displacement(make: Make) -> None:
    """``strength=0`` returns the source."""
    result = _run(make, _settings(strength=0.0))
    assert np.array_equal(result.vertices, result.subject.source.vertices)


def nothing_moves_outside_the_mask(make: Make) -> None:
    """Where ``style.mask`` is 0, no bit of the source changes."""
    settings = _settings()
    settings.style = replace(settings.style, mask="height:0.5..1", falloff=0.0)
    result = _run(make, settings)
    subject = result.subject
    assert subject.mask is not None
    if len(subject.mask) != len(result.vertices):
        raise checks.NotApplicable("it has faces of its own")
    outside = subject.mask.numpy() == 0
    assert outside.any()
    assert np.array_equal(result.vertices[outside], subject.source.vertices[outside])


def every_step_counts_and_can_be_resumed(make: Make) -> None:
    """``optimise`` yields ``optim.steps`` steps with ``step``, ``loss`` and ``seconds``. Going on
    from a checkpoint gives the bits of a run without interruption."""
    method, settings = make(), _settings()
    scene = _prepared(method, settings)
    state = method.start(scene)
    if state is None:
        raise checks.NotApplicable("it has no steps")
    steps = []
    with tempfile.TemporaryDirectory() as name:
        folder = RunFolder(Path(name))  # the checkpoint is a run's own
        for step in method.optimise(scene, state):
            steps.append(step)
            assert state.step == step.step, "state.step isn't counted before the step is yielded"
            if step.step == 1:
                folder.save_checkpoint(state)
        assert [step.step for step in steps] == [1, 2, 3], "steps aren't counted from 1"
        assert all(np.isfinite([step.loss, step.seconds]).all() for step in steps)
        whole = method.finish(scene, state)

        again = make()
        scene = _prepared(again, settings)
        resumed = again.start(scene)
        assert resumed is not None
        assert folder.load_checkpoint(resumed) is None, "its checkpoint can't be read back"
    assert resumed.step == 1
    assert [step.step for step in again.optimise(scene, resumed)] == [2, 3]
    assert np.array_equal(again.finish(scene, resumed).vertices, whole.vertices)


CHECKS: tuple[Callable[[Make], None], ...] = (
    it_returns_a_mesh,
    equal_seeds_give_equal_results,
    no_strength_is_no_displacement,
    nothing_moves_outside_the_mask,
    every_step_counts_and_can_be_resumed,
)


def check_method(make: Make) -> dict[str, str]:
    """Run every check; see `checks.run`."""
    return checks.run(CHECKS, make)
