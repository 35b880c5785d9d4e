"""Print docs/conformance.md: ``python -m styleexp.testing``."""

from styleexp.testing import conformance_table

print("# Conformance of the renderers\n")
print("Made by `make conformance` from `styleexp.testing`; a test compares it. `yes`: the check")
print("passes; `n/a`: the backend does not claim what the check is about, for the reason below.\n")
print(conformance_table())
