"""Quality metrics of a result, validated on known answers (docs/metrics.md).

Every finished run is measured with ``measure``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from styleexp.experiments.metrics.shape import content, spike
from styleexp.experiments.metrics.style import (
    Looks,
    judged,
    judged_plain,
    judged_style,
    relief_distance,
    style_distance,
)
from styleexp.inputs import meshes
from styleexp.method.patches import Relief, closest, relief_of_mesh, relief_of_result
from styleexp.method.subject import pattern_unit

if TYPE_CHECKING:
    import torch
    from jaxtyping import Float, Int

    from styleexp.config.schema import Config
    from styleexp.encoders import Encoder
    from styleexp.inputs.style import Style


@dataclass
class Judge:
    """An encoder that measures results, with a cache of measured styles."""

    name: str
    encoder: Encoder
    windows: int = 32
    plain: Looks = field(init=False)
    styles: dict[object, Looks] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.plain = judged_plain(self.encoder)

    def looks(self, config: Config, relief: Relief, unit: float) -> Looks:
        """Features of a result's relief, at positions independent of the run's seed."""
        return judged(relief, unit, self.encoder, self.windows, seed=config.optim.seed)

    def style(self, config: Config, style: Style, unit: float) -> Looks:
        """Features of the style, cached per style and size."""
        picture = style.picture is not None and (unit, config.baseline is None)
        key = (repr(config.style), config.loss.target, picture)
        if key not in self.styles:
            self.styles[key] = judged_style(style, config, self.encoder, unit)
        return self.styles[key]


def judge_name(name: str, trained: str | None) -> str | None:
    """Resolve ``auto`` to an encoder other than ``trained``, the run's own, and ``none`` to
    None."""
    if name == "auto":
        return "vgg16" if trained == "vgg16_edges" else "vgg16_edges"
    return None if name == "none" else name


def load_judge(name: str | None, windows: int, device: str | torch.device = "cpu") -> Judge | None:
    """Load the judge of that name onto the device; downloads its weights if needed."""
    from styleexp.plugins import load_encoder

    if name is None:
        return None
    return Judge(name, load_encoder(name, device=device), windows)


def measure(
    config: Config,
    source: meshes.Mesh,
    style: Style,
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    judge: Judge | None,
) -> dict[str, float]:
    """All metrics of a result in its source's frame; without a judge, only those that don't need
    one.

    ``style_distance`` is 0 for the style itself and 1 for no style at all (``metrics.style``).
    ``relief_distance`` compares without a neural network. ``relief_rms`` is in radii of the
    normalised source, and ``relief_share`` is its ratio to the style mesh's. For the content
    metrics, see ``metrics.shape``.
    """
    unit = pattern_unit(config.style, source, style)
    found: dict[str, float] = {}
    relief = relief_of_result(source, vertices, faces, unit)
    found["relief_rms"] = _rms(relief.height)
    if style.mesh is not None:
        found["relief_share"] = found["relief_rms"] / max(
            unit * _rms(relief_of_mesh(style.mesh).height), 1e-12
        )
    if judge is not None:
        looks = judge.looks(config, relief, unit)
        goal = judge.style(config, style, unit)
        found["style_distance"] = style_distance(looks, goal, judge.plain)
        apart = relief_distance(looks, goal)
        if apart is not None:
            found["relief_distance"] = apart
    return (
        found | content(source, vertices, faces) | {"spike": spike(_moved(source, vertices, faces))}
    )


def _moved(source: meshes.Mesh, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Signed distance of each vertex from its source position or, with other faces, from the
    source's surface."""
    base = source.vertices
    if not np.array_equal(faces, source.faces):
        base, _ = closest(source.vertices, source.faces, vertices)
    return np.linalg.norm(vertices - base, axis=1)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.square(values).mean()))
