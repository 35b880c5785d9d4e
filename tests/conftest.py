"""Shared by all tests. Named meshes and pictures are looked up beside the checkout."""

import os
from pathlib import Path

import pytest

from tests.helpers import ROOT
from tests.helpers.needed import available

# Read when torch loads, here and in the processes that tests start.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# A GPU rounds otherwise, and not twice alike: what is tested on one is in tests/cuda, where torch
# may see it: CUDA_VISIBLE_DEVICES=0 make test-cuda.
os.environ.setdefault("CUDA_VISIBLE_DEVICES", "")

BESIDE = ROOT.parent / "shared"
if "STYLEEXP_ASSETS" not in os.environ and BESIDE.is_dir():
    os.environ["STYLEEXP_ASSETS"] = str(BESIDE)


@pytest.fixture(scope="session")
def named_mesh():
    """A function from a mesh's name to its file; skips, naming it, where it can't be found."""

    def find(name):
        from styleexp.inputs import assets

        path = assets.locate(name, "mesh")
        if path is None:
            pytest.skip(f"the mesh '{name}' is in no folder of STYLEEXP_ASSETS")
        return path

    return find


@pytest.fixture
def coarse_shapes(monkeypatch):
    """Analytic shapes of an eighth of their vertices, as commands with `warm.coarse` have."""
    from styleexp.inputs import shapes

    monkeypatch.setattr(shapes, "make", shapes.make)  # to be put back
    from tests.helpers.coarse import sitecustomize

    sitecustomize.coarsen(shapes)


@pytest.fixture(scope="session")
def valid_glbs(tmp_path_factory):
    """Fails in the end if a GLB that was written while it was there is not what glTF allows.

    A glTF file's document comes back as it was, so its own errors aren't held against the result.
    """
    import shutil
    from unittest import mock

    from styleexp.inputs.meshes import reading, writing
    from tests.helpers import gltf_readers

    folder = tmp_path_factory.mktemp("glbs")
    pairs: dict[Path, Path | None] = {}
    sources: dict[int, Path] = {}
    held = []  # so that no other document gets the id of one that is gone
    load, save = reading.load_mesh, writing.save_mesh

    def copied(path, about):
        kept = folder / f"{len(list(folder.iterdir()))}{Path(path).suffix}"
        shutil.copy(path, kept)
        pairs[kept] = about
        return kept

    def load_mesh(path, *more):
        mesh = load(path, *more)
        document = mesh.carrier.document if mesh.carrier else None
        if document is not None and document.tree not in held:
            held.append(document.tree)
            sources[id(document.tree)] = copied(path, None)
        return mesh

    def save_mesh(mesh, vertices, path, *more, **named):
        save(mesh, vertices, path, *more, **named)
        if str(path).endswith(".glb"):
            document = mesh.carrier.document if mesh.carrier else None
            copied(path, sources.get(id(document.tree)) if document is not None else None)

    with (
        mock.patch.object(reading, "load_mesh", load_mesh),
        mock.patch.object(writing, "save_mesh", save_mesh),
    ):
        yield
    available(gltf_readers.tools)
    found = dict(zip(pairs, gltf_readers.errors(*pairs), strict=True)) if pairs else {}
    own = {path: {line.split()[0] for line in lines} for path, lines in found.items()}
    own[None] = set()
    wrong = {
        str(path): lines
        for path, lines in found.items()
        if path not in sources.values() and own[path] - own[pairs[path]]
    }
    assert not wrong
