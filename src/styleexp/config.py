"""The configuration schema: every choice of an experiment, with its meaning.

Hydra validates against these dataclasses. Their defaults are those of ``method=robust``. The
command line and ``styleexp.stylize(...)`` start from ``conf/config.yaml``, whose
``method=synthesis`` sets ``baseline`` and ``source.refine``; ``conf/method`` holds the presets and
``conf/profile`` the sizes. Section and equation numbers are the paper's. This module imports
nothing heavy: ``styleexp --help`` reads it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from dataclasses import field as option
from typing import Any

from styleexp.errors import UserError, unknown_name


@dataclass
class SourceConfig:
    """The source mesh C, whose shape is kept."""

    name: str | None = None
    """A named asset or analytic shape (``styleexp-assets list``)."""
    path: str | None = None
    """A mesh file; wins over ``name``."""
    weld: float | None = None
    """Join vertices along open edges that lie within this distance, in the file's units: 0 only
    those at the same position; null what the file's numbers can't tell apart."""
    remesh: int | None = None
    """Remesh to about this many vertices first (attributes are lost); null keeps the mesh."""
    refine: str = "none"
    """``auto``: edges too long for the style's relief are halved until none is left, on the smooth
    surface through the mesh; texture coordinates, materials and colours are kept. A number: until
    there are about so many faces. ``none``: the mesh's own vertices and faces, as in the paper."""


@dataclass
class StyleConfig:
    """The style source S: a mesh or an image (Sec. 4.2)."""

    name: str | None = None
    """A named asset or analytic style."""
    path: str | None = None
    """A mesh or image file; wins over ``name``."""
    scale: float = 1.0
    """Size of the pattern on the result: 2 makes its features twice as large."""
    scale_by: str = "area"
    """What ``scale`` 1 means. ``area``: the result carries as many features as the style mesh, as
    lengths go by the square root of the surface. ``frame``: both meshes fill the unit sphere, as in
    the paper, and a picture fills the views unless ``loss.target`` is ``bank``."""
    direction: str = "auto"
    """Which way the pattern's up points (``method=synthesis``). ``up``, ``x``, ``y``, ``z``: along
    that axis wherever the surface allows it (``up`` is ``y``). ``flow``: smoothly along the form.
    ``attribute:NAME``: along a vector that the source's file has for each vertex, as far as it lies
    in the surface. ``auto``: ``up`` for a style with a direction, ``flow`` for one without."""
    rotation: float = 0.0
    """Degrees by which the pattern is turned against that, counter-clockwise seen from outside."""
    mask: Any = None
    """Where the relief goes; null is everywhere. One of these, or a list of them, multiplied:
    ``attribute:NAME`` (a number in [0, 1] that the source's file has for each vertex),
    ``color:CHANNEL`` (of the vertex colours: r, g, b, a or luminance), ``texture:FILE`` (a
    picture's luminance through the source's texture coordinates, row 0 at the top, repeated),
    ``slope:DEGREES`` (where the normal is within so many of up, +Y), ``height:LOW..HIGH`` (in
    shares of the source's height along +Y). ``not:`` in front of one takes the rest."""
    falloff: float = 0.05
    """Width of the mask's borders, in radii of the normalised source; half of it lies on each
    side. 0 leaves the mask as it is."""
    relief_length: float | None = None
    """Mesh styles (``method=synthesis``): what is smaller than this, in radii of the style, is its
    relief, the rest its shape; null finds it."""
    kind: str = "auto"
    """What a picture's colours are. ``photo``: its tone is height, as high as its pattern's size
    suggests. ``height``: height in proportion, see ``image_depth``. ``normal``: the directions of a
    tangent-space normal map, green up (OpenGL); ``normal_dx``: green down (DirectX); its height
    follows from it, in proportion. ``auto``: a normal map where the colours are such, else
    ``photo``; always ``photo`` for methods that compare renders with the picture's tone."""
    invert: bool = False
    """Turn a picture's heights over: dark is high, bumps are dents."""
    image_depth: float | None = None
    """``kind=height``: how high the full range of the map's values, 0 to 1, is, in shares of the
    picture's longer side; null is 0.1."""
    image_contrast: float | None = 0.15
    """Image styles: standard deviation that the picture's tone is brought to (it sets the height of
    the relief); null keeps the picture's own contrast."""
    image_match_mean: bool = True
    """Image styles: shift the picture's mean tone to the mean of the rendered source."""
    image_tile: float = 1.0
    """Image styles: how large the picture lies on the result, besides ``scale``. At 1 a square
    picture has the area of the source's surface (``scale_by=area``) or of the unit sphere's."""


@dataclass
class FieldConfig:
    """The displacement field: an MLP on Fourier features (Sec. 3.2, Eq. 1)."""

    name: str = "fourier_mlp"
    unit: str = "style"
    """The radius that ``sigma`` and ``bound`` are measured in: the ``style``'s, so that with
    ``style.scale_by=area`` they go with the pattern, or the ``source``'s, as in the paper."""
    sigma: float | None = None
    """Standard deviation of the frequency matrix B (Fig. 7), in cycles per radius. null: the root
    mean square frequency of the style mesh's relief, or of the picture's tone. The paper has 5."""
    features: int = 128
    """Rows of B; the encoding has twice as many entries (h_f = 256)."""
    include_input: bool = False
    """Also feed the raw coordinates, as Text2Mesh does."""
    progressive: float = 0.0
    """Open the frequency bands over this share of the run (Text2Mesh: 0.13); 0 is off."""
    width: int = 256
    depth: int = 8
    """Fully connected layers, the output layer included."""
    last_layer: str = "zero"
    """How the output layer's weights begin. ``zero``: d is 0 at the first step. ``random``: like
    the other layers', so that d is small noise."""
    limit: str = "tanh"
    """What keeps displacements within the bound: ``tanh``, or ``clamp``, which has no gradient at
    the bound."""
    bound: float | None = None
    """Displacements lie in (-bound, bound), in radii. null: twice what the
    style mesh's own relief needs; of a picture, which doesn't tell its height, twice 0.15 of its
    wavelength. The paper has 0.1."""
    start: str = "map"
    """What the field's displacement is added to. ``map``: the style's height map, laid on by
    triplanar projection (`styleexp.height_maps`). ``synthesis``: what ``method=synthesis`` makes.
    ``source``: nothing, as in the paper."""
    learned: float = 0.25
    """Unless ``start=source``: how much of the bound the learned part may use, 0 to 1."""
    zero_mean: bool = True
    """Subtract the area-weighted mean displacement, so that the mesh can't shrink as a whole."""
    unfold: bool = True
    """Damp the final displacement where faces would turn over, until none does."""


@dataclass
class LocalViewsConfig:
    """Local views (Sec. 3.3.1, Eq. 2)."""

    mode: str = "surface"
    """``image``: crops of the rendered global view, as in the paper. ``zoom``: the same windows,
    rendered anew by a zoomed camera. ``surface``: a zoomed camera aimed at a random point of the
    surface."""
    per_view: int = 10
    """Local views for each global view."""
    crop: str = "side"
    """``image`` and ``zoom``: whether the paper's 10 % are of the ``side`` or of the ``area``."""
    share: float = 0.1
    """That share."""
    size: int = 112
    """Pixels on a side; ``image`` crops are resized to it."""
    perspective: str = "after"
    """``image``: whether the random perspective is drawn ``after`` the crop, for each crop anew, or
    ``before`` it, for the view that is cropped."""
    extent: float = 0.5
    """``surface``: width of the window at the surface, in radii of the normalised mesh."""


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
    """``normal``: azimuth from the normal distribution, as in the paper. ``around``: azimuth spread
    evenly around the object, so that its back is styled too."""
    perspective: float = 0.0
    """Distortion of the random perspective (omega_global); 0 is off."""
    perspective_probability: float = 0.8
    perspective_fill: float | None = None
    """Grey of what a perspective brings in from outside the frame; null: the background's."""
    local: LocalViewsConfig = option(default_factory=LocalViewsConfig)


@dataclass
class ShadingConfig:
    """How the training renders look (METHOD: Text2Mesh's light)."""

    albedo: float = 0.5
    normals: str = "smooth"
    """``flat`` or ``smooth``."""
    background: str = "foreground"
    """``white``, ``black``, ``foreground`` (the mean grey of the rendered source) or a number."""
    outlines: bool = False
    """Whether outlines carry gradients, where the renderer can. Off in the paper; where they do,
    the optimiser grows knobs to make outlines inside the frame."""
    light_frame: str = "camera"
    """Where the light stands still: ``camera``, as in Text2Mesh, or ``world``."""
    lights: int = 3
    """1: a grey picture under one light, as in the paper. 3: besides, the same light turned by 120
    and 240 degrees about the viewing axis, each in a colour of its own: the colour then tells the
    normal, and bumps from dents. A picture as style is compared in grey in any case."""
    light_spread: float = 0.0
    """Largest angle, in degrees, by which the light is turned at random about the viewing axis, for
    every view anew; 0 fixes it in camera space. At 180 bumps can't be told from dents."""


@dataclass
class EncoderConfig:
    """The feature encoder F (Sec. 3.3.2)."""

    name: str = "vgg16"
    precision: str = "auto"
    """``auto`` (bf16 where the hardware gains from it), ``fp32`` or ``bf16``; the one chosen is in
    the run's record."""
    pooling: str = "max"
    activations: str = "relu"
    """What a layer serves: its output after the ReLU, or before it (``conv``)."""
    normalisation: str = "weights"
    """``weights``: what the weights were trained with; ``paper``: the constants of Sec. 4.1."""


@dataclass
class LossConfig:
    """The style loss (Eqs. 3-8)."""

    name: str = "gram"
    layers: list[Any] = option(
        default_factory=lambda: ["conv1_1", "conv2_1", "conv3_1", "conv4_1", "conv5_1"]
    )
    """Style layers, by name or by the paper's 1-based index of VGG-19's convolutions."""
    block_weights: list[float] = option(default_factory=lambda: [0.3, 0.5, 1.0, 2.0, 2.0])
    """A weight for the layers of each of VGG's five blocks."""
    normalisation: str = "channels_cells"
    """What a layer's F^T F is divided by. ``none``, as Eqs. 3 to 6 are written; ``cells``: by how
    many cells it sums over; ``channels_cells``: besides by the channels; ``mean``: as before, and
    the squared distance is the mean over the matrix, not its sum. With Adam, only the layers'
    weights against each other differ."""
    lambda_global: float = 0.3
    lambda_local: float = 1.0
    """lambda of Eq. 7 (paper: 0.1)."""
    masked: Any = True
    """Grams over the foreground only, divided by its area, not over the whole frame. ``pictures``:
    only where the style is a picture, which has no background to compare with."""
    erosion: int = 2
    """Cells taken off the mask's rim at every layer; they see the background."""
    relative: str = "source"
    """What each layer's squared distance is divided by: ``none``, as in the paper; ``target``, the
    squared norm of the target; ``source``, the source mesh's own distance, so that every layer
    starts at about 1."""
    target: str = "bank"
    """``bank``: the style's Grams are averaged once over a bank of views. ``same_views``: the style
    mesh is rendered at the result's views in every step, as in the paper; ``own_views``: at random
    views of its own. ``whole``: as ``same_views``, but a picture is the target of local views as a
    whole, too, not in crops, as in Text2Mesh."""
    bank_views: int = 24
    relief_weight: float = 1.0
    """Weight of mean((d / r)^4), where r is half the range of the style's relief: keeps the
    displacement from flattening out at its bound. Not in the paper."""


@dataclass
class OptimConfig:
    """Adam with a stepped rate (Sec. 4.1)."""

    steps: int = 160
    rate: float = 4e-3
    schedule: str = "cosine"
    """``step``: the rate is multiplied by ``decay`` every ``decay_every`` steps, as in the paper.
    ``cosine``: it rises over the first tenth of the run, and falls to a twentieth over all of it,
    so that the last steps settle."""
    decay: float = 0.9
    decay_every: int = 100
    nominal_steps: int | None = None
    """``step``: the length of run that ``rate`` and ``decay_every`` are meant for. A run of other
    ``steps`` has its rate raised and its decays brought closer by the same factor, so that a short
    run goes as far as a long one. null: taken as they are."""
    seed: int = 0
    unit_gradient: bool = True
    """Bring every step's gradient to the same length: otherwise a view that shows only a few cells
    of a deep layer, whose Grams are mostly chance, throws the field off. Not in the paper."""
    renormalize: bool = False
    """Fit the displaced mesh into the unit sphere in every step, as Text2Mesh does."""
    checkpoint_every: int = 25


@dataclass
class PreviewConfig:
    """What is drawn of the result; never seen by the optimisation."""

    name: str = "builtin"
    """``builtin``: preview.png and turntable.gif. ``pyrender``: besides, an independent look at the
    result, check.png, check.gif and check.json, for which the extra ``gl`` is needed."""
    resolution: int = 320
    """Pixels on a side of each picture."""
    turntable_frames: int = 36
    check_resolution: int = 640
    """``pyrender``: pixels on a side of each picture."""
    platform: str = "auto"
    """``pyrender``: how it draws without a display. ``egl``, ``osmesa`` or ``auto``, EGL or else
    OSMesa; the one used is in check.json."""


@dataclass
class MetricsConfig:
    """How the result is measured, in metrics.json; never seen by the optimisation."""

    judge: str = "auto"
    """The encoder that judges how near the style is: ``auto`` is one that the run doesn't train
    with; ``none`` leaves out what needs an encoder."""
    windows: int = 32
    """Places of the result that are looked at."""


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
    """A method without this package's loop of learning, such as ``synthesis``; null learns, as
    `stylize` does. Its own options, with its registered ``name``; ``conf/method`` sets it."""
    optim: OptimConfig = option(default_factory=OptimConfig)
    preview: PreviewConfig = option(default_factory=PreviewConfig)
    metrics: MetricsConfig = option(default_factory=MetricsConfig)
    logger: dict[str, Any] = option(default_factory=dict)
    """Who else is told of the run's numbers and pictures: each logger's own options, by its name.
    ``logger=tensorboard``, ``logger=mlflow`` or ``'logger=[tensorboard,mlflow]'``."""
    report: bool = True
    """Write ``report.html``, the run's page: about 3 MB and a second for 20 000 faces."""
    strength: float = 1.0
    """Factor on the final displacement; 0 gives the source back."""
    device: str = "auto"
    """``auto`` (cuda where there is one), ``cpu``, ``cuda`` or ``cuda:N``."""
    threads: int = 0
    """CPU threads for torch; 0 takes all cores."""
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
    """Raise `UserError` for a value that has no meaning, naming its key and what is allowed."""
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
            f"source.refine={refine} is not allowed: give auto, none or how many faces it should "
            "have, from 100 to 9999999."
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
"""Of ``style.direction``, besides ``attribute:NAME``."""


def _check_placing(config: Config) -> None:
    """The same for where the relief goes, and which way."""
    from styleexp import masks

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
                    "field.start=synthesis: nothing else reads it."
                )
    if method is None and (style.invert or style.kind not in ("auto", "photo")):
        given = "style.invert=true" if style.invert else f"style.kind={style.kind}"
        raise UserError(
            f"{given} is about heights, and this method compares renders with the picture's tone: "
            "add method=synthesis or method=displacement_map."
        )
    terms = masks.parsed(style.mask)
    if terms and method == "geometric_textures":
        raise UserError(
            "method=geometric_textures gives the result faces of its own, and style.mask is of the "
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
    """Every number of a configuration, with its key."""
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
