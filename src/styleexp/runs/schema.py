"""Version of a run folder's layout. Needs only the standard library."""

from __future__ import annotations

from typing import Any

SCHEMA = 1
"""Layout version. Increase it with every incompatible change, and add code to read older folders.
Folders with a later version are refused: see `too_new`."""


def too_new(content: Any) -> str | None:
    """Why a run's folder can't be used, if a later version of styleexp wrote this JSON file."""
    layout = content.get("schema", 1) if isinstance(content, dict) else 1
    if isinstance(layout, int) and layout <= SCHEMA:
        return None
    return (
        f"its layout is {layout}, but this version of styleexp reads layouts up to {SCHEMA}: use "
        "the version that wrote it, or a later one."
    )
