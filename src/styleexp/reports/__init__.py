"""Collect run folders into tables: ``styleexp.reports.collect(folder)``."""

from styleexp.reports.collect import collect

__all__ = ["collect"]
