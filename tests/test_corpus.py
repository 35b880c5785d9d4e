"""Every file of the corpus comes out as it should; see docs/robustness.md for the list."""

from __future__ import annotations

import pytest
from corpus import CASES
from trying import check

pytestmark = pytest.mark.filterwarnings("ignore")


@pytest.fixture(scope="session")
def shared(tmp_path_factory):
    return tmp_path_factory.mktemp("shared")


@pytest.mark.parametrize("name", CASES, ids=lambda name: ascii(name)[1:-1])
def test_case(name, tmp_path, shared):
    check(CASES[name], tmp_path, shared)
