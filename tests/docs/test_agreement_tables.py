"""What docs/metrics.md says of ratings is what the command makes from the committed data."""

import re
from pathlib import Path

import pytest

from benchmarks import agreement
from styleexp.experiments import ratings

PAGES = Path(__file__).parents[2] / "docs"
PAGE = PAGES.joinpath("metrics.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def printed():
    from contextlib import redirect_stdout
    from io import StringIO

    with redirect_stdout(StringIO()) as out, pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["agreement"])
        assert agreement.main() == 0
    return out.getvalue()


def test_the_constants_are_those_fitted_to_the_development_half(printed):
    assert f"MATCH = {ratings.MATCH}" in printed
    assert f"CRAFT = {ratings.CRAFT}" in printed


@pytest.mark.parametrize("name", agreement.SIGNS)
def test_each_row_of_the_table(printed, name):
    told = re.findall(rf"^  {name} +(-?[\d.]+) +([\d.]+) % +(-?[\d.]+) +([\d.]+) %", printed, re.M)
    assert len(told) == 2
    cells = [f"{r}, {float(p):.0f} %" for row in told for r, p in (row[:2], row[2:])]
    assert f"| `{name}` | {' | '.join(cells)} |" in PAGE


def test_each_kind_of_result(printed):
    pattern = r"^  \w+ +(\d+)  (\d\.\d)  (\d\.\d)  (\d\.\d, \d\.\d)$"
    kinds = re.findall(pattern, printed, re.M)
    assert len(kinds) == 28
    for n, match, craft, estimated in kinds:
        assert f"| {n} | {match} | {craft} | {estimated} |" in PAGE


def test_the_paired_difference(printed):
    results = PAGES.joinpath("results.md").read_text(encoding="utf-8")
    found = re.findall(r"(?:match|craft): (\d\.\d+) \((.*)\), (p .*)", printed)
    assert len(found) == 2
    for more, interval, p in found:
        assert f"{more} more ({interval}, {p}" in " ".join(results.split())


def test_every_rated_result_is_measured(printed):
    assert printed.startswith("98 rated results\n")
