"""``+experiment=backend_agreement``: a real sweep over the backends that are installed."""

import json

from tests.helpers import warm


def sweep(folder, renderers, *flags, **environment):
    arguments = ["+experiment=backend_agreement", "source=torus", "profile=smoke", "optim.steps=8"]
    arguments += ["encoder=vgg19_random", f"renderer={renderers}", "hydra.sweep.dir=all"]
    done = warm.run(
        "-m", "styleexp", *flags, *arguments, cwd=folder, env=warm.coarse(**environment)
    )
    return done, json.loads((folder / "all" / "agreement.json").read_text())


def test_backends_are_compared(tmp_path):
    renderers = "soft_raster,moderngl_deferred,mitsuba_ad"
    done, rows = sweep(tmp_path, renderers, "-m")
    assert done.returncode == 0, done.stderr
    assert [row["renderer"] for row in rows] == renderers.split(",")
    assert rows[0]["distance"] == 0
    for row in rows[1:]:
        assert row["correlation"] > 0.9
        assert row["picture"] < 0.02
    assert (tmp_path / "all" / "figure.png").exists()
    assert "correlation" in done.stdout


def test_a_failed_backend_is_shown_as_failed_and_the_others_are_compared(tmp_path):
    """Also without ``-m``: the experiment says by itself that it is a sweep."""
    missing = {"DRJIT_LIBLLVM_PATH": "/nowhere/libLLVM.so"}
    done, rows = sweep(tmp_path, "soft_raster,mitsuba_ad", **missing)
    assert done.returncode == 2
    assert [row["status"] for row in rows] == ["done", "failed"]
    assert "LLVM" in rows[1]["reason"]
    assert (tmp_path / "all" / "figure.png").exists()
