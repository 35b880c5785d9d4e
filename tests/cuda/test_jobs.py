"""Whole runs on a CUDA device: every method, field, encoder and kind of style, and what is around
them."""

import json
from functools import partial

import numpy as np
import pytest
import torch

from styleexp import plugins
from styleexp.config import build
from styleexp.config.compose import compose
from styleexp.experiments import execute, metrics
from styleexp.experiments.bench import render, step
from styleexp.experiments.bench.task import make_task
from styleexp.runs import previews
from styleexp.system.errors import UserError
from tests.helpers.images import grain

pytestmark = [
    pytest.mark.usefixtures("gpu", "coarse_shapes"),
    pytest.mark.filterwarnings("ignore:the encoder 'vgg19_random'"),
]
SMALL = (
    "source=torus",
    "profile=smoke",
    "encoder=vgg19_random",
    "encoder.precision=fp32",
    "loss.layers=[conv1_1,conv2_1]",
    "optim.steps=2",
    "threads=1",
)


def result(*words):
    """The result of a run, and its losses."""
    method, scene = build.prepare(compose([*SMALL, *words]))
    state = method.start(scene)
    losses = [step.loss for step in method.optimise(scene, state)] if state is not None else []
    return method.finish(scene, state), losses


@pytest.mark.parametrize(
    "words",
    [
        ("method=paper", "shading.outlines=true"),
        ("method=robust",),
        ("method=robust", "encoder.precision=bf16", "loss.target=same_views"),
        ("method=robust", "shading.outlines=true", "field.start=source", "views.perspective=0.5"),
        ("method=vertex",),
        ("method=displacement_map",),
    ],
    ids=" ".join,
)
def test_a_run_gives_what_it_gives_on_the_cpu(words):
    found, losses = result(*words, "style=bubble", "device=cuda")
    expected, on_cpu = result(*words, "style=bubble", "device=cpu")
    assert found.subject.surface.vertices.is_cuda
    rough = any("bf16" in word for word in words)
    assert losses == pytest.approx(on_cpu, rel=2e-2 if rough else 1e-3)
    # Adam's first steps are as long as any other, whatever the gradient: a gradient of zero, but
    # for rounding, may go either way.
    apart = np.abs(found.vertices - expected.vertices).max(1)
    size = np.abs(expected.displacement).max() + 1e-4
    assert np.quantile(apart, 0.9) < (0.2 if rough else 0.05) * size


RUN = {"fourier_mlp", "vertex", "gram"}
"""Fields and losses of the runs above."""
OWN_WEIGHTS = {"clip"}
"""Needs weights that the user has."""


@pytest.mark.parametrize(
    "words",
    [
        ("method=synthesis", "source.refine=none"),
        (
            "method=geometric_textures",
            "baseline.base=50",
            "baseline.levels=1",
            "baseline.iterations=2",
        ),
        *(
            ("method=robust", "field.start=source", f"{each.kind}={each.name}")
            for each in plugins.everything()
            if each.kind in ("field", "loss") and each.name not in RUN | OWN_WEIGHTS
        ),
    ],
    ids=" ".join,
)
def test_every_other_method_field_and_loss_runs(words):
    found, losses = result(*words, "style=bubble", "device=cuda")
    assert found.subject.surface.vertices.is_cuda
    assert np.isfinite(losses).all()
    assert np.isfinite(found.vertices).all()
    assert np.abs(found.displacement).max() > 0


@pytest.mark.parametrize("method", ["paper", "displacement_map"])
def test_a_picture_much_finer_than_the_source(tmp_path, method):
    """CUDA shrinks an image by no more than about 94 times."""
    picture = grain(tmp_path / "fine.png", 2000)
    words = (f"method={method}", f"style.path={picture}", "style.image_tile=0.2", "device=cuda")
    found, _ = result(*words)
    assert np.isfinite(found.vertices).all()


def test_the_command_writes_everything_and_goes_on_from_a_checkpoint(tmp_path, monkeypatch):
    """Preview, turntable, page and metrics too."""
    words = ["method=robust", "style=bubble", "device=cuda", "metrics.judge=vgg19_random",
             "metrics.windows=4", "preview.resolution=32", "preview.turntable_frames=2",
             "optim.checkpoint_every=1"]  # fmt: skip
    real = execute.records.RunFolder.append_metrics

    def crash(self, step):
        real(self, step)
        if step.step == 2:
            raise RuntimeError("pulled the plug")

    with monkeypatch.context() as patch:
        patch.setattr(execute.records.RunFolder, "append_metrics", crash)
        with pytest.raises(RuntimeError, match="the plug"):
            execute.run(compose([*SMALL, *words]), tmp_path, [])
    assert execute.resume(tmp_path) == 0
    record = json.loads((tmp_path / "run.json").read_text())
    assert record["device"] == "cuda:0"
    assert record["gpu"]["name"]
    assert record["gpu"]["tf32"] == {"convolutions": False, "products": False}
    lines = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [1, 2]
    found = json.loads((tmp_path / "metrics.json").read_text())
    assert np.isfinite(found["style_distance"])
    for name in ("result.ply", "preview.png", "turntable.gif", "report.html"):
        assert (tmp_path / name).stat().st_size > 0


def test_the_device_draws_and_judges_as_the_cpu_does():
    found, _ = result("method=displacement_map", "style=bubble", "device=cpu")
    config = compose([*SMALL, "style=bubble"])
    views = found.vertices, found.faces, [10.0], [20.0], 64
    one, other = (previews.render_views(*views, device=device) for device in ("cpu", "cuda"))
    assert (one == other).mean() > 0.999
    source, style = found.subject.source, found.subject.style
    measured = []
    for device in ("cpu", "cuda"):
        judge = metrics.load_judge("vgg19_random", 4, device)
        assert next(judge.encoder.parameters()).device.type == device
        measured.append(metrics.measure(config, source, style, found.vertices, found.faces, judge))
    assert measured[0] == pytest.approx(measured[1], rel=0.05)


def test_the_benchmarks_run():
    row = render.measure(make_task("bubble", 500, 1, 32), ["soft_raster"], torch.device("cuda"), 1)
    assert row["device"] == "cuda"
    found = step.measure([*SMALL, "method=robust", "style=bubble", "device=cuda"], 1)
    assert found["device"] == "cuda:0"
    assert found["machine"]["gpus"]


def test_memory_that_runs_out_is_told_with_a_remedy(tmp_path, monkeypatch):
    def full(*given):
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.50 GiB. GPU 0 has a")

    config = compose([*SMALL, "method=robust", "style=bubble", "device=cuda"])
    monkeypatch.setattr("styleexp.renderers.soft_raster.SoftRaster.render", full)
    with pytest.raises(UserError) as caught:
        execute.run(config, tmp_path, [])
    told = str(caught.value)
    assert "not enough memory on the GPU for this run (failed to allocate 2.50 GiB)" in told
    assert "views.count" in told
    assert "device=cpu" in told


def test_statistics_of_another_gpu_are_not_read(gpu, monkeypatch):
    from styleexp.method.gram_cache import GramCache

    encoder = plugins.load_encoder("vgg19_random", device="cuda")
    digest = partial(GramCache((), encoder)._digest, [])
    here = digest()
    assert digest() == here
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda *_: "another GPU")
    assert digest() != here
