"""The table in the docs is what the checks say now."""

from styleexp.testing import conformance_table
from tests.helpers import ROOT

PAGE = ROOT / "docs" / "conformance.md"


def test_the_docs_show_the_outcome_of_the_checks():
    """`make conformance` writes the page anew."""
    assert conformance_table() in PAGE.read_text(encoding="utf-8")
