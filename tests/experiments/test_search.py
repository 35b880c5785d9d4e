"""``+search=optuna``: real trials."""

import pytest

from tests.helpers import warm

pytest.importorskip("hydra_plugins.hydra_optuna_sweeper", reason="needs the extra search")


def search(cwd, *more):
    return warm.run(
        "-m", "styleexp", "+search=optuna", "source=torus", "style=bubble", "profile=smoke",
        "encoder=vgg19_random", "hydra.sweep.dir=all", *more, cwd=cwd, env=warm.coarse(),
    )  # fmt: skip


def test_a_search_runs_its_trials_and_tells_the_best(tmp_path):
    judged = ("metrics.judge=vgg19_random", "metrics.windows=2")
    done = search(tmp_path, "hydra.sweeper.n_trials=2", *judged)
    assert done.returncode == 0, done.stderr
    assert "best_value" in (tmp_path / "all" / "optimization_results.yaml").read_text()
    assert (tmp_path / "all" / "figure.png").exists()
    assert (tmp_path / "all" / "1" / "result.ply").exists()


def test_a_search_without_a_judge_says_what_it_lacks(tmp_path):
    done = search(tmp_path, "hydra.sweeper.n_trials=1", "hydra.sweeper.n_jobs=1")
    assert done.returncode == 2
    last = done.stderr.strip().splitlines()[-1]
    assert "a search needs style_distance and silhouette_iou" in last
    assert "Traceback" not in done.stderr
