"""Composing many configurations at once gives what Hydra gives for each."""

from pathlib import Path

import hydra
import pytest
from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from styleexp.config import compose, many
from styleexp.experiments.sweeps import plan
from styleexp.experiments.sweeps.settings import product
from styleexp.system.errors import UserError

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def quick():
    compose.register()
    with hydra.initialize_config_module("styleexp.conf", version_base="1.3"):
        yield many.Composer()


def outcome(function, given):
    try:
        return function(given)
    except (HydraException, OmegaConfBaseException, UserError) as error:
        return type(error), str(error)


def by_hydra(overrides):
    return compose.typed(hydra.compose("config", overrides))


def test_the_overrides_of_every_plan_and_experiment(quick):
    """Every value that any of their jobs sets, as few jobs as have them all."""
    listed, values = [], {}
    for path in sorted((ROOT / "conf" / "experiment").glob("*.yaml")):
        given = [f"+experiment={path.stem}"]
        listed += product(plan._params(given), given)
    for path in sorted((ROOT / "sweeps").glob("*.yaml")):
        read = plan.read(path)
        for entry in read.experiments:
            given = [*read.overrides, *entry.overrides]
            listed += product({}, given)
            listed += [[f"source={source}", f"style={style}"] for source, style in entry.pairs]
    for text in dict.fromkeys(text for job in listed for text in job):
        key = text.partition("=")[0]
        if "." in key or key in ("source", "style"):  # others choose files, by Hydra anyway
            values.setdefault(key, []).append(text)
    assert sum(map(len, values.values())) > 40
    for number in range(max(map(len, values.values()))):
        given = [texts[number % len(texts)] for texts in values.values()]
        given += ["method=robust", "hydra.mode=RUN"]
        assert quick.compose(given) == by_hydra(given)


@pytest.mark.parametrize(
    "given",
    [
        ["threads=2", "debug=true", "device=cuda:1"],
        ["field.sigma=5", "field.bound=null", "style.scale=2"],
        ["loss.block_weights=[1,2,3,4,5]", "style.mask=['attribute:a','not:slope:3']"],
        ["source.path='a b,c.obj'", r"style.path='\${x}.png'", "style.name=null"],
        ["++optim.seed=3", "+report=false"],
        ["optim.seed=${optim.steps}", "optim.steps=7"],
        ["source.name=spot", "source=critter", "~logger"],
        ["method=vertex", "field.smoothness=2", "baseline=null"],
        ["encoder=vgg19", "encoder.name=vgg19_random", "encoder.precision=fp32"],
        ["logger=tensorboard", "logger.tensorboard.every=5"],
        ["views={count: 3}", "views.local.size=9"],
        ["+experiment=layer_ablation", "source=spot", "layers=low", "hydra.mode=RUN"],
        ["+pair=spot_stripe", "source=torus", "profile=smoke"],
        ["optim.seed=1.5"],
        ["optim.sed=1"],
        ["style=strpe"],
        ["source=spot", "source=torus"],
        ["optim=1"],
        ["views.count=1,2"],
    ],
)
def test_every_kind_of_override(given, quick):
    given = ["style=bubble", *given] if not any("style=" in each for each in given) else given
    assert outcome(quick.compose, given) == outcome(by_hydra, given)
    assert outcome(quick.compose, given) == outcome(by_hydra, given)  # from what it remembers


def test_jobs_that_differ_in_values_are_composed_once(quick, monkeypatch):
    calls = []
    ours = many._by_hydra
    monkeypatch.setattr(many, "_by_hydra", lambda given: calls.append(given) or ours(given))
    made = [
        quick.compose([f"source={source}", "style=bubble", "method=text2mesh", f"optim.seed={n}"])
        for source in ("torus", "spot", "critter")
        for n in range(4)
    ]
    assert len(calls) == 1
    assert [each.optim.seed for each in made] == [0, 1, 2, 3] * 3
    assert [each.source.name for each in made[::4]] == ["torus", "spot", "critter"]
