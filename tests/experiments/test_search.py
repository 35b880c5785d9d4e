"""``+search=optuna``: real trials, and which of them are pruned."""

import json
import random

import pytest

from styleexp.experiments.sweeps import objective, pruning
from styleexp.system.errors import UserError
from tests.helpers import warm

pytest.importorskip("hydra_plugins.hydra_optuna_sweeper", reason="needs the extra search")


def search(cwd, *more):
    return warm.run(
        "-m", "styleexp", "+search=optuna", "source=torus", "style=bubble", "profile=smoke",
        "encoder=vgg19_random", "hydra.sweep.dir=all", *more, cwd=cwd, env=warm.coarse(),
    )  # fmt: skip


def test_a_search_runs_its_trials_and_goes_on_with_more_and_prunes(tmp_path):
    import yaml

    more = ("hydra.sweeper.n_jobs=1", "metrics.judge=vgg19_random", "metrics.windows=2",
            "hydra.job.env_set.STYLEEXP_PRUNE_AFTER=2")  # fmt: skip
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

    for folder in (tmp_path / "all" / "0", tmp_path / "all" / "1"):  # say they were better by far
        noted = json.loads((folder / "trial.json").read_text())
        assert sorted(noted["scores"]) == ["1", "3"]  # a third and two thirds of four steps
        (folder / "trial.json").write_text('{"scores": {"1": 9, "3": 9}}')
    for told in ("pruned: after step 1 ", "already pruned: "):
        done = search(tmp_path, "hydra.sweeper.n_trials=3", *more)
        assert done.returncode == 0, done.stderr
        assert told in done.stdout
    noted = json.loads((tmp_path / "all" / "2" / "trial.json").read_text())
    assert noted["told"] <= min(scores)
    best = yaml.safe_load((tmp_path / "all" / "optimization_results.yaml").read_text())
    assert best["best_value"] == max(scores)
    rows = (tmp_path / "all" / "table.csv").read_text().splitlines()
    assert ",pruned," in rows[3]
    assert "after step 1 its score was" in rows[3]
    page = (tmp_path / "all" / "report.html").read_text()
    assert '<div><dt>pruned</dt><dd class="state pruned">1</dd></div>' in page
    assert "after step 1 its score was" in page

    # Being measured on the way changes no result, and a pruned trial can be finished by hand.
    done = warm.run("-m", "styleexp", "resume=all/2", cwd=tmp_path, env=warm.coarse())
    assert done.returncode == 0, done.stderr
    words = json.loads((tmp_path / "all" / "2" / "run.json").read_text())["overrides"]
    alone = ("hydra.run.dir=alone", "hydra.mode=RUN")
    done = warm.run("-m", "styleexp", *words, *alone, cwd=tmp_path, env=warm.coarse())
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "alone" / "result.ply").read_bytes() == (
        tmp_path / "all" / "2" / "result.ply"
    ).read_bytes()


def test_a_search_without_a_judge_says_what_it_lacks(tmp_path):
    done = search(tmp_path, "hydra.sweeper.n_trials=1", "hydra.sweeper.n_jobs=1")
    assert done.returncode == 2
    last = done.stderr.strip().splitlines()[-1]
    assert "a search needs match and craft" in last
    assert "Traceback" not in done.stderr


def trial_folder(folder, value, scores, **noted):
    """A finished trial: with that match at its end, and these scores on the way."""
    folder.mkdir(parents=True)
    (folder / "status.json").write_text('{"status": "done"}')
    (folder / "run.json").write_text('{"config": {}}')
    (folder / "metrics.json").write_text(json.dumps({"match": value, "craft": 4.0}))
    (folder / objective.TRIAL).write_text(json.dumps({"scores": scores, **noted}))


@pytest.fixture
def searching(monkeypatch):
    monkeypatch.setenv(objective.LEAST_CRAFT, "3")
    monkeypatch.setenv(pruning.AT, "0.25 0.5")
    monkeypatch.setenv(pruning.AFTER, "4")


@pytest.mark.filterwarnings("ignore::optuna.exceptions.ExperimentalWarning")
@pytest.mark.parametrize("seed", range(6))
def test_trials_are_pruned_as_by_optunas_median_pruner(seed, tmp_path, searching):
    import optuna

    rng = random.Random(seed)
    study = optuna.create_study(
        direction="maximize", pruner=optuna.pruners.MedianPruner(n_startup_trials=4)
    )
    for number in range(rng.choice((3, 4, 7))):
        scores = {step: rng.uniform(1, 5) for step in (10, 20)}
        trial_folder(tmp_path / str(number), rng.uniform(1, 5), scores)
        value = objective.objective(tmp_path / str(number))
        study.add_trial(
            optuna.create_trial(
                value=value, intermediate_values=scores, state=optuna.trial.TrialState.COMPLETE
            )
        )
    (tmp_path / str(number + 1)).mkdir()
    ours, theirs = pruning.trial(tmp_path / str(number + 1), 1), study.ask()
    for step in (10, 20):
        assert ours.due(step, 40)
        score = rng.uniform(1, 5)
        theirs.report(score, step)
        reason = ours.verdict(step, {"match": score, "craft": 3.5})
        assert (reason is not None) == theirs.should_prune()
    assert not ours.due(11, 40)


def test_a_trial_is_judged_by_finished_trials_of_earlier_batches_alone(tmp_path, searching):
    for number, match in enumerate((4.0, 3.0, 3.5, 4.5)):
        trial_folder(tmp_path / str(number), match, {"10": 4.0})
    trial_folder(tmp_path / "4", 5.0, {"10": 1.0}, told=1.0)  # pruned, and finished by hand
    trial_folder(tmp_path / "5", 5.0, {"10": 9.0})
    trial_folder(tmp_path / "6", 5.0, {"10": 9.0})  # of the same batch
    (tmp_path / "7").mkdir()
    (tmp_path / "5" / "status.json").write_text('{"status": "failed"}')
    good, bad = ({"match": match, "craft": 3.0} for match in (4.2, 3.9))
    assert pruning.trial(tmp_path / "7", 2).verdict(10, good) is None
    (tmp_path / "7" / objective.TRIAL).unlink()
    assert "4 finished trials 4" in pruning.trial(tmp_path / "7", 2).verdict(10, bad)
    assert objective.objective(tmp_path / "7") == 3.0  # no better than the worst finished one


@pytest.mark.parametrize(
    ("shares", "after"), [("0.5 1.5", "5"), ("half", "5"), ("0", "5"), ("0.5", "0"), ("0.5", "x")]
)
def test_settings_that_are_none_get_one_sentence(shares, after):
    with pytest.raises(UserError, match="give shares of the steps between 0 and 1"):
        pruning.settings({pruning.AT: shares, pruning.AFTER: after})
    assert pruning.settings({pruning.AT: "", pruning.AFTER: after}) is None
    assert pruning.settings({pruning.AT: "0.2 0.5", pruning.AFTER: "3"}) == ((0.2, 0.5), 3)
    assert pruning.settings({}) is None


def test_a_search_refuses_such_settings_before_it_writes_anything(tmp_path):
    done = search(tmp_path, "hydra.job.env_set.STYLEEXP_PRUNE_AT=2")
    assert done.returncode == 2
    assert done.stderr.startswith("styleexp: hydra.job.env_set.STYLEEXP_PRUNE_AT='2' with ")
    assert list(tmp_path.iterdir()) == []
