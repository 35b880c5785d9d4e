"""Quality metrics of a result, validated on known answers (docs/metrics.md).

Every finished run is measured with ``measure``.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import torch
from scipy.spatial import cKDTree

from styleexp.experiments import ratings
from styleexp.experiments.metrics.likeness import Bank, bank_of, likeness
from styleexp.experiments.metrics.shape import bend, content
from styleexp.experiments.metrics.style import (
    Looks,
    judged,
    judged_plain,
    judged_style,
    relief_distance,
    style_distance,
)
from styleexp.inputs import meshes
from styleexp.method import masks
from styleexp.method.patches import Relief, closest, relief_of_mesh, relief_of_result
from styleexp.method.pattern_size import pattern_unit
from styleexp.method.subject import Subject
from styleexp.method.subject import measure as measure_subject
from styleexp.method.synthesis.method import exemplar_of_style
from styleexp.method.synthesis.walk import Sheet

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


def load_judge(name: str | None, windows: int, device: str | torch.device = "cpu") -> Judge | None:
    """Load the judge of that name onto the device; downloads its weights if needed."""
    from styleexp.plugins import load_encoder

    if name is None:
        return None
    return Judge(name, load_encoder(name, device=device), windows)


Banks: TypeAlias = "dict[object, Bank | None]"
"""Patches of the styles measured so far; None for one without relief."""


def measure(
    config: Config,
    source: meshes.Mesh,
    style: Style,
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    judge: Judge | None,
    banks: Banks | None = None,
    subject: Subject | None = None,
) -> dict[str, float]:
    """All metrics of a result in its source's frame; without a judge, only those that don't need
    one. ``banks`` keeps the styles' patches for the next call; ``subject`` is the run's, if it is
    at hand, whose style needn't be measured again.

    ``match`` and ``craft`` estimate ratings from 1 to 5 (`ratings`). ``likeness``, 0 to 1, is how
    much of the style the surface carries, and ``order`` how far the style repeats itself;
    ``coverage`` is the share of the surface that carries at least half of the style, of all and of
    five regions (`metrics.likeness`); with ``style.mask``, of the part that it selects, the share
    ``masked`` of the surface. ``style_distance`` is 0 for the style itself and 1 for no
    style at all (`metrics.style`). ``relief_distance`` compares without a neural network.
    ``relief_rms`` is in radii of the normalised source, and ``relief_share`` is its ratio to the
    style mesh's. For the content metrics, see `metrics.shape`.
    """
    unit = pattern_unit(config.style, source, style)
    found: dict[str, float] = {}
    relief = relief_of_result(source, vertices, faces, unit)
    bank = bank_for(config, source, style, {} if banks is None else banks, subject)
    if bank is not None:
        base = raised(source, vertices, faces)
        mask = mask_on(config, source, base)
        local = likeness(bank, base, unit, mask=mask)
        if mask is not None:
            found["masked"] = float(np.average(mask, weights=Sheet(base.base, faces).areas))
        found |= {"likeness": float(local.carried.mean()), "order": bank.order}
        found["coverage"] = local.coverage
        found |= {f"coverage_{where}": share for where, share in local.by_region().items()}
    shape = content(source, vertices, faces) | {"bend": bend(vertices, faces)}
    found["craft"] = ratings.craft(shape["silhouette_iou"], shape["bend"])
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
            if bank is not None:
                found["match"] = ratings.match(found)
    return found | shape


def bank_for(
    config: Config,
    source: meshes.Mesh,
    style: Style,
    banks: Banks,
    subject: Subject | None = None,
) -> Bank | None:
    """The style's patches, from ``banks`` if they are there; None for a style without relief. A
    ``subject`` is used if its style mesh's relief was separated, or its style is a picture."""
    unit = pattern_unit(config.style, source, style)
    key = (repr(config.style), config.baseline is None, None if style.mesh else unit)
    if key not in banks:
        known = subject is not None and (style.mesh is None or subject.example is not None)
        if subject is None or not known:
            subject = style_subject(config, source, style)
        banks[key] = None if subject.smooth else bank_of(exemplar_of_style(subject))
    return banks[key]


def style_subject(config: Config, source: meshes.Mesh, style: Style) -> Subject:
    """What a run measures on its style, on the source as it is and without a mask."""
    plain = copy.deepcopy(config)
    plain.source.refine, plain.style.mask, plain.style.direction = "none", None, "auto"
    as_tone = config.baseline is None
    return measure_subject(
        plain, source, style, torch.device("cpu"), separate=True, as_tone=as_tone
    )


def mask_on(
    config: Config, source: meshes.Mesh, relief: Relief
) -> Float[np.ndarray, " vertices"] | None:
    """``style.mask`` at the relief's vertices, from the source's nearest; None without, or where it
    nowhere reaches a half."""
    if config.style.mask is None:
        return None
    mask = masks.weights(config.style, source)
    if len(relief.base) != len(mask):
        own = meshes.normalisation(source.vertices).apply(source.vertices)
        mask = mask[cKDTree(own).query(relief.base)[1]]
    return mask if (mask > 0.5).any() else None


def raised(source: meshes.Mesh, vertices: np.ndarray, faces: np.ndarray) -> Relief:
    """A result as heights above its source, in radii of the normalised source, no undulation
    taken away."""
    frame = meshes.normalisation(source.vertices)
    result, own = frame.apply(vertices), frame.apply(source.vertices)
    if np.array_equal(faces, source.faces):
        base, normals = own, meshes.vertex_normals(own, faces)
    else:
        base, normals = closest(own, source.faces, result)
    return Relief(base, faces, ((result - base) * normals).sum(axis=1))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.square(values).mean()))
