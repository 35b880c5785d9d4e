"""What comes of a case of the corpus: the command's own functions, in one process."""

from __future__ import annotations

import contextlib
import copy
import functools
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from tests.helpers.corpus import REFUSED, REPAIRED, WORKS, Case
from tests.helpers.corpus.writers import pixels

OVERRIDES = (
    "method=robust",
    "profile=smoke",
    "encoder=vgg19_random",
    "optim.steps=1",
    "preview.resolution=48",
)


@functools.cache
def _encoder(precision: str, device: str) -> Any:
    from styleexp.config.compose import compose
    from styleexp.plugins.discovery import build  # not the patched one

    options = compose([*OVERRIDES, f"encoder.precision={precision}"]).encoder
    return build("encoder", options, device=device, seed=0)


@contextlib.contextmanager
def one_encoder(precision: str = "auto") -> Iterator[None]:
    """Every scene gets the same random encoder: to make one takes longer than a small run."""
    from styleexp import plugins

    real = plugins.build

    def build(kind: str, options: Any, **given: Any) -> Any:
        if kind == "encoder":
            return _encoder(precision, str(given["device"]))
        return real(kind, options, **given)

    with mock.patch("styleexp.plugins.build", build):
        yield


@functools.cache
def _config(folder: Path) -> Any:
    """A configuration with a small style and a small source."""
    from PIL import Image

    from styleexp.config.compose import compose
    from styleexp.inputs import meshes, shapes

    config = compose(OVERRIDES)
    ball = shapes.make("sphere", detail=300)
    meshes.save_mesh(ball, ball.vertices, folder / "a source.ply")
    Image.fromarray(pixels(128, 128)).save(folder / "a style.png")
    config.source.path = str(folder / "a source.ply")
    config.style.path = str(folder / "a style.png")
    return config


def outcome(case: Case, folder: Path, shared: Path) -> tuple[str, str, Any]:
    """What came of it, what was said, and the result, None where it was refused.

    ``folder`` is empty; ``shared`` keeps what all share. Only `UserError` counts as a refusal.
    """
    from styleexp.config.build import prepare
    from styleexp.system.errors import UserError

    config = copy.deepcopy(_config(shared))
    (config.style if case.style else config.source).path = str(case.write(folder))
    with warnings.catch_warnings(record=True) as caught, one_encoder():
        warnings.simplefilter("always")
        try:
            method, scene = prepare(config)
            state = method.start(scene)
            list(method.optimise(scene, state))
            result = method.finish(scene, state)
            for suffix in ("ply", "obj", "glb"):
                result.save(folder / "out" / f"result.{suffix}")
        except UserError as error:
            return REFUSED, str(error), None
    told = [str(w.message) for w in caught if issubclass(w.category, UserWarning)]
    subject = scene.subject
    repairs = [*subject.source.repairs, *subject.style.repairs]
    notes = [*subject.notes, *scene.notes]
    stated = [*repairs, *(t for t in [*told, *notes] if case.name in t)]
    for repair in repairs:  # the user is told
        assert any(repair in note for note in notes), repair
    return (REPAIRED if stated else WORKS), " | ".join(stated), result


def check(case: Case, folder: Path, shared: Path) -> tuple[str, str]:
    """Fail unless the case comes out as it should; returns what came of it and what was said."""
    found, said, result = outcome(case, folder, shared)
    assert (found, case.says in said) == (case.outcome, True), f"{found}: {said}"
    if result is None:
        assert said.endswith(".")
        assert "\n" not in said.replace(case.name, "")
        assert not (folder / "out").exists()
        return found, said
    assert np.isfinite(result.vertices).all()
    if not case.style:
        from styleexp.inputs.meshes import load_mesh

        source = result.subject.source
        counts = len(source.faces), len(source.vertices)
        assert case.faces in (None, counts[0])
        assert case.vertices in (None, counts[1])
        assert result.vertices.shape == source.vertices.shape
        for suffix in ("ply", "obj", "glb"):
            back = load_mesh(folder / "out" / f"result.{suffix}")
            assert len(back.faces) == counts[0], suffix
    return found, said
