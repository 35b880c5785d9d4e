"""Collect run folders into tables: ``styleexp.experiments.reports.collect(folder)``."""

from styleexp.experiments.reports.collect import collect

__all__ = ["collect"]
