"""The version of a run folder's layout. Needs nothing but the standard library."""

from __future__ import annotations

from typing import Any

SCHEMA = 1
"""A change after which older folders can't be read as they are raises it, and comes with what reads
them. Folders of a later version are refused: see `too_new`."""


def too_new(content: Any) -> str | None:
    """Why a run's folder can't be used, where a later version of styleexp wrote this JSON file."""
    layout = content.get("schema", 1) if isinstance(content, dict) else 1
    if isinstance(layout, int) and layout <= SCHEMA:
        return None
    return (
        f"its layout is {layout}, and this version of styleexp reads layouts up to {SCHEMA}: use "
        "the version that wrote it, or a later one."
    )
