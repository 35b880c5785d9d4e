"""Find an LLVM for Mitsuba's CPU variant, and test it in a subprocess.

Mitsuba accepts an unsuitable LLVM at start-up, then aborts the whole process at the first render.
So the LLVM is first tested in a separate process.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import subprocess
import sys
from functools import cache
from pathlib import Path

from styleexp.system.errors import UserError

VARIANT = "llvm_ad_rgb"
"""Mitsuba variant: CPU, differentiable, three colour channels."""

PATH = "DRJIT_LIBLLVM_PATH"
"""Environment variable with the path of Dr.Jit's LLVM."""

_WHEEL = "karellen-llvm-core"
_INSTALL = "pip install mitsuba drjit karellen-llvm-core"
_OLDEST = 19  # oldest known to work; 15 and 16 abort, 14 is rejected
_TIMEOUT = 120.0  # seconds

# Trace a ray to a mesh, which is where an unsuitable LLVM aborts, and differentiate it.
_TRIAL = f"""
import drjit, mitsuba
mitsuba.set_variant("{VARIANT}")
scene = mitsuba.load_dict({{"type": "scene", "mesh": {{"type": "cube"}}}})
key = "mesh.vertex_positions"
parameters = mitsuba.traverse(scene)
drjit.enable_grad(parameters[key])
parameters.update()
hit = scene.ray_intersect(mitsuba.Ray3f([0.1, 0.2, -5], [0, 0, 1]))
drjit.backward(hit.t)
assert abs(hit.t[0] - 4) < 1e-4 and drjit.max(drjit.abs(drjit.grad(parameters[key])))[0] > 0
"""


@cache
def prepare() -> None:
    """Make sure that ``import mitsuba`` and ``set_variant(VARIANT)`` work.

    If ``DRJIT_LIBLLVM_PATH`` is not set, sets it, for this process and its children, to the library
    in the wheel installed by the extra ``mitsuba``; without the wheel, Dr.Jit searches for the
    system's LLVM. An existing value is kept. Raises ``UserError`` if a package is missing or the
    trial fails. Takes half a second, once per process.
    """
    for package in ("drjit", "mitsuba"):
        if importlib.util.find_spec(package) is None:
            raise UserError(
                f"renderer=mitsuba_ad needs the package '{package}', which is not installed: "
                f"{_INSTALL}."
            )
    given = os.environ.get(PATH)
    library = None if given else from_wheel()
    if library is not None:
        os.environ[PATH] = str(library)
    problem = _try()
    if problem is None:
        return
    if given:
        raise UserError(
            f"renderer=mitsuba_ad can't use the LLVM in {PATH}, '{given}' ({problem}): unset "
            f"{PATH} to use the one that {_INSTALL} installs on Linux x86-64, or set it to the "
            f"libLLVM.so of LLVM {_OLDEST} or newer."
        )
    which = f"the LLVM of {_WHEEL}, '{library}'" if library else "the system's LLVM"
    raise UserError(
        f"renderer=mitsuba_ad can't use {which} ({problem}): {_INSTALL}, which installs a working "
        f"one on Linux x86-64, or set {PATH} to the libLLVM.so of LLVM {_OLDEST} or newer."
    )


def from_wheel() -> Path | None:
    """The ``libLLVM.so`` installed by ``karellen-llvm-core``, if any."""
    try:
        files = importlib.metadata.files(_WHEEL) or []
    except importlib.metadata.PackageNotFoundError:
        return None
    libraries = [Path(str(f.locate())) for f in files if f.name.startswith("libLLVM.so")]
    # The plain name is a link that the wheel creates when Python first starts; it may be missing.
    found = sorted(f.resolve() for f in libraries if f.exists())
    return found[0] if found else None


def _try() -> str | None:
    """Test the LLVM that would be used; return the problem, or None."""
    try:
        trial = subprocess.run(
            [sys.executable, "-c", _TRIAL],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=_TIMEOUT,
            errors="replace",
        )
    except subprocess.TimeoutExpired:
        return f"a trial render took more than {_TIMEOUT:.0f} s"
    if trial.returncode == 0:
        return None
    if trial.returncode < 0:
        return f"a trial render was ended by signal {-trial.returncode}"
    if "LLVM backend is inactive" in trial.stderr:
        return "Dr.Jit can't load it"
    lines = [line.strip() for line in trial.stderr.splitlines() if line.strip()]
    return lines[-1].rstrip(".") if lines else f"a trial render exited with {trial.returncode}"
