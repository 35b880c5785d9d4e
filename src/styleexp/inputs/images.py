"""Load common raster images as RGB floats, with one-sentence errors for bad files."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from styleexp.inputs import deep_images
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from jaxtyping import Float
    from PIL import Image
    from torch import Tensor

    Array = TypeVar("Array", np.ndarray, Tensor)

MIN_SIDE = 16
"""Minimum side in pixels: the deepest style layer has one cell per 16 pixels."""
FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "GIF", "BMP", "PPM", "JPEG2000", "AVIF")
"""Accepted raster formats. Others, such as EPS, would make Pillow start external programs."""
TEXTURE_FORMATS = (*FORMATS, "TGA", "DDS", "MPO")


def load_image(path: str | Path, *, background: float = 1.0) -> Float[np.ndarray, "height width 3"]:
    """Read a picture as float32 RGB in [0, 1], row 0 at the top.

    Supports PNG, JPEG, WebP, TIFF and others (:data:`FORMATS`) in colour, grey, palette or CMYK,
    with or without alpha; 16-bit PNG and TIFF at full depth (scaled by 65535); and half, single and
    double precision TIFF within [0, 1]. The EXIF rotation is applied. Animations return their first
    frame. Values are as stored (sRGB-encoded); colour profiles are not applied.

    Args:
        path: the file. The format is detected from its content, not its name.
        background: grey level in [0, 1] under transparent pixels. Default: white, as in the paper.

    Raises:
        UserError: missing, empty, truncated, not a raster image, under 16 pixels per side, or over
            Pillow's limit on pixels (``PIL.Image.MAX_IMAGE_PIXELS``).
    """
    path = Path(path)
    head = _head(path)

    from PIL import Image, ImageOps, UnidentifiedImageError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            Image.init()
            readable = [name for name in FORMATS if name in Image.OPEN]
            deep = None
            if deep_images.is_tiff(head) and _deep(path):
                limits = Image.MAX_IMAGE_PIXELS, MIN_SIDE
                deep = deep_images.read_tiff(path, background, *limits)
            if deep is not None:
                pixels, frames = deep
                _one_of(frames, path)
                return pixels
            with Image.open(path, formats=readable) as image:
                if min(image.size) < MIN_SIDE:
                    raise UserError(
                        f"the image '{path}' is {image.width}x{image.height} pixels; "
                        f"it needs at least {MIN_SIDE} on each side."
                    )
                frames = getattr(image, "n_frames", 1)
                if image.format != "MPO":  # MPO files of phones also hold a thumbnail
                    _one_of(frames, path)
                if deep_images.is_png(head):
                    turn = image.getexif().get(0x0112, 1)
                    pixels = deep_images.read_png(path, background, turn)
                else:
                    pixels = _rgb(ImageOps.exif_transpose(image), path, background)
    except UserError:
        raise
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise UserError(
            f"the image '{path}' has more than {Image.MAX_IMAGE_PIXELS} pixels; scale it down (a "
            "few thousand per side are plenty)."
        ) from error
    except UnidentifiedImageError as error:
        raise UserError(f"the image '{path}' {_guess(head)}") from error
    # Pillow's decoders raise almost anything on damaged files (OSError, SyntaxError, ValueError,
    # struct.error, EOFError, ...); to the user it is all the same.
    except Exception as error:
        reason = str(error).rstrip(".") or type(error).__name__
        raise UserError(
            f"the image '{path}' is damaged or truncated and cannot be decoded ({reason})."
        ) from error
    return pixels


def is_normal_map(rgb: Float[np.ndarray, "height width 3"]) -> bool:
    """Whether the colours are unit normals of one side of a surface, encoded as ``rgb = (n + 1) /
    2``.

    Nearly all must have length 1 and point up, and so must their mean.
    """
    step = max(1, int(np.sqrt(rgb.shape[0] * rgb.shape[1] / 250_000)))
    normals = 2.0 * rgb[::step, ::step].reshape(-1, 3) - 1.0
    unit = np.abs(np.linalg.norm(normals, axis=1) - 1.0) < 0.1
    x, y, z = normals.mean(axis=0)
    upward = (normals[:, 2] > 0).mean() > 0.99
    return bool(unit.mean() > 0.95 and upward and z > 0.6 and max(abs(x), abs(y)) < 0.2)


def from_array(picture: np.ndarray) -> Float[np.ndarray, "height width 3"]:
    """Convert an image array to float32 RGB in [0, 1]. Accepts grey, RGB or RGBA (composited over
    white), as 8- or 16-bit integers or as floats in [0, 1].

    Raises `UserError` whose message is a sentence without its subject, which the caller adds.
    """
    if picture.ndim == 2:
        picture = picture[..., None]
    if picture.ndim != 3 or picture.shape[2] not in (1, 3, 4):
        raise UserError(
            f"is an array of shape {picture.shape}: a picture is (height, width) or (height, "
            "width, channels) with 1, 3 or 4 channels."
        )
    if min(picture.shape[:2]) < MIN_SIDE:
        raise UserError(
            f"is a picture of {picture.shape[1]}x{picture.shape[0]} pixels; it needs at least "
            f"{MIN_SIDE} on each side."
        )
    if picture.dtype in (np.uint8, np.uint16):
        values = picture.astype(np.float32) / np.iinfo(picture.dtype).max
    elif np.issubdtype(picture.dtype, np.floating):
        values = picture.astype(np.float32)
        if not (np.isfinite(values).all() and values.min() >= 0 and values.max() <= 1):
            raise UserError("is a picture with floats outside [0, 1]: rescale them first.")
    else:
        raise UserError(
            f"is a picture of {picture.dtype}: give 8 or 16 bit integers, or floats in [0, 1]."
        )
    if values.shape[2] == 4:
        alpha = values[..., 3:]
        values = values[..., :3] * alpha + (1 - alpha)
    return np.repeat(values, 3, axis=2) if values.shape[2] == 1 else values


def _one_of(frames: int, path: Path) -> None:
    if frames > 1:
        text = f"'{path}' has {frames} frames or pages: the first one"
        warnings.warn(f"{text} is used.", stacklevel=3)


def _deep(path: Path) -> bool:
    """Whether a TIFF has more than eight bits per sample, or is unknown to Pillow."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path, formats=["TIFF"]) as image:
            return max(image.tag_v2.get(258, (1,))) > 8  # type: ignore[attr-defined]
    except UnidentifiedImageError:
        return True


def fault(content: bytes) -> str:
    """Why a mesh's texture can't be decoded, as the predicate of a sentence; empty if it can."""
    import io

    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            Image.init()
            readable = [name for name in TEXTURE_FORMATS if name in Image.OPEN]
            with Image.open(io.BytesIO(content), formats=readable) as image:
                return fault_of(image)
    except Image.DecompressionBombError:
        return f"has more than {Image.MAX_IMAGE_PIXELS} pixels"
    except Exception:  # as in `load_image`
        return "is not a readable image"


def fault_of(image: Image.Image) -> str:
    """Like `fault`, for an image already opened by Pillow. Decodes it."""
    from PIL import Image

    if image.format is not None and image.format not in TEXTURE_FORMATS:
        return f"has the unsupported format {image.format}"
    if Image.MAX_IMAGE_PIXELS and image.width * image.height > Image.MAX_IMAGE_PIXELS:
        return f"has more than {Image.MAX_IMAGE_PIXELS} pixels"
    try:
        image.load()
    except Exception:  # as in `load_image`
        return "is damaged or truncated"
    return ""


def check(path: Path) -> None:
    """Raise the `UserError` of a file that `load_image` can't read for its first bytes."""
    head = _head(path)

    from PIL import Image, UnidentifiedImageError

    try:
        Image.open(path).close()
    except UnidentifiedImageError as error:
        if not deep_images.is_tiff(head):
            raise UserError(f"the image '{path}' {_guess(head)}") from error
    except Exception:
        return  # damaged or too large: said by `load_image`


def _head(path: Path) -> bytes:
    if not path.is_file():
        what = "is a folder, not an image" if path.is_dir() else "does not exist"
        raise UserError(f"the image '{path}' {what}.")
    try:
        with path.open("rb") as file:
            head = file.read(1024)
    except OSError as error:
        raise UserError(f"the image '{path}' cannot be read: {error.strerror}.") from error
    if not head:
        raise UserError(f"the image '{path}' is empty (0 bytes).")
    return head


def luminance(rgb: Array) -> Array:
    """Luma of an image, (..., 3) -> (...): 0.299 R + 0.587 G + 0.114 B (ITU-R BT.601).

    The weights apply to sRGB-encoded values, as :func:`load_image` returns. They sum to 1, so grey
    is unchanged. Accepts NumPy arrays and torch tensors.
    """
    return 0.299 * rgb[..., 0] + 0.587 * rgb[..., 1] + 0.114 * rgb[..., 2]


def _rgb(image: Image.Image, path: Path, background: float) -> np.ndarray:
    if image.mode.startswith("I") or image.mode == "F":
        grey = np.asarray(image, dtype=np.float32)
        top = 1.0 if image.mode == "F" else 65535.0
        if not np.isfinite(grey).all() or grey.min() < 0 or grey.max() > top:
            raise UserError(
                f"the image '{path}' has 32-bit values outside [0, {top:g}]; "
                "save it with 8 or 16 bits per channel."
            )
        return np.repeat((grey / np.float32(top))[..., None], 3, axis=-1)
    if image.has_transparency_data:
        rgba = np.asarray(image.convert("RGBA"), dtype=np.float32) / np.float32(255)
        alpha = rgba[..., 3:]
        return rgba[..., :3] * alpha + np.float32(background) * (1 - alpha)
    return np.asarray(image.convert("RGB"), dtype=np.float32) / np.float32(255)


def _guess(head: bytes) -> str:
    """Guess from the first bytes why Pillow doesn't recognise the file."""
    text = head.lstrip(b"\xef\xbb\xbf \t\r\n").lower()
    if text.startswith(b"<svg") or (text.startswith(b"<?xml") and b"<svg" in text):
        return "is an SVG drawing; export it as PNG first."
    if text.startswith((b"<!doctype html", b"<html")):
        return "is a web page, not an image: the download probably went wrong."
    if b"\0" not in head and not head.strip(bytes(range(32, 127)) + b"\t\r\n"):
        return "is a text file, not an image."
    return "is not an image that can be read; use PNG, JPEG, WebP or TIFF."
