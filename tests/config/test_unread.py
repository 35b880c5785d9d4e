"""Options that change nothing: each method's declaration is what it reads, and the user is told."""

from dataclasses import is_dataclass

import numpy as np
import pytest
from PIL import Image

import styleexp
from styleexp.config import build, unread
from styleexp.config.compose import compose
from styleexp.inputs import meshes, shapes
from styleexp.plugins.catalogue import BASELINES
from tests.helpers import warm

LEARNS = "which neither renders nor learns: add method=robust to learn."
OPTIONS = {
    "synthesis": ("source.refine=none", "baseline.bank=500"),
    "displacement_map": ("baseline.patch=0.9",),
    "geometric_textures": ("baseline.levels=1", "baseline.iterations=1", "optim.steps=1"),
}
OTHERS = (
    "profile=full", "layers=low", "renderer=moderngl_deferred", "encoder=vgg19_random",
    "field=vertex", "field.bound=0.5", "field.start=source", "field.zero_mean=false",
    "views.fov=50", "views.local.extent=0.2", "shading.lights=1", "shading.albedo=0.9",
    "loss=clip", "loss.target=same_views", "loss.relief_weight=0", "optim.schedule=step",
    "style.image_contrast=0.3", "style.image_match_mean=false",
)  # fmt: skip
"""What no method without learning reads."""


class Recorder:
    """An object whose attributes are noted when they are read."""

    def __init__(self, inner, name, seen):
        self._inner, self._name, self._seen = inner, name, seen

    def __getattr__(self, attribute):
        value, key = getattr(self._inner, attribute), f"{self._name}.{attribute}"
        if is_dataclass(value):
            return Recorder(value, key, self._seen)
        self._seen.add(key)
        return value


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Overrides of a run that takes moments."""
    folder = tmp_path_factory.mktemp("meshes")
    for name in ("sphere", "bubble"):
        mesh = shapes.make(name, 1000)
        meshes.save_mesh(mesh, mesh.vertices, folder / f"{name}.obj")
    rows = np.sin(np.arange(64) / 3)[:, None] * 100 + 128
    Image.fromarray(np.repeat(rows, 64, axis=1).astype(np.uint8)).save(folder / "rows.png")
    return (f"source.path={folder}/sphere.obj", f"style.path={folder}/bubble.obj")


def result(config):
    method, prepared = build.prepare(config)
    state = method.start(prepared)
    for _ in method.optimise(prepared, state):
        pass
    return method.finish(prepared, state).vertices


@pytest.mark.parametrize("name", BASELINES)
def test_what_a_method_declares_is_what_it_reads(name, small, monkeypatch):
    monkeypatch.setattr(build, "check", lambda config: None)  # which reads all
    config = compose([*small, f"method={name}", *OPTIONS[name]])
    seen = set()
    for part in ("renderer", "encoder", "field", "views", "shading", "loss", "optim"):
        setattr(config, part, Recorder(getattr(config, part), part, seen))
    result(config)
    # The bound is measured with the relief and goes into the record alone; checkpoints are the
    # command's.
    seen -= {"field.bound", *unread.EVERY_RUN}
    assert seen == set(BASELINES[name].reads) - {"optim.checkpoint_every"}


@pytest.mark.parametrize("style", ["bubble.obj", "rows.png"])
@pytest.mark.parametrize("name", ["synthesis", "displacement_map"])
def test_what_is_said_to_have_no_effect_has_none(name, style, small):
    source, mesh = small
    plain = [source, mesh.replace("bubble.obj", style), f"method={name}", *OPTIONS[name]]
    config = compose([*plain, *OTHERS])
    told = unread.note([config], [*plain, *OTHERS])
    assert told == f"{', '.join(OTHERS)} have no effect on the result with method={name}, {LEARNS}"
    assert (result(config) == result(compose(plain))).all()


@pytest.mark.parametrize(
    ("given", "unread_ones"),
    [
        (["renderer=mitsuba_ad", "optim.steps=500"], "renderer=mitsuba_ad, optim.steps=500 have"),
        (["profile=fast"], "profile=fast has"),
        (["profile=fast,full"], "profile=fast,full has"),
        (["+switch=lights"], "+switch=lights has"),
        (["+switch=image_tone"], "+switch=image_tone has"),
        (["optim.seed=3", "field.unfold=false", "field.sigma=4", "strength=0.5"], None),
        (["profile=smoke"], None),  # which makes the pictures smaller, too
        (["+switch=sigma"], None),
        (["source=torus", "style.scale=2", "pair=x", "+experiment=lambda_ablation"], None),
        (["hydra.run.dir=run", "threads=1", "report=false", "preview=pyrender"], None),
        (["style.rotation=30", "metrics.windows=4", "source.path='a b.obj'"], None),
    ],
)
def test_which_options_are_told(given, unread_ones):
    told = unread.note([compose([])], given)
    expected = f"{unread_ones} no effect on the result with method=synthesis, {LEARNS}"
    assert told == (unread_ones and expected)


def test_the_check_view_compares_with_the_renderer():
    given = ["preview=pyrender", "renderer=moderngl_deferred"]
    assert unread.note([compose(given)], given) is None


def test_methods_that_learn_read_more():
    assert unread.note([compose(["method=robust"])], OTHERS) is None
    given = ["optim.steps=5", "layers=low"]
    told = unread.note([compose(["method=geometric_textures"])], given)
    assert told == "layers=low has no effect on the result with method=geometric_textures."


def test_in_a_sweep_only_what_no_job_reads_is_told():
    jobs = [compose([f"method={name}"]) for name in ("synthesis", "displacement_map")]
    told = unread.note(jobs, ["profile=fast", "field.sigma=3,4", "optim.steps=5,6"])
    assert told.startswith("profile=fast, optim.steps=5,6 have no effect on the result with ")
    assert told.endswith(f"method=synthesis or displacement_map, {LEARNS}")
    assert unread.note([*jobs, compose(["method=robust"])], ["profile=fast"]) is None


def test_python_is_warned(small):
    source, style = (each.partition("=")[2] for each in small)
    with pytest.warns(UserWarning, match=r"^profile=fast has no effect .* with method=disp"):
        styleexp.stylize(source, style, "profile=fast", "method=displacement_map")


def test_the_command_says_so_once_and_nothing_of_what_an_experiment_chose(small, tmp_path):
    (tmp_path / "conf" / "experiment").mkdir(parents=True)
    (tmp_path / "conf" / "experiment" / "two.yaml").write_text(
        "# @package _global_\ndefaults:\n  - override /method: displacement_map\n"
        "field: {start: source}\nviews: {fov: 50}\n"
        "hydra: {mode: MULTIRUN, sweeper: {params: {loss.lambda_local: '1,2'}}}\n"
    )
    few = ("profile=fast", "baseline.patch=0.9", "metrics.judge=none", "report=false", "threads=1",
           "preview.resolution=48", "preview.turntable_frames=2")  # fmt: skip

    def lines(*arguments):
        done = warm.run(
            "-m", "styleexp", "--config-dir", "conf", "+experiment=two", *small, *few, *arguments,
            cwd=tmp_path, env=warm.coarse(),
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return [line for line in done.stdout.splitlines() if "effect" in line]

    told = f"has no effect on the result with method=displacement_map, {LEARNS}"
    assert lines("hydra.sweep.dir=all") == [f"note: profile=fast {told}"]
    assert len(list((tmp_path / "all").glob("*/result.ply"))) == 2
    assert lines("hydra.mode=RUN", "hydra.run.dir=run") == [f"note: profile=fast {told}"]
