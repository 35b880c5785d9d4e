"""Shared by all tests. Named meshes and pictures are looked up beside the checkout."""

import os
from pathlib import Path

import pytest

# Read when torch loads, here and in the processes that tests start.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

BESIDE = Path(__file__).parent.parent.parent / "shared"
if "STYLEEXP_ASSETS" not in os.environ and BESIDE.is_dir():
    os.environ["STYLEEXP_ASSETS"] = str(BESIDE)


def available(make):
    """What ``make`` returns. What it lacks, a `UserError`, is a skip, and in CI a failure."""
    from styleexp.errors import UserError

    try:
        return make()
    except UserError as missing:
        if os.environ.get("CI", "") not in ("", "0", "false"):
            pytest.fail(str(missing))
        pytest.skip(str(missing))


@pytest.fixture(scope="session")
def named_mesh():
    """A function from a mesh's name to its file; skips, naming it, where it can't be found."""

    def find(name):
        from styleexp import assets

        path = assets.locate(name, "mesh")
        if path is None:
            pytest.skip(f"the mesh '{name}' is in no folder of STYLEEXP_ASSETS")
        return path

    return find
