"""How fast it is, and where the time goes: ``styleexp-bench``. Results: docs/benchmarks.md."""
