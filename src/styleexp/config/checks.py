"""Validation of a configuration: limits of single options, and what doesn't go together."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from styleexp.system import options
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from styleexp.config.schema import Config


def check(config: Config) -> None:
    """Raise `UserError` for an invalid value, naming its key and the allowed values."""
    options.check(config)
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
    if config.simplify is not None:
        from styleexp.inputs.meshes import simplifying

        simplifying.check()
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
