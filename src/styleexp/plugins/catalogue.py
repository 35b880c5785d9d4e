"""The built-in styles, fields and losses, by name. Imports none of them.

Renderers and encoders have their own ``specs`` modules.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from styleexp.config.schema import FieldConfig, LossConfig, StyleConfig
from styleexp.inputs import shapes
from styleexp.plugins.spec import Spec

if TYPE_CHECKING:
    import torch

    from styleexp.encoders import Encoder
    from styleexp.encoders.clip import ClipEncoder
    from styleexp.inputs.meshes import Mesh
    from styleexp.method.fields import DisplacementField, VertexField
    from styleexp.method.losses import ClipLoss, StyleLoss


def _shape(config: StyleConfig) -> Mesh:
    assert config.name is not None
    return shapes.make(config.name)


def _fourier_mlp(
    config: FieldConfig, *, generator: torch.Generator, sigma: float, bound: float
) -> DisplacementField:
    from styleexp.method.fields import DisplacementField

    return DisplacementField(config, generator, sigma, bound)


def _vertex(
    config: FieldConfig, *, generator: torch.Generator, sigma: float, bound: float
) -> VertexField:
    from styleexp.method.fields import VertexField

    return VertexField(bound)


def _gram(config: LossConfig, *, encoder: Encoder) -> StyleLoss:
    from styleexp.method.losses import StyleLoss

    return StyleLoss(config, encoder)


def _clip(config: LossConfig, *, encoder: ClipEncoder) -> ClipLoss:
    from styleexp.method.losses import ClipLoss

    return ClipLoss(config, encoder)


STYLES = {
    name: Spec(name, description, StyleConfig, _shape)
    for name, description in {**shapes.STYLES, **shapes.SOURCES}.items()
}
FIELDS = {
    "fourier_mlp": Spec(
        "fourier_mlp", "an MLP on random Fourier features (Sec. 3.2)", FieldConfig, _fourier_mlp
    ),
    "vertex": Spec(
        "vertex", "a free displacement per vertex, no network (baseline)", FieldConfig, _vertex
    ),
}
LOSSES = {
    "gram": Spec("gram", "squared distances of Gram matrices (Sec. 3.3)", LossConfig, _gram),
    "clip": Spec(
        "clip", "cosine of CLIP's embeddings, as in Text2Mesh (baseline)", LossConfig, _clip
    ),
}
