"""Self-contained pages without network access.

Scripts, styles, pictures and meshes are embedded. A content security policy allows only the page's
own script, by its hash, so a name from a file can't become code even if it were not escaped (the
templates escape everything).
"""

from __future__ import annotations

import base64
import functools
import gzip
import hashlib
import io
import json
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from markupsafe import Markup

from styleexp.system import atomic

if TYPE_CHECKING:
    from PIL import Image

FORMATS = ("PNG", "GIF")
"""Accepted formats of a run's pictures; others could make Pillow start external programs."""
GZIP_LEVEL = 6
THUMBNAIL = 300
"""Longer side of a sweep's thumbnails in pixels."""


def render(template: str, scripts: Sequence[str], **values: Any) -> str:
    """Render a page from its template, with the named scripts in order."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(lambda name: asset(name)),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"number": number, "duration": duration}
    script = "\n".join(asset(name) for name in scripts)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return environment.get_template(template).render(
        script=Markup(script),  # ours, without "</script"
        script_hash=f"sha256-{digest}",
        style=Markup(asset("page.css")),
        **values,
    )


def asset(name: str) -> str:
    """Read a bundled template, style sheet or script."""
    return (resources.files("styleexp.experiments.reports") / "assets" / name).read_text(
        encoding="utf-8"
    )


@functools.cache
def viewer() -> dict[str, str]:
    """The 3D viewer: ``code`` (compressed, base64) and ``licences``."""
    vendor = resources.files("styleexp.experiments.reports") / "vendor"
    code = (vendor / "model-viewer-umd.min.js.gz").read_bytes()
    return {
        "code": base64.b64encode(code).decode(),
        "licences": (vendor / "model-viewer.LICENCES.txt").read_text(encoding="utf-8"),
    }


def packed(content: bytes) -> str:
    """Compress and base64-encode bytes for a data block; the page inflates them."""
    return base64.b64encode(gzip.compress(content, GZIP_LEVEL, mtime=0)).decode()


def data_uri(picture: Image.Image, longest: int, kind: str = "WEBP") -> str:
    """Encode a picture as a data URI, scaled down to ``longest`` pixels on its longer side."""
    shown = picture.convert("RGB")
    shown.thumbnail((longest, longest))
    out = io.BytesIO()
    shown.save(out, kind, quality=85)
    return f"data:image/{kind.lower()};base64,{base64.b64encode(out.getvalue()).decode()}"


def picture(path: Path, longest: int) -> str | None:
    """Encode a picture file, or an animation's first frame, as a data URI; None if unreadable."""
    from PIL import Image

    try:
        with Image.open(path, formats=FORMATS) as opened:
            return data_uri(opened, longest)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):  # a damaged file
        return None


def views(folder: Path, row: int) -> list[Image.Image]:
    """The four views in a row of a run's ``preview.png``: 0 the source, 1 the style, 2 the result.

    Empty if there is no such picture or its layout differs.
    """
    from PIL import Image

    try:
        with Image.open(folder / "preview.png", formats=FORMATS) as opened:
            sheet = opened.convert("L")
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return []
    size = sheet.width // 4
    band = max(18, size // 12)  # as in `previews.sheet`
    if sheet.height != 3 * (size + band):
        return []
    top = row * (size + band) + band
    return [sheet.crop((k * size, top, (k + 1) * size, top + size)) for k in range(4)]


def save(path: Path, text: str) -> Path:
    """Write a page atomically."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return atomic.write(path, atomic.text(text))


def number(value: Any) -> str:
    """Format a number with four digits; anything else unchanged."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return plain(value)
    return str(value) if isinstance(value, int) else f"{value:.4g}"


def plain(value: Any) -> str:
    """A configuration value as typed on the command line."""
    if value is None or isinstance(value, bool | list | dict):
        return json.dumps(value)
    return str(value)


def duration(seconds: float | None) -> str:
    """Format seconds for people."""
    if seconds is None:
        return "–"
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.1f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
