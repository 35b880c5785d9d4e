"""Finds an LLVM for Mitsuba's CPU variant, and tries it where a crash does no harm.

Mitsuba accepts a wrong LLVM when it starts and then aborts the whole process at the first render.
So the LLVM is tried in a process of its own first.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import subprocess
import sys
from functools import cache
from pathlib import Path

from styleexp.errors import UserError

VARIANT = "llvm_ad_rgb"
"""The variant of Mitsuba that is used: CPU, differentiable, three colour channels."""

PATH = "DRJIT_LIBLLVM_PATH"
"""The environment variable by which Dr.Jit is told of an LLVM."""

_WHEEL = "karellen-llvm-core"
_INSTALL = "pip install mitsuba drjit karellen-llvm-core"
_OLDEST = 19  # that is known to work; 15 and 16 abort, 14 is refused
_TIMEOUT = 120.0  # seconds

# Traces one ray to a mesh, which is where a wrong LLVM aborts, and differentiates it.
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
    """Make sure that ``import mitsuba`` followed by ``set_variant(VARIANT)`` will work.

    Where ``DRJIT_LIBLLVM_PATH`` is not set, sets it for this process and those it starts to the
    library of the wheel that the extra ``mitsuba`` brings; without the wheel Dr.Jit looks for the
    system's. A path that is set is kept, whatever it names. Raises ``UserError`` where a package is
    missing or the trial fails. Takes half a second, once a process.
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
            f"renderer=mitsuba_ad can't use the LLVM that {PATH} names, '{given}' ({problem}): "
            f"unset {PATH} to use the one that {_INSTALL} brings on Linux x86-64, or name the "
            f"libLLVM.so of LLVM {_OLDEST} or newer."
        )
    which = f"the LLVM of {_WHEEL}, '{library}'" if library else "an LLVM of the system's"
    raise UserError(
        f"renderer=mitsuba_ad can't use {which} ({problem}): {_INSTALL}, which brings a working "
        f"one on Linux x86-64, or name the libLLVM.so of LLVM {_OLDEST} or newer in {PATH}."
    )


def from_wheel() -> Path | None:
    """The ``libLLVM.so`` that ``karellen-llvm-core`` installed, if it is there."""
    try:
        files = importlib.metadata.files(_WHEEL) or []
    except importlib.metadata.PackageNotFoundError:
        return None
    libraries = [Path(str(f.locate())) for f in files if f.name.startswith("libLLVM.so")]
    # The plain name is a link that the wheel makes when Python first starts: it may be missing.
    found = sorted(f.resolve() for f in libraries if f.exists())
    return found[0] if found else None


def _try() -> str | None:
    """What is wrong with the LLVM that would be used, or None."""
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
    return lines[-1].rstrip(".") if lines else f"a trial render gave {trial.returncode}"
