"""``+search=optuna``: real trials."""

import json

import pytest

from tests.helpers import warm

pytest.importorskip("hydra_plugins.hydra_optuna_sweeper", reason="needs the extra search")


def search(cwd, *more):
    return warm.run(
        "-m", "styleexp", "+search=optuna", "source=torus", "style=bubble", "profile=smoke",
        "encoder=vgg19_random", "hydra.sweep.dir=all", *more, cwd=cwd, env=warm.coarse(),
    )  # fmt: skip


def test_a_search_runs_its_trials_and_goes_on_with_more(tmp_path):
    import yaml

    more = ("hydra.sweeper.n_jobs=1", "metrics.judge=vgg19_random", "metrics.windows=2")
    done = search(tmp_path, "hydra.sweeper.n_trials=1", *more)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "all" / "figure.png").exists()
    first = (tmp_path / "all" / "0" / "result.ply").stat()
    done = search(tmp_path, "hydra.sweeper.n_trials=2", *more)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("already done") == 1
    assert (tmp_path / "all" / "0" / "result.ply").stat() == first
    assert (tmp_path / "all" / "1" / "result.ply").exists()
    best = yaml.safe_load((tmp_path / "all" / "optimization_results.yaml").read_text())
    measured = [json.loads((tmp_path / f"all/{k}/metrics.json").read_text()) for k in (0, 1)]
    scores = [each["match"] - 2 * max(0, 3 - each["craft"]) for each in measured]
    assert best["best_value"] == max(scores)


def test_a_search_without_a_judge_says_what_it_lacks(tmp_path):
    done = search(tmp_path, "hydra.sweeper.n_trials=1", "hydra.sweeper.n_jobs=1")
    assert done.returncode == 2
    last = done.stderr.strip().splitlines()[-1]
    assert "a search needs match and craft" in last
    assert "Traceback" not in done.stderr
