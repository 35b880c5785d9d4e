"""Conformance checks for parts, built in or from plugins; see `renderers`."""

from styleexp.testing.renderers import (
    CHECKS,
    NotApplicable,
    check_renderer,
    conformance_table,
)

__all__ = ["CHECKS", "NotApplicable", "check_renderer", "conformance_table"]
