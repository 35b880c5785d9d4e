"""The wheel, away from the checkout."""

import os
import subprocess
import sys
import zipfile

import pytest

from tests.helpers import ROOT


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    done = subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", folder, ROOT],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return next(folder.glob("*.whl"))


def test_wheel_holds_every_configuration_and_module(wheel):
    held = set(zipfile.ZipFile(wheel).namelist())
    files = {f"styleexp/conf/{p.relative_to(ROOT / 'conf')}" for p in ROOT.glob("conf/**/*.yaml")}
    files |= {str(p.relative_to(ROOT / "src")) for p in ROOT.glob("src/styleexp/**/*.py")}
    files |= {f"styleexp/notebooks/{path.name}" for path in ROOT.glob("reports/*.py")}
    files |= {
        str(path.relative_to(ROOT / "src"))
        for folder in ("assets", "vendor")
        for path in (ROOT / "src/styleexp/experiments/reports" / folder).iterdir()
    }
    assert not files - held
    assert "styleexp/py.typed" in held
    assert any(name.endswith("licenses/LICENSE") for name in held)


def test_installed_wheel_runs_from_an_empty_folder(wheel, tmp_path):
    target, empty = tmp_path / "site", tmp_path / "empty"
    empty.mkdir()
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", target]
    subprocess.run([*pip, wheel], check=True)
    environment = {**os.environ, "PYTHONPATH": str(target)}
    where = subprocess.run(
        [sys.executable, "-c", "import styleexp; print(styleexp.__file__)"],
        cwd=empty, env=environment, capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    assert where.startswith(str(target)), "the checkout was imported, not the wheel"
    arguments = [
        "source=torus",
        "style=bubble",
        "method=robust",
        "profile=smoke",
        "encoder=vgg19_random",
    ]
    done = subprocess.run(
        [sys.executable, "-m", "styleexp", *arguments, "hydra.run.dir=run"],
        cwd=empty, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert (empty / "run" / "result.glb").exists()
