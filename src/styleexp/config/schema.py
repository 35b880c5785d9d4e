"""The configuration schema: every choice of a run, with its meaning.

Hydra validates against these dataclasses. The command line and ``styleexp.stylize(...)`` start from
``conf/config.yaml``, whose ``method=synthesis`` sets ``baseline`` and ``source.refine``;
``conf/method`` holds the presets and ``conf/profile`` the sizes. Each part's options are beside it:
`method.options`, `encoders.options`, `renderers.options` and so on. This module imports nothing
heavy, to keep ``styleexp --help`` fast.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from styleexp.encoders.options import EncoderConfig
from styleexp.method.options import Settings
from styleexp.system.options import option


@dataclass
class PreviewConfig:
    """Pictures of the result. Not used by the optimisation."""

    name: str = option("builtin", choices=("builtin", "pyrender"))
    """``builtin``: preview.png and turntable.gif. ``pyrender``: also an independent rendering of
    the result as check.png, check.gif and check.json; needs the extra ``gl``."""
    resolution: int = option(320, between=(32, 4096))
    """Side of each picture in pixels."""
    turntable_frames: int = option(36, between=(1, 10_000))
    check_resolution: int = option(640, between=(32, 4096))
    """``pyrender``: side of each picture in pixels."""
    platform: str = option("auto", choices=("auto", "egl", "osmesa"))
    """``pyrender``: headless platform. ``egl``, ``osmesa`` or ``auto`` (EGL, else OSMesa).
    check.json holds the one used."""


@dataclass
class MetricsConfig:
    """Measurement of the result, in metrics.json. Not used by the optimisation."""

    judge: str = "auto"
    """Encoder that measures the distance to the style. ``auto``: one that the run doesn't train
    with. ``none``: skip metrics that need an encoder."""
    windows: int = option(32, between=(1, 100_000))
    """Number of surface windows that are compared."""


@dataclass
class Config(Settings):
    """One run."""

    renderer: Any = None
    """The backend's own options, with its registered ``name``."""
    encoder: EncoderConfig = option(factory=EncoderConfig)
    baseline: Any = None
    """A method that replaces the optimisation loop, such as ``synthesis``; null: the
    paper's loop. Holds the method's own options, with its registered ``name``; set by
    ``conf/method``."""
    preview: PreviewConfig = option(factory=PreviewConfig)
    metrics: MetricsConfig = option(factory=MetricsConfig)
    logger: dict[str, Any] = option(factory=dict)
    """Loggers that receive the run's numbers and pictures: each logger's options, keyed by its
    name. ``logger=tensorboard``, ``logger=mlflow`` or ``'logger=[tensorboard,mlflow]'``."""
    report: bool = True
    """Write the run's page, ``report.html``: about 3 MB and 1 s for 20 000 faces."""
    formats: list[str] = option(factory=list, choices=("stl", "3mf"))
    """Formats in which the result is written besides PLY, OBJ and GLB: ``formats=[stl,3mf]``, for
    printing."""
    simplify: int | None = option(None, between=(100, 4_000_000))
    """Also write the result with about this many faces, as ``result_simplified``: more if fewer
    would lose more than 5 % of the relief. Needs the extra ``simplify``."""
    keep_checkpoint: bool = True
    """Keep the last checkpoints of a finished run, from which it could go on. ``false`` removes
    them once it is done; an unfinished run has them in any case."""
    device: str = "auto"
    """``auto`` (CUDA if available and if the renderer can use it), ``cpu``, ``cuda`` or
    ``cuda:N``."""
    threads: int = option(0, between=(0, 4096))
    """CPU threads for torch; 0: all cores."""
    debug: bool = False
    """Show tracebacks of user errors."""
