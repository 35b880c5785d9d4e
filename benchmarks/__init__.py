"""Measurements and long trials, each run from the checkout: ``python -m benchmarks.NAME``."""
