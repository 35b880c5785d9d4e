"""Does it install and run: as a wheel, editable, with the core alone, with the oldest and the
newest dependencies, on every Python that is here. Results: docs/compatibility.md.

    pipx run nox -l                       # or: pip install nox; nox -l
    nox -s wheel-3.11                     # one session
    nox                                   # all, on every Python that is found

Each session makes an environment of its own, which is removed at its end (KEEP=1 keeps it), and
takes 1 to 7 GB of disk meanwhile. ``CONSTRAINTS`` is the file of tested versions; ``TORCH`` a
version to take in ``lowest`` and ``newest``, where the index has a CPU build of that one alone.
"""

from __future__ import annotations

import os
import shutil
import tomllib
from pathlib import Path

import nox

ROOT = Path(__file__).parent
PYTHONS = ["3.11", "3.12", "3.13", "3.14"]
CONSTRAINTS = os.environ.get("CONSTRAINTS", str(ROOT / "constraints.txt"))
TORCH = os.environ.get("TORCH", "")
QUICK = (
    "tests/method/test_fields.py", "tests/method/test_losses.py", "tests/inputs/test_shapes.py",
    "tests/method/test_stylize.py", "tests/runs/test_old_runs.py",
)  # fmt: skip
"""Tests that need nothing but the core, and take a minute."""

nox.options.default_venv_backend = "uv|virtualenv"
nox.options.error_on_missing_interpreters = False


def check(session: nox.Session) -> None:
    """A run, its page, its metrics, a sweep and a few tests, away from the checkout."""
    away = Path(session.create_tmp())
    small = ["source=torus", "style=rail", "method=robust", "profile=smoke", "encoder=vgg19_random"]
    session.install("pytest", "jaxtyping")
    with session.chdir(away):
        session.run("python", str(ROOT / "tests" / "helpers" / "installed.py"))
        session.run("styleexp", *small, "metrics.judge=none", "hydra.run.dir=run")
        session.run("styleexp-report", "run")
        session.run("styleexp-metrics", "run", "run", "--judge", "none")
        session.run("styleexp", "-m", *small, "optim.seed=0,1", "hydra.sweep.dir=sweep")
        tests = [str(ROOT / each) for each in QUICK]
        session.run("pytest", "-q", "-p", "no:cacheprovider", *tests)
    listed = ("torch", "numpy", "scipy", "trimesh", "hydra-core", "safetensors")
    session.log("versions: " + ", ".join(f"{n} {_version(session, n)}" for n in listed))


def end(session: nox.Session) -> None:
    """Remove the environment: torch's take gigabytes."""
    if not os.environ.get("KEEP"):
        shutil.rmtree(session.virtualenv.location, ignore_errors=True)


@nox.session(python=PYTHONS)
def wheel(session: nox.Session) -> None:
    """The wheel with the core alone, tested versions."""
    session.run("uv", "build", "--wheel", "--out-dir", session.create_tmp(), str(ROOT),
                external=True)  # fmt: skip
    (built,) = Path(session.create_tmp()).glob("*.whl")
    session.install(str(built), "--constraint", CONSTRAINTS)
    check(session)
    end(session)


@nox.session(python=PYTHONS)
def editable(session: nox.Session) -> None:
    """An editable installation, tested versions."""
    session.install("--editable", str(ROOT), "--constraint", CONSTRAINTS)
    check(session)
    end(session)


@nox.session(python=PYTHONS[0])
def lowest(session: nox.Session) -> None:
    """The oldest versions that pyproject.toml allows."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    bounds = [each.replace(">=", "==").split(",")[0] for each in project["dependencies"]]
    if TORCH:
        bounds = [f"torch=={TORCH}" if each.startswith("torch==") else each for each in bounds]
    session.install(*bounds)
    session.install("--no-deps", str(ROOT))
    check(session)
    end(session)


@nox.session(python=PYTHONS)
def newest(session: nox.Session) -> None:
    """The newest versions that pyproject.toml allows."""
    session.install("--upgrade", str(ROOT), *([f"torch=={TORCH}"] if TORCH else []))
    check(session)
    end(session)


def _version(session: nox.Session, name: str) -> str:
    code = f"import importlib.metadata as m; print(m.version({name!r}))"
    return str(session.run("python", "-c", code, silent=True)).strip()
