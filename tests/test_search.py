"""``+search=optuna``: real trials."""

import importlib.util
import os
import subprocess
import sys

import pytest

pytest.importorskip("hydra_plugins.hydra_optuna_sweeper", reason="needs the extra search")


def test_a_search_runs_its_trials_and_tells_the_best(tmp_path):
    done = subprocess.run(
        [
            sys.executable, "-m", "styleexp", "+search=optuna", "source=torus", "style=bubble",
            "profile=smoke", "encoder=vgg19_random", "hydra.sweeper.n_trials=2",
            "hydra.sweeper.n_jobs=1", "hydra.sweep.dir=all",
        ],
        cwd=tmp_path, env=os.environ, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if importlib.util.find_spec("styleexp.metrics") is None:  # nothing to minimise: it says so
        assert done.returncode == 2
        assert "a search needs style_distance and silhouette_iou" in done.stderr
        assert (tmp_path / "all" / "0" / "result.ply").exists()
        return
    assert done.returncode == 0, done.stderr
    assert "best_value" in (tmp_path / "all" / "optimization_results.yaml").read_text()
    assert (tmp_path / "all" / "figure.png").exists()
    assert (tmp_path / "all" / "1" / "result.ply").exists()
