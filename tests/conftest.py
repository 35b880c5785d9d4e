"""Shared by all tests. Named meshes and pictures are looked up beside the checkout."""

import os
from pathlib import Path

import pytest

# Read when torch loads, here and in the processes that tests start.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

BESIDE = Path(__file__).parent.parent.parent / "shared"
if "STYLEEXP_ASSETS" not in os.environ and BESIDE.is_dir():
    os.environ["STYLEEXP_ASSETS"] = str(BESIDE)


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
