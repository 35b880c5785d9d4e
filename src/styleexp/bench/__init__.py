"""How fast it is, and where the time goes: ``styleexp-bench``. What came out: docs/benchmarks.md."""
