"""Options of the source mesh. Imports nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass

from styleexp.system.options import option


@dataclass
class SourceConfig:
    """The source mesh C. Its overall shape is preserved."""

    name: str | None = None
    """A named asset or analytic shape (``styleexp-assets list``)."""
    path: str | None = None
    """A mesh file; wins over ``name``."""
    weld: float | None = option(None, between=(0.0, 1e100))
    """Merge vertices on open edges within this distance, in the file's units. 0: only coincident
    ones. null: those closer than the file's numeric precision."""
    remesh: int | None = option(None, between=(100, 10_000_000))
    """Remesh to about this many vertices first (drops attributes). null: keep the mesh."""
    refine: str = "none"
    """Refine the mesh. ``auto``: split edges that are too long for the style's relief, placing new
    vertices on a smooth surface through the mesh. Texture coordinates, materials and colours are
    kept. A number: split until there are about this many faces. ``none``: keep the mesh as is, as
    in the paper."""
