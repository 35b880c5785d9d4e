"""Pictures as the style: kinds, depths, sizes, and what isn't a picture."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from tests.helpers.corpus.case import Case, group, refused, repaired, works
from tests.helpers.corpus.writers import (
    HTML,
    JUNK,
    TEXT,
    animated,
    deep,
    obj,
    part,
    picture,
    pixels,
    png_claiming,
    rotated,
)


def _kind(kind: str, suffix: str) -> Iterator[Case]:
    """Whole and cut off."""
    yield works(f"good.{suffix}", f"a {kind}", picture(kind))
    for percent in (0, 5, 60):
        cut = part(picture(kind), percent)
        yield refused(f"cut{percent}.{suffix}", f"the first {percent} % of a {kind}", cut)


def _deep_cut(percent: int) -> Iterator[Case]:
    for suffix, whole in (("png", deep(_COLOR)), ("tiff", deep(_COLOR, "tiff", photometric="rgb"))):
        told = f"the first {percent} % of 16-bit colours"
        cut = part(whole, percent)
        yield refused(f"deepcut{percent}.{suffix}", told, cut, "damaged or truncated")


def _normal_map() -> np.ndarray:
    bump = np.gradient(pixels()[..., 0] / 40.0)
    normal = np.stack([-bump[1], -bump[0], np.ones_like(bump[0])], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return ((normal + 1) * 127.5).astype(np.uint8)


_GREY = pixels()[..., 0]
_FLOATS = _GREY.astype(np.float32)
_GREY16 = _GREY.astype(np.uint16) * 257
_COLOR = pixels().astype(np.uint16) * 257 + 3
_OPAQUE = np.full((*_COLOR.shape[:2], 1), 40000, np.uint16)
_RGBA16 = np.concatenate([_COLOR, _OPAQUE], 2)
_LA16 = np.concatenate([_COLOR[..., :1], _OPAQUE], 2)
_LZW = {"photometric": "rgb", "compression": "lzw", "predictor": True}
_SHARE = pixels() / 255
_THIN = np.zeros((1, 30000), np.uint8)
_STRIP = np.resize(_GREY, (16, 30000))
_BLACK, _CLEAR = np.zeros((64, 64), np.uint8), np.zeros((64, 64, 4), np.uint8)
_SVG = b"<svg xmlns='http://www.w3.org/2000/svg'/>"
_EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n"

_STYLES = (
    *_kind("PNG", "png"),
    *_kind("JPEG", "jpg"),
    *_kind("WEBP", "webp"),
    *_kind("TIFF", "tiff"),
    *_kind("BMP", "bmp"),
    *_kind("GIF", "gif"),
    *_kind("PPM", "ppm"),
    *_kind("JPEG2000", "jp2"),
    *_kind("AVIF", "avif"),
    works("renamed.jpg", "a PNG called .jpg", picture("PNG")),
    works("cmyk.jpg", "CMYK", picture("JPEG", mode="CMYK")),
    works("cmyk.tiff", "CMYK", picture("TIFF", mode="CMYK")),
    works("lab.tiff", "CIELAB", picture("TIFF", mode="LAB")),
    works("palette.png", "a palette", picture("PNG", mode="P")),
    works("bits.png", "one bit a pixel", picture("PNG", mode="1")),
    works("grey.png", "grey", picture("PNG", mode="L")),
    works("alpha.png", "transparency", picture("PNG", mode="RGBA")),
    works("greyalpha.png", "grey with transparency", picture("PNG", mode="LA")),
    works("deep.png", "16 bits", picture("PNG", _GREY16)),
    works("deep.tiff", "16 bits", picture("TIFF", _GREY16)),
    works("float.tiff", "32-bit floats", picture("TIFF", _FLOATS / 255)),
    works("rgb16.png", "16 bits of each colour", deep(_COLOR)),
    works("rgba16.png", "16 bits of each colour and of opacity", deep(_RGBA16)),
    works("la16.png", "16 bits of grey and of opacity", deep(_LA16)),
    works("rgb16.tiff", "16 bits of each colour", deep(_COLOR, "tiff", photometric="rgb")),
    works("lzw16.tiff", "16 bits of each colour, compressed", deep(_COLOR, "tiff", **_LZW)),
    works("half.tiff", "half-precision floats",
          deep(_SHARE.astype(np.float16), "tiff", photometric="rgb")),
    works("rgbfloat.tiff", "floats of each colour",
          deep(_SHARE.astype(np.float32), "tiff", photometric="rgb")),
    *_deep_cut(30),
    *_deep_cut(90),
    repaired("normalmap.png", "a normal map", picture("PNG", _normal_map()), "normal map"),
    refused("hdr.tiff", "floats above 1", picture("TIFF", _FLOATS), "outside [0, 1]"),
    refused("nan.tiff", "NaN", picture("TIFF", _FLOATS * np.float32("nan")), "outside [0, 1]"),
    refused("one.png", "1x1", picture("PNG", pixels(1, 1)), "at least 16"),
    refused("thin.png", "30000x1", picture("PNG", _THIN), "at least 16"),
    works("strip.png", "30000x16", picture("PNG", _STRIP)),
    works("least.png", "16x16", picture("PNG", pixels(16, 16))),
    refused("black.png", "black all over", picture("PNG", _BLACK), "uniform tone"),
    refused("clear.png", "wholly transparent", picture("PNG", _CLEAR), "uniform tone"),
    repaired("moving.png", "an animated PNG", animated("PNG"), "has 2 frames"),
    repaired("moving.webp", "an animated WebP", animated("WEBP"), "has 2 frames"),
    repaired("moving.gif", "an animated GIF", animated("GIF"), "has 2 frames"),
    repaired("pages.tiff", "a TIFF of two pages", animated("TIFF"), "has 2 frames"),
    works("rotated.jpg", "turned by its EXIF entry", rotated),
    refused("bomb.png", "900 million pixels in a kilobyte", png_claiming(30000, 30000), "pixels"),
    refused("vast.png", "4 * 10^18 pixels claimed", png_claiming(2**31 - 1, 2**31 - 1)),
    refused("short.png", "more pixels claimed than there are", png_claiming(500, 500),
            "truncated"),
    refused("drawing.png", "an SVG called .png", _SVG, "SVG"),
    refused("drawing.svg", "an SVG", _SVG, "export it as PNG"),
    refused("notes.png", "text called .png", TEXT, "text file"),
    refused("page.jpg", "a web page called .jpg", HTML, "web page"),
    refused("print.png", "an EPS called .png", _EPS, "text file"),
    refused("paper.pdf", "a PDF", b"%PDF-1.4\n" + JUNK, "a picture"),
    refused("noise.webp", "random bytes", JUNK, "not an image"),
    refused("ball.png", "a mesh called .png", obj(), "text file"),
)  # fmt: skip

STYLES = group(
    "pictures as the style",
    *(replace(case, style=True) for case in _STYLES),
    refused("source.png", "a picture as the source", picture("PNG"), "give a mesh"),
)
