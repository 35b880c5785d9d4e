"""Benchmarks and profiles: ``styleexp-bench``. Results: docs/benchmarks.md."""
