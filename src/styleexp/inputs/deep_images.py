"""Read images with more than eight bits per channel, which Pillow would truncate to eight.

PNG is decoded by imagecodecs, TIFF by tifffile (which needs imagecodecs for compressed files). Both
are imported lazily.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from jaxtyping import Float

PNG, TIFF = b"\x89PNG\r\n\x1a\n", (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
ASSOCIATED = 1
"""Extra sample type of premultiplied alpha (TIFF 6.0, section 18)."""


def is_png(head: bytes) -> bool:
    """Whether a file with this header is a 16-bit PNG with colours or opacity."""
    return head.startswith(PNG) and head[24:25] == b"\x10" and head[25:26] in b"\2\4\6"


def is_tiff(head: bytes) -> bool:
    """Whether a file with this header is a TIFF."""
    return head.startswith(TIFF)


def read_png(path: Path, background: float, turn: int) -> Float[np.ndarray, "height width 3"]:
    """Read a 16-bit PNG as float32 RGB in [0, 1] over a grey; ``turn`` is its EXIF orientation."""
    import imagecodecs

    values = imagecodecs.png_decode(path.read_bytes())
    return _oriented(_over(values / np.float32(65535), background), turn)


def read_tiff(
    path: Path, background: float, most: int | None, least: int
) -> tuple[Float[np.ndarray, "height width 3"], int] | None:
    """Read a TIFF's first page as float32 RGB in [0, 1] over a grey, and its number of pages.

    Returns None for up to eight bits per channel and for colour spaces other than grey, RGB and
    CMYK, which are left to Pillow. Raises `UserError` for pages with more than ``most`` pixels or a
    side under ``least``, and for values outside [0, 1] or integers of more than 16 bits.
    """
    import tifffile

    with tifffile.TiffFile(path) as file:
        page: Any = file.pages[0]
        kind, bits = page.dtype, page.bitspersample
        photometric = getattr(page.photometric, "name", "")
        known = photometric in ("MINISBLACK", "MINISWHITE", "RGB", "SEPARATED")
        if kind is None or not known or (kind.kind in "ui" and bits <= 8):
            return None
        if most and page.imagewidth * page.imagelength > most:
            raise UserError(
                f"the image '{path}' has more than {most} pixels; scale it down (a few thousand "
                "per side are plenty)."
            )
        if min(page.imagewidth, page.imagelength) < least:
            raise UserError(
                f"the image '{path}' is {page.imagewidth}x{page.imagelength} pixels; "
                f"it needs at least {least} on each side."
            )
        # For volumes and the like, use the first slice.
        values = page.asarray()
        axes = page.axes
        if "S" in axes:
            values = np.moveaxis(values, axes.index("S"), -1)
        while values.ndim > 3 or (values.ndim == 3 and "S" not in axes):
            values = values[0]
        turn = page.tags.valueof(274, 1)
        extra = page.extrasamples
        pages = len(file.pages)
    top = 1.0 if kind.kind == "f" else float(2**bits - 1)
    if kind.kind == "f":
        wrong = not np.isfinite(values).all() or values.min() < 0 or values.max() > 1
    else:
        wrong = kind.kind != "u" or bits > 16
    if wrong:
        raise UserError(
            f"the image '{path}' has values outside [0, 1], or signed integers or integers of more "
            "than 16 bits; save it with 8 or 16 bits per channel."
        )
    values = values.astype(np.float32) / np.float32(top)
    values = values[..., None] if values.ndim == 2 else values
    if photometric == "MINISWHITE":
        values[..., :1] = 1 - values[..., :1]
    if photometric == "SEPARATED":
        values = np.concatenate(
            [(1 - values[..., :3]) * (1 - values[..., 3:4]), values[..., 4:]], axis=-1
        )
    colors = 1 if photometric.startswith("MINIS") else 3
    opacity = extra[:1] in ((1,), (2,))  # others are masks and the like
    values = values[..., : colors + opacity]
    return _oriented(_over(values, background, extra[:1] == (ASSOCIATED,)), turn), pages


def _over(values: np.ndarray, background: float, multiplied: bool = False) -> np.ndarray:
    """Composite grey or RGB, with or without alpha, (height, width[, 1 to 4]), as RGB over a
    grey."""
    values = values[..., None] if values.ndim == 2 else values
    rgb, alpha = values, None
    if values.shape[-1] in (2, 4):
        rgb, alpha = values[..., :-1], values[..., -1:]
    rgb = np.broadcast_to(rgb, (*rgb.shape[:2], 3))
    if alpha is not None:
        rgb = (rgb if multiplied else rgb * alpha) + np.float32(background) * (1 - alpha)
    return np.ascontiguousarray(np.clip(rgb, 0, 1), dtype=np.float32)


def _oriented(rgb: np.ndarray, turn: int) -> np.ndarray:
    """Apply EXIF or TIFF orientation 1 to 8, so that row 0 is at the top."""
    if turn in (5, 6, 7, 8):
        rgb = rgb.swapaxes(0, 1)
    if turn in (3, 4, 7, 8):
        rgb = rgb[::-1]
    if turn in (2, 3, 6, 7):
        rgb = rgb[:, ::-1]
    return np.ascontiguousarray(rgb)
