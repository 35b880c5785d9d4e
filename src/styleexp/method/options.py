"""Options of the method, with their meanings and limits. Imports nothing heavy.

The defaults are those of ``method=robust``; ``conf/method`` holds the presets. Section and equation
numbers refer to the paper.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from styleexp.inputs.options import SourceConfig
from styleexp.system.options import option


@dataclass
class StyleConfig:
    """The style source S: a mesh or an image (Sec. 4.2)."""

    name: str | None = None
    """A named asset or analytic style."""
    path: str | None = None
    """A mesh or image file; wins over ``name``."""
    scale: float = option(1.0, between=(0.001, 1000.0))
    """Scale of the pattern on the result: 2 doubles the size of its features."""
    scale_by: str = option("area", choices=("area", "parts", "frame"))
    """Meaning of ``scale=1``. ``area``: the result has as many features as the style mesh; lengths
    scale with the square root of the surface area. ``parts``: the same, but finer on a thin source,
    so that a pattern doesn't become as thick as legs (see `pattern_size.finer`); a picture is at
    least so large that 200,000 faces can carry its detail. ``frame``: both meshes fill the unit
    sphere, as in the paper, and an image fills the views unless ``loss.target=bank``."""
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
    along +Y), ``near:X/Y/Z/RADIUS`` (within a ball, in the source's own coordinates; several balls
    are joined by ``+``). Prefix ``not:`` inverts a mask."""
    falloff: float = option(0.05, between=(0.0, 2.0))
    """Width of the mask's soft border, in radii of the normalised source, half on each side. 0:
    hard border."""
    relief_length: float | None = option(None, between=(0.02, 4.0))
    """Mesh styles (``method=synthesis``): features smaller than this, in radii of the style, are
    relief; larger ones are shape. null: estimated."""
    kind: str = option("auto", choices=("auto", "photo", "height", "normal", "normal_dx"))
    """How to interpret a style image. ``photo``: tone is height; the amplitude is estimated from
    the pattern's size. ``height``: a height map with known amplitude, see ``image_depth``.
    ``normal``: a tangent-space normal map, green up (OpenGL); ``normal_dx``: green down (DirectX);
    the height is integrated, with its true amplitude. ``auto``: a normal map if the colours look
    like one, else ``photo``; always ``photo`` for methods that compare renders with the image's
    tone."""
    invert: bool = False
    """Invert an image's heights: dark is high, bumps become dents."""
    image_depth: float | None = option(None, between=(0.0001, 10.0))
    """``kind=height``: height of the map's full range, 0 to 1, as a fraction of the image's longer
    side. null: 0.1."""
    image_contrast: float | None = option(0.15, between=(0.0, 0.5))
    """Image styles: standard deviation the image's tone is scaled to, which sets the height of the
    relief. null: keep the image's contrast."""
    image_match_mean: bool = True
    """Image styles: shift the image's mean tone to that of the rendered source."""
    image_tile: float = option(1.0, between=(0.001, 1000.0))
    """Image styles: size of the image on the result, on top of ``scale``. At 1 a square image has
    the area of the source's surface (``scale_by=area``) or of the unit sphere."""


@dataclass
class FieldConfig:
    """The displacement field: an MLP on Fourier features (Sec. 3.2, Eq. 1)."""

    name: str = "fourier_mlp"
    unit: str = option("style", choices=("style", "source"))
    """The radius that ``sigma`` and ``bound`` are measured in: the ``style``'s, so that with
    ``style.scale_by=area`` they go with the pattern, or the ``source``'s, as in the paper."""
    sigma: float | None = option(None, between=(0.001, 1000.0))
    """Standard deviation of the frequency matrix B (Fig. 7), in cycles per radius. null: the RMS
    frequency of the style mesh's relief, or of the image's tone. Paper: 5."""
    features: int = option(128, between=(1, 65_536))
    """Rows of B; the encoding has twice as many entries (h_f = 256)."""
    include_input: bool = False
    """Also feed the raw coordinates, as Text2Mesh does."""
    progressive: float = option(0.0, between=(0.0, 1.0))
    """Open the frequency bands progressively over this fraction of the run (Text2Mesh: 0.13). 0:
    off."""
    width: int = option(256, between=(1, 65_536))
    depth: int = option(8, between=(2, 64))
    """Number of fully connected layers, including the output layer."""
    last_layer: str = option("zero", choices=("zero", "random"))
    """Initialisation of the output layer. ``zero``: d = 0 at the first step. ``random``: like the
    other layers, so d starts as small noise."""
    limit: str = option("tanh", choices=("tanh", "clamp"))
    """How displacements are kept within the bound: ``tanh``, or ``clamp``, which has no gradient at
    the bound."""
    bound: float | None = option(None, between=(0.0001, 1.0))
    """Displacements lie in [-bound, bound], in radii. null: twice the half range of the style
    mesh's relief; for an image, whose height is unknown, twice 0.15 of its wavelength. Paper:
    0.1."""
    start: str = option("map", choices=("map", "source", "synthesis"))
    """Base displacement that the field adds to. ``map``: the style's height map, applied by
    triplanar projection (`styleexp.method.height_maps`). ``synthesis``: the result of
    ``method=synthesis``. ``source``: none, as in the paper."""
    learned: float = option(0.25, between=(0.0, 1.0))
    """Fraction of the bound available to the learned part, 0 to 1. Ignored with
    ``start=source``."""
    zero_mean: bool = True
    """Subtract the area-weighted mean displacement, so that the mesh can't shrink or grow
    overall."""
    unfold: bool = True
    """Damp the final displacement where faces would flip, until none do."""


@dataclass
class VertexConfig(FieldConfig):
    """A free displacement per vertex (`styleexp.method.fields.VertexField`)."""

    name: str = "vertex"
    smoothness: float = option(0.0, between=(0.0, 1e6))
    """lambda of large steps (Nicolet et al. 2021): what is learned is u = (I + lambda L) x, so that
    a step moves neighbours alike, over about the square root of lambda edges. u is larger than x:
    raise ``optim.rate`` with it, to 0.3 for 2. 0: off."""


@dataclass
class LocalViewsConfig:
    """Local views (Sec. 3.3.1, Eq. 2)."""

    mode: str = option("surface", choices=("image", "surface"))
    """``image``: crops of the rendered global view, as in the paper. ``surface``: a zoomed camera
    aimed at a random surface point."""
    per_view: int = option(10, between=(1, 4096))
    """Local views per global view."""
    crop: str = option("side", choices=("side", "area"))
    """``image``: whether ``share`` is a fraction of the frame's ``side`` or ``area``."""
    share: float = option(0.1, above=0, between=(0.0, 1.0))
    """Crop size as a fraction of the frame; see ``crop`` (paper: 10 %)."""
    size: int = option(112, between=(16, 2048))
    """Side in pixels; ``image`` crops are resized to it."""
    perspective: str = option("after", choices=("after", "before"))
    """``image``: apply the random perspective ``after`` cropping, drawn separately for each crop,
    or ``before``, once to the whole view."""
    extent: float = option(0.5, between=(0.001, 1000.0))
    """``surface``: width of the window on the surface, in radii of the normalised mesh."""


@dataclass
class ViewsConfig:
    """Global views (Secs. 3.3.1 and 4.1)."""

    count: int = option(2, between=(1, 4096))
    resolution: int = option(250, between=(32, 4096))
    fov: float = option(60.0, between=(1.0, 170.0))
    """Field of view in degrees."""
    distance: float = option(2.0, between=(0.001, 1000.0))
    elevation: float = 0.0
    azimuth: float = 0.0
    """Centre of the view distribution, in degrees; azimuth 0 looks from +Z, 90 from +X."""
    elevation_std: float = 45.0
    azimuth_std: float = 45.0
    """Standard deviations in degrees (paper: pi/4)."""
    spread: str = option("around", choices=("normal", "around"))
    """``normal``: azimuth drawn from the normal distribution, as in the paper. ``around``: azimuth
    spread evenly around the object, so that its back is stylised too."""
    perspective: float = option(0.0, between=(0.0, 0.99))
    """Strength of the random perspective (omega_global). 0: off."""
    perspective_probability: float = option(0.8, between=(0.0, 1.0))
    perspective_fill: float | None = None
    """Grey level for pixels that the perspective brings in from outside the frame. null: the
    background's."""
    local: LocalViewsConfig = option(factory=LocalViewsConfig)


@dataclass
class ShadingConfig:
    """Appearance of the training renders. The light is Text2Mesh's."""

    albedo: float = option(0.5, between=(0.0, 1.0))
    normals: str = option("smooth", choices=("flat", "smooth"))
    """``flat`` or ``smooth``."""
    background: str = "foreground"
    """``white``, ``black``, ``foreground`` (the mean grey of the rendered source) or a number."""
    outlines: bool = False
    """Propagate gradients through outlines, if the renderer can. Off in the paper; when on, the
    optimiser grows knobs to create outlines inside the frame."""
    light_frame: str = option("camera", choices=("camera", "world"))
    """Frame the light is fixed in: ``camera``, as in Text2Mesh, or ``world``."""
    lights: int = option(3, choices=(1, 3))
    """1: a grey render under one light, as in the paper. 3: the same light also rotated by 120 and
    240 degrees about the viewing axis, one colour channel each, so that the colour encodes the
    normal and distinguishes bumps from dents. Image styles are always compared in grey."""


@dataclass
class LossConfig:
    """The style loss (Eqs. 3-8)."""

    name: str = "gram"
    layers: list[Any] = option(
        factory=lambda: ["conv1_1", "conv2_1", "conv3_1", "conv4_1", "conv5_1"]
    )
    """Style layers, by name or by the paper's 1-based index of VGG-19's convolutions."""
    block_weights: list[float] = option(factory=lambda: [0.3, 0.5, 1.0, 2.0, 2.0])
    """One weight per VGG block, for the layers in it."""
    normalisation: str = option(
        "channels_cells", choices=("none", "cells", "channels_cells", "mean")
    )
    """Divisor of a layer's F^T F. ``none``: as Eqs. 3 to 6 are written. ``cells``: number of cells
    summed over. ``channels_cells``: cells times channels. ``mean``: like ``channels_cells``, and
    the squared distance is averaged over the matrix instead of summed. With Adam, this only changes
    the relative weights of the layers."""
    lambda_global: float = 0.3
    lambda_local: float = 1.0
    """lambda of Eq. 7 (paper: 0.1)."""
    masked: Any = option(True, choices=(True, False, "pictures"))
    """Compute Grams over the foreground only, divided by its area, instead of the whole frame.
    ``pictures``: only if the style is an image, which has no background to compare with."""
    erosion: int = option(2, between=(0, 64))
    """Cells eroded from the mask's rim at every layer, because they see the background."""
    relative: str = option("source", choices=("none", "target", "source"))
    """Divisor of each layer's squared distance. ``none``: as in the paper. ``target``: squared norm
    of the target. ``source``: the source mesh's own distance, so that every layer starts at about
    1."""
    target: str = option("bank", choices=("bank", "same_views", "own_views", "whole"))
    """``bank``: average the style's Grams once over a bank of views. ``same_views``: render the
    style mesh at the result's views in every step, as in the paper. ``own_views``: at independent
    random views. ``whole``: like ``same_views``, but local views are compared with the whole style
    image instead of crops, as in Text2Mesh."""
    bank_views: int = option(24, between=(1, 1_000_000))
    relief_weight: float = option(1.0, between=(0.0, 1000000.0))
    """Weight of mean((d / r)^4), where r is half the range of the style's relief. Keeps the
    displacement from saturating at its bound. Not in the paper."""


@dataclass
class CellLossConfig(LossConfig):
    """Options of the losses that compare cells of features (`styleexp.method.cell_losses`)."""

    cells: int = option(4096, between=(16, 65_536))
    """Most cells of a layer that are compared: of the views of a step, drawn anew in each, and of
    the style's bank."""


@dataclass
class SlicedConfig(CellLossConfig):
    """Sliced Wasserstein distances (Heitz et al. 2021)."""

    name: str = "sliced"
    directions: int = option(128, between=(1, 4096))
    """Random directions that features are projected on, drawn anew in every step for each layer."""


@dataclass
class NeighbourConfig(CellLossConfig):
    """Cosine distances to the nearest cell of the style (Kolkin et al. 2022)."""

    name: str = "neighbour"
    cells: int = option(2048, between=(16, 65_536))
    """Most cells of a layer that are compared: of the views of a step, drawn anew in each, and of
    the style's bank. Time grows with the square."""
    block_weights: list[float] = option(factory=lambda: [0.3, 1.0, 2.0, 2.0, 0.5])
    """One weight per VGG block, for the layers in it. Chosen by looking at bubbles on the critter
    from its bare surface: with those of ``gram``, which favour the deep blocks, few appear."""
    completeness: float = option(4.0, between=(0.0, 1000.0))
    """Weight of the other direction, from every cell of the style to the nearest of the result,
    which keeps the result from using the plainest cells alone (Simakov et al. 2008). 0: off."""


@dataclass
class OptimConfig:
    """Adam and its learning rate (Sec. 4.1)."""

    steps: int = option(160, between=(1, 1_000_000_000))
    rate: float = option(4e-3, above=0)
    schedule: str = option("cosine", choices=("step", "cosine"))
    """``step``: multiply the rate by ``decay`` every ``decay_every`` steps, as in the paper.
    ``cosine``: warm up over the first tenth of the run, then decay to a twentieth of the rate."""
    decay: float = option(0.9, above=0)
    decay_every: int = option(100, above=0)
    nominal_steps: int | None = option(None, between=(1, 1_000_000_000))
    """``step``: run length that ``rate`` and ``decay_every`` are tuned for. With other ``steps``,
    the rate is multiplied and the decay interval divided by the same factor, so that a short run
    gets as far as a long one; at most tenfold. null: no rescaling."""
    seed: int = 0
    second_moment: str = option("each", choices=("each", "uniform"))
    """Adam divides a step by the root of the mean squared gradient: of ``each`` number, or
    ``uniform``, by the largest of the parameter's, which keeps the step as smooth as the gradient
    (Nicolet et al. 2021, for ``field.smoothness``)."""
    unit_gradient: bool = True
    """Normalise the gradient's length in every step. Otherwise a view that shows only a few cells
    of a deep layer, whose Grams are mostly noise, throws the field off. Not in the paper."""
    renormalize: bool = False
    """Fit the displaced mesh into the unit sphere in every step, as Text2Mesh does."""
    checkpoint_every: int = option(25, above=0)


@dataclass
class Settings:
    """The options that methods read. A run's `config.schema.Config` adds those of its other
    parts."""

    source: SourceConfig = option(factory=SourceConfig)
    style: StyleConfig = option(factory=StyleConfig)
    field: FieldConfig = option(factory=FieldConfig)
    views: ViewsConfig = option(factory=ViewsConfig)
    shading: ShadingConfig = option(factory=ShadingConfig)
    loss: LossConfig = option(factory=LossConfig)
    optim: OptimConfig = option(factory=OptimConfig)
    strength: float = 1.0
    """Factor on the final displacement; 0 returns the source unchanged."""
