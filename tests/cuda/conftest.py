"""A CUDA device for these tests: a real one, or one that is simulated on the CPU.

What is simulated raises what a GPU would raise, and counts the host's waits and kernels
(`tests.helpers.simulated_cuda`). It is imported here because it must be before torch's first
backward pass.
"""

import subprocess

import pytest
import torch

from styleexp.system.errors import UserError
from tests.helpers import ROOT
from tests.helpers.needed import available

try:
    if torch.version.cuda is None:
        from tests.helpers import simulated_cuda
    else:
        simulated_cuda = None
    missing = None
except (OSError, subprocess.CalledProcessError) as error:
    missing = f"the simulated CUDA device needs a C++ compiler: {error}"


def _there():
    if missing is not None:
        raise UserError(missing)
    if simulated_cuda is None and not torch.cuda.is_available():
        raise UserError("this torch has CUDA, but sees no device: give CUDA_VISIBLE_DEVICES=0")


@pytest.fixture
def gpu():
    """The simulated device; None where there is a real one."""
    available(_there)
    if simulated_cuda is None or torch.cuda.is_available():  # pytest -p simulates it already
        yield None
        return
    with simulated_cuda.simulate(watch=str(ROOT)) as device:
        yield device


@pytest.fixture
def simulator():
    """The module that simulates, for tests that count."""
    available(_there)
    if simulated_cuda is None or torch.cuda.is_available():
        pytest.skip("the counts are those of a device that only this test simulates")
    return simulated_cuda


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    """Gram matrices are measured, not read."""
    monkeypatch.setenv("STYLEEXP_CACHE", str(tmp_path / "cache"))
