"""The configuration schema: every choice of an experiment, with its meaning.

Hydra validates against these dataclasses. Their defaults are those of ``method=robust``. The
command line and ``styleexp.stylize(...)`` start from ``conf/config.yaml``, whose
``method=synthesis`` sets ``baseline`` and ``source.refine``; ``conf/method`` holds the presets and
``conf/profile`` the sizes. Section and equation numbers refer to the paper. This module imports
nothing heavy, to keep ``styleexp --help`` fast.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from dataclasses import field as option
from typing import Any

from styleexp.system.errors import UserError, unknown_name


@dataclass
class SourceConfig:
    """The source mesh C. Its overall shape is preserved."""

    name: str | None = None
    """A named asset or analytic shape (``styleexp-assets list``)."""
    path: str | None = None
    """A mesh file; wins over ``name``."""
    weld: float | None = None
    """Merge vertices on open edges within this distance, in the file's units. 0: only coincident
    ones. null: those closer than the file's numeric precision."""
    remesh: int | None = None
    """Remesh to about this many vertices first (drops attributes). null: keep the mesh."""
    refine: str = "none"
    """Refine the mesh. ``auto``: split edges that are too long for the style's relief, placing new
    vertices on a smooth surface through the mesh. Texture coordinates, materials and colours are
    kept. A number: split until there are about this many faces. ``none``: keep the mesh as is, as
    in the paper."""


@dataclass
class StyleConfig:
    """The style source S: a mesh or an image (Sec. 4.2)."""

    name: str | None = None
    """A named asset or analytic style."""
    path: str | None = None
    """A mesh or image file; wins over ``name``."""
    scale: float = 1.0
    """Scale of the pattern on the result: 2 doubles the size of its features."""
    scale_by: str = "area"
    """Meaning of ``scale=1``. ``area``: the result has as many features as the style mesh; lengths
    scale with the square root of the surface area. ``frame``: both meshes fill the unit sphere, as
    in the paper, and an image fills the views unless ``loss.target=bank``."""
    direction: str = "auto"
    """Direction of the pattern's up axis (``method=synthesis``). ``up``, ``x``, ``y``, ``z``: along
    that axis where the surface allows (``up`` is ``y``). ``flow``: smoothly along the form.
    ``attribute:NAME``: along a per-vertex vector from the source file, projected onto the surface.
    ``auto``: ``up`` for a directional style, else ``flow``."""
    rotation: float = 0.0
    """Rotation of the pattern relative to ``direction``, in degrees, counter-clockwise seen from
    outside."""
    mask: Any = None
    """Where to apply the relief; null: everywhere. One mask, or a list of masks that are
    multiplied: ``attribute:NAME`` (a per-vertex number in [0, 1] from the source file),
    ``color:CHANNEL`` (vertex colour channel: r, g, b, a or luminance), ``texture:FILE`` (an image's
    luminance at the source's texture coordinates, row 0 at the top, repeated), ``slope:DEGREES``
    (normals within this angle of up, +Y), ``height:LOW..HIGH`` (fractions of the source's height
    along +Y). Prefix ``not:`` inverts a mask."""
    falloff: float = 0.05
    """Width of the mask's soft border, in radii of the normalised source, half on each side. 0:
    hard border."""
    relief_length: float | None = None
    """Mesh styles (``method=synthesis``): features smaller than this, in radii of the style, are
    relief; larger ones are shape. null: estimated."""
    kind: str = "auto"
    """How to interpret a style image. ``photo``: tone is height; the amplitude is estimated from
    the pattern's size. ``height``: a height map with known amplitude, see ``image_depth``.
    ``normal``: a tangent-space normal map, green up (OpenGL); ``normal_dx``: green down (DirectX);
    the height is integrated, with its true amplitude. ``auto``: a normal map if the colours look
    like one, else ``photo``; always ``photo`` for methods that compare renders with the image's
    tone."""
    invert: bool = False
    """Invert an image's heights: dark is high, bumps become dents."""
    image_depth: float | None = None
    """``kind=height``: height of the map's full range, 0 to 1, as a fraction of the image's longer
    side. null: 0.1."""
    image_contrast: float | None = 0.15
    """Image styles: standard deviation the image's tone is scaled to, which sets the height of the
    relief. null: keep the image's contrast."""
    image_match_mean: bool = True
    """Image styles: shift the image's mean tone to that of the rendered source."""
    image_tile: float = 1.0
    """Image styles: size of the image on the result, on top of ``scale``. At 1 a square image has
    the area of the source's surface (``scale_by=area``) or of the unit sphere."""


@dataclass
class FieldConfig:
    """The displacement field: an MLP on Fourier features (Sec. 3.2, Eq. 1)."""

    name: str = "fourier_mlp"
    unit: str = "style"
    """The radius that ``sigma`` and ``bound`` are measured in: the ``style``'s, so that with
    ``style.scale_by=area`` they go with the pattern, or the ``source``'s, as in the paper."""
    sigma: float | None = None
    """Standard deviation of the frequency matrix B (Fig. 7), in cycles per radius. null: the RMS
    frequency of the style mesh's relief, or of the image's tone. Paper: 5."""
    features: int = 128
    """Rows of B; the encoding has twice as many entries (h_f = 256)."""
    include_input: bool = False
    """Also feed the raw coordinates, as Text2Mesh does."""
    progressive: float = 0.0
    """Open the frequency bands progressively over this fraction of the run (Text2Mesh: 0.13). 0:
    off."""
    width: int = 256
    depth: int = 8
    """Number of fully connected layers, including the output layer."""
    last_layer: str = "zero"
    """Initialisation of the output layer. ``zero``: d = 0 at the first step. ``random``: like the
    other layers, so d starts as small noise."""
    limit: str = "tanh"
    """How displacements are kept within the bound: ``tanh``, or ``clamp``, which has no gradient at
    the bound."""
    bound: float | None = None
    """Displacements lie in (-bound, bound), in radii. null: twice the half range of the style
    mesh's relief; for an image, whose height is unknown, twice 0.15 of its wavelength. Paper:
    0.1."""
    start: str = "map"
    """Base displacement that the field adds to. ``map``: the style's height map, applied by
    triplanar projection (`styleexp.method.height_maps`). ``synthesis``: the result of
    ``method=synthesis``. ``source``: none, as in the paper."""
    learned: float = 0.25
    """Fraction of the bound available to the learned part, 0 to 1. Ignored with
    ``start=source``."""
    zero_mean: bool = True
    """Subtract the area-weighted mean displacement, so that the mesh can't shrink or grow
    overall."""
    unfold: bool = True
    """Damp the final displacement where faces would flip, until none do."""


@dataclass
class LocalViewsConfig:
    """Local views (Sec. 3.3.1, Eq. 2)."""

    mode: str = "surface"
    """``image``: crops of the rendered global view, as in the paper. ``zoom``: the same windows,
    re-rendered with a zoomed camera. ``surface``: a zoomed camera aimed at a random surface
    point."""
    per_view: int = 10
    """Local views per global view."""
    crop: str = "side"
    """``image`` and ``zoom``: whether ``share`` is a fraction of the frame's ``side`` or
    ``area``."""
    share: float = 0.1
    """Crop size as a fraction of the frame; see ``crop`` (paper: 10 %)."""
    size: int = 112
    """Side in pixels; ``image`` crops are resized to it."""
    perspective: str = "after"
    """``image``: apply the random perspective ``after`` cropping, drawn separately for each crop,
    or ``before``, once to the whole view."""
    extent: float = 0.5
    """``surface``: width of the window on the surface, in radii of the normalised mesh."""


@dataclass
class ViewsConfig:
    """Global views (Secs. 3.3.1 and 4.1)."""

    count: int = 2
    resolution: int = 250
    fov: float = 60.0
    """Field of view in degrees."""
    distance: float = 2.0
    elevation: float = 0.0
    azimuth: float = 0.0
    """Centre of the view distribution, in degrees; azimuth 0 looks from +Z, 90 from +X."""
    elevation_std: float = 45.0
    azimuth_std: float = 45.0
    """Standard deviations in degrees (paper: pi/4)."""
    spread: str = "around"
    """``normal``: azimuth drawn from the normal distribution, as in the paper. ``around``: azimuth
    spread evenly around the object, so that its back is stylised too."""
    perspective: float = 0.0
    """Strength of the random perspective (omega_global). 0: off."""
    perspective_probability: float = 0.8
    perspective_fill: float | None = None
    """Grey level for pixels that the perspective brings in from outside the frame. null: the
    background's."""
    local: LocalViewsConfig = option(default_factory=LocalViewsConfig)


@dataclass
class ShadingConfig:
    """Appearance of the training renders. The light is Text2Mesh's."""

    albedo: float = 0.5
    normals: str = "smooth"
    """``flat`` or ``smooth``."""
    background: str = "foreground"
    """``white``, ``black``, ``foreground`` (the mean grey of the rendered source) or a number."""
    outlines: bool = False
    """Propagate gradients through outlines, if the renderer can. Off in the paper; when on, the
    optimiser grows knobs to create outlines inside the frame."""
    light_frame: str = "camera"
    """Frame the light is fixed in: ``camera``, as in Text2Mesh, or ``world``."""
    lights: int = 3
    """1: a grey render under one light, as in the paper. 3: the same light also rotated by 120 and
    240 degrees about the viewing axis, one colour channel each, so that the colour encodes the
    normal and distinguishes bumps from dents. Image styles are always compared in grey."""
    light_spread: float = 0.0
    """Maximum random rotation of the light about the viewing axis, in degrees, drawn per view. 0:
    fixed in camera space. 180: bumps and dents become indistinguishable."""


@dataclass
class EncoderConfig:
    """The feature encoder F (Sec. 3.3.2)."""

    name: str = "vgg16"
    precision: str = "auto"
    """``auto`` (bf16 where the hardware is faster with it), ``fp32`` or ``bf16``. The run's record
    holds the choice."""
    pooling: str = "max"
    activations: str = "relu"
    """Features taken after the ReLU (``relu``) or before it (``conv``)."""
    normalisation: str = "weights"
    """Input normalisation. ``weights``: the constants the weights were trained with. ``paper``:
    those of Sec. 4.1."""


@dataclass
class LossConfig:
    """The style loss (Eqs. 3-8)."""

    name: str = "gram"
    layers: list[Any] = option(
        default_factory=lambda: ["conv1_1", "conv2_1", "conv3_1", "conv4_1", "conv5_1"]
    )
    """Style layers, by name or by the paper's 1-based index of VGG-19's convolutions."""
    block_weights: list[float] = option(default_factory=lambda: [0.3, 0.5, 1.0, 2.0, 2.0])
    """One weight per VGG block, for the layers in it."""
    normalisation: str = "channels_cells"
    """Divisor of a layer's F^T F. ``none``: as Eqs. 3 to 6 are written. ``cells``: number of cells
    summed over. ``channels_cells``: cells times channels. ``mean``: like ``channels_cells``, and
    the squared distance is averaged over the matrix instead of summed. With Adam, this only changes
    the relative weights of the layers."""
    lambda_global: float = 0.3
    lambda_local: float = 1.0
    """lambda of Eq. 7 (paper: 0.1)."""
    masked: Any = True
    """Compute Grams over the foreground only, divided by its area, instead of the whole frame.
    ``pictures``: only if the style is an image, which has no background to compare with."""
    erosion: int = 2
    """Cells eroded from the mask's rim at every layer, because they see the background."""
    relative: str = "source"
    """Divisor of each layer's squared distance. ``none``: as in the paper. ``target``: squared norm
    of the target. ``source``: the source mesh's own distance, so that every layer starts at about
    1."""
    target: str = "bank"
    """``bank``: average the style's Grams once over a bank of views. ``same_views``: render the
    style mesh at the result's views in every step, as in the paper. ``own_views``: at independent
    random views. ``whole``: like ``same_views``, but local views are compared with the whole style
    image instead of crops, as in Text2Mesh."""
    bank_views: int = 24
    relief_weight: float = 1.0
    """Weight of mean((d / r)^4), where r is half the range of the style's relief. Keeps the
    displacement from saturating at its bound. Not in the paper."""


@dataclass
class OptimConfig:
    """Adam with a stepped rate (Sec. 4.1)."""

    steps: int = 160
    rate: float = 4e-3
    schedule: str = "cosine"
    """``step``: multiply the rate by ``decay`` every ``decay_every`` steps, as in the paper.
    ``cosine``: warm up over the first tenth of the run, then decay to a twentieth of the rate."""
    decay: float = 0.9
    decay_every: int = 100
    nominal_steps: int | None = None
    """``step``: run length that ``rate`` and ``decay_every`` are tuned for. With other ``steps``,
    the rate is multiplied and the decay interval divided by the same factor, so that a short run
    gets as far as a long one; at most tenfold. null: no rescaling."""
    seed: int = 0
    unit_gradient: bool = True
    """Normalise the gradient's length in every step. Otherwise a view that shows only a few cells
    of a deep layer, whose Grams are mostly noise, throws the field off. Not in the paper."""
    renormalize: bool = False
    """Fit the displaced mesh into the unit sphere in every step, as Text2Mesh does."""
    checkpoint_every: int = 25


@dataclass
class PreviewConfig:
    """Pictures of the result. Not used by the optimisation."""

    name: str = "builtin"
    """``builtin``: preview.png and turntable.gif. ``pyrender``: also an independent rendering of
    the result as check.png, check.gif and check.json; needs the extra ``gl``."""
    resolution: int = 320
    """Side of each picture in pixels."""
    turntable_frames: int = 36
    check_resolution: int = 640
    """``pyrender``: side of each picture in pixels."""
    platform: str = "auto"
    """``pyrender``: headless platform. ``egl``, ``osmesa`` or ``auto`` (EGL, else OSMesa).
    check.json holds the one used."""


@dataclass
class MetricsConfig:
    """Measurement of the result, in metrics.json. Not used by the optimisation."""

    judge: str = "auto"
    """Encoder that measures the distance to the style. ``auto``: one that the run doesn't train
    with. ``none``: skip metrics that need an encoder."""
    windows: int = 32
    """Number of surface windows that are compared."""


@dataclass
class Config:
    """One run."""

    source: SourceConfig = option(default_factory=SourceConfig)
    style: StyleConfig = option(default_factory=StyleConfig)
    renderer: Any = None
    """The backend's own options, with its registered ``name``."""
    encoder: EncoderConfig = option(default_factory=EncoderConfig)
    field: FieldConfig = option(default_factory=FieldConfig)
    views: ViewsConfig = option(default_factory=ViewsConfig)
    shading: ShadingConfig = option(default_factory=ShadingConfig)
    loss: LossConfig = option(default_factory=LossConfig)
    baseline: Any = None
    """A method that replaces the optimisation loop, such as ``synthesis``; null: optimise, as
    `stylize` does. Holds the method's own options, with its registered ``name``; set by
    ``conf/method``."""
    optim: OptimConfig = option(default_factory=OptimConfig)
    preview: PreviewConfig = option(default_factory=PreviewConfig)
    metrics: MetricsConfig = option(default_factory=MetricsConfig)
    logger: dict[str, Any] = option(default_factory=dict)
    """Loggers that receive the run's numbers and pictures: each logger's options, keyed by its
    name. ``logger=tensorboard``, ``logger=mlflow`` or ``'logger=[tensorboard,mlflow]'``."""
    report: bool = True
    """Write the run's page, ``report.html``: about 3 MB and 1 s for 20 000 faces."""
    strength: float = 1.0
    """Factor on the final displacement; 0 returns the source unchanged."""
    device: str = "auto"
    """``auto`` (CUDA if available), ``cpu``, ``cuda`` or ``cuda:N``."""
    threads: int = 0
    """CPU threads for torch; 0: all cores."""
    debug: bool = False
    """Show tracebacks of user errors."""


CHOICES: dict[str, tuple[Any, ...]] = {
    "style.scale_by": ("area", "frame"),
    "style.kind": ("auto", "photo", "height", "normal", "normal_dx"),
    "views.spread": ("normal", "around"),
    "field.start": ("map", "source", "synthesis"),
    "views.local.mode": ("image", "zoom", "surface"),
    "views.local.crop": ("side", "area"),
    "views.local.perspective": ("after", "before"),
    "field.unit": ("style", "source"),
    "field.last_layer": ("zero", "random"),
    "field.limit": ("tanh", "clamp"),
    "shading.light_frame": ("camera", "world"),
    "encoder.activations": ("relu", "conv"),
    "loss.masked": (True, False, "pictures"),
    "loss.normalisation": ("none", "cells", "channels_cells", "mean"),
    "shading.normals": ("flat", "smooth"),
    "shading.lights": (1, 3),
    "encoder.precision": ("auto", "fp32", "bf16"),
    "encoder.pooling": ("max", "avg"),
    "encoder.normalisation": ("weights", "paper"),
    "optim.schedule": ("step", "cosine"),
    "loss.relative": ("none", "target", "source"),
    "loss.target": ("bank", "same_views", "own_views", "whole"),
    "preview.name": ("builtin", "pyrender"),
    "preview.platform": ("auto", "egl", "osmesa"),
}

POSITIVE = (
    "views.local.share",
    "optim.rate",
    "optim.decay",
    "optim.decay_every",
    "optim.checkpoint_every",
)

BETWEEN = {
    "source.weld": (0.0, 1e100),
    "source.remesh": (100, 10_000_000),
    "style.scale": (1e-3, 1e3),
    "style.image_tile": (1e-3, 1e3),
    "style.falloff": (0.0, 2.0),
    "style.relief_length": (0.02, 4.0),
    "style.image_depth": (1e-4, 10.0),
    "field.features": (1, 65_536),
    "field.width": (1, 65_536),
    "views.count": (1, 4096),
    "views.distance": (1e-3, 1e3),
    "views.local.per_view": (1, 4096),
    "views.local.extent": (1e-3, 1e3),
    "loss.bank_views": (1, 1_000_000),
    "optim.steps": (1, 1_000_000_000),
    "optim.nominal_steps": (1, 1_000_000_000),
    "preview.turntable_frames": (1, 10_000),
    "metrics.windows": (1, 100_000),
    "style.image_contrast": (0.0, 0.5),
    "field.sigma": (1e-3, 1e3),
    "field.bound": (1e-4, 1.0),
    "field.learned": (0.0, 1.0),
    "field.depth": (2, 64),
    "field.progressive": (0.0, 1.0),
    "views.resolution": (32, 4096),
    "views.fov": (1.0, 170.0),
    "views.perspective": (0.0, 0.99),
    "views.perspective_probability": (0.0, 1.0),
    "views.local.size": (16, 2048),
    "views.local.share": (0.0, 1.0),
    "shading.albedo": (0.0, 1.0),
    "shading.light_spread": (0.0, 180.0),
    "loss.erosion": (0, 64),
    "loss.relief_weight": (0.0, 1e6),
    "preview.resolution": (32, 4096),
    "preview.check_resolution": (32, 4096),
    "threads": (0, 4096),
}


def check(config: Config) -> None:
    """Raise `UserError` for an invalid value, naming its key and the allowed values."""
    for key, allowed in CHOICES.items():
        if _value(config, key) not in allowed:
            raise unknown_name(f"value for {key}", str(_value(config, key)), map(str, allowed))
    for key, value in _numbers(config):
        if not math.isfinite(value):
            raise UserError(f"{key}={value} is not allowed: give a finite number.")
    for key in POSITIVE:
        if not _value(config, key) > 0:
            raise UserError(f"{key}={_value(config, key)} is not allowed: give a value above 0.")
    for key, (low, high) in BETWEEN.items():
        value = _value(config, key)
        if value is not None and not low <= value <= high:
            raise UserError(f"{key}={value} is not allowed: give a value from {low} to {high}.")
    _check_placing(config)
    if len(config.loss.block_weights) != 5 or min(config.loss.block_weights) < 0:
        raise UserError(
            f"loss.block_weights={config.loss.block_weights} is not allowed: give five weights, "
            "one for each of VGG's blocks, none below 0."
        )
    refine = config.source.refine
    if refine not in ("none", "auto") and not re.fullmatch(r"[1-9]\d{2,6}", refine):
        raise UserError(
            f"source.refine={refine} is not allowed: give auto, none or a number of faces from 100 "
            "to 9999999."
        )
    background = config.shading.background
    if background not in ("white", "black", "foreground"):
        try:
            grey = float(background)
        except ValueError:
            grey = -1.0
        if not 0 <= grey <= 1:
            raise UserError(
                f"shading.background={background} is not allowed: give white, black, foreground or "
                "a grey from 0 to 1."
            )


DIRECTIONS = ("auto", "up", "flow", "x", "y", "z")
"""Values of ``style.direction``, besides ``attribute:NAME``."""


def _check_placing(config: Config) -> None:
    """Raise `UserError` for invalid options of where and in which direction the relief is
    applied."""
    from styleexp.method import masks

    style, method = config.style, getattr(config.baseline, "name", None)
    named = style.direction.partition("attribute:")
    if style.direction not in DIRECTIONS and not (named[0] == "" and named[2]):
        raise UserError(
            f"style.direction={style.direction} is not allowed: give {', '.join(DIRECTIONS)} or "
            "attribute:NAME."
        )
    learned = method is None and config.field.start != "synthesis"
    if learned or method in ("displacement_map", "geometric_textures"):
        for key, plain in (("direction", "auto"), ("rotation", 0), ("relief_length", None)):
            if (value := getattr(style, key)) != plain:
                raise UserError(
                    f"style.{key}={value} needs method=synthesis or "
                    "field.start=synthesis: no other method reads it."
                )
    if method is None and (style.invert or style.kind not in ("auto", "photo")):
        given = "style.invert=true" if style.invert else f"style.kind={style.kind}"
        raise UserError(
            f"{given} describes heights, but this method compares renders with the picture's tone: "
            "add method=synthesis or method=displacement_map."
        )
    terms = masks.parsed(style.mask)
    if terms and method == "geometric_textures":
        raise UserError(
            "method=geometric_textures remeshes the result, and style.mask is defined on the "
            "source's vertices: choose another method, or leave style.mask out."
        )
    lost = [f"style.mask={term.text}" for term in terms if term.kind in masks.OF_THE_FILE]
    lost += [f"style.direction={style.direction}"] if named[1] else []
    if lost and config.source.remesh:
        raise UserError(
            f"{lost[0]} is lost with source.remesh, which keeps no attributes, colours or texture "
            "coordinates: use source.refine=auto instead."
        )


def _numbers(part: Any, prefix: str = "") -> Iterator[tuple[str, float]]:
    """Yield every number of a configuration with its key."""
    if isinstance(part, int | float):
        yield prefix, part
    elif isinstance(part, list):
        for value in part:
            yield from _numbers(value, prefix)
    elif is_dataclass(part):
        for each in fields(part):
            key = f"{prefix}.{each.name}" if prefix else each.name
            yield from _numbers(getattr(part, each.name), key)


def _value(config: Config, key: str) -> Any:
    value: Any = config
    for part in key.split("."):
        value = getattr(value, part)
    return value
