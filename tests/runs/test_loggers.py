"""What loggers leave, read back by the tools that they are for."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from styleexp.config import compose
from styleexp.experiments import execute as command
from styleexp.plugins import discovery
from styleexp.plugins.loggers import Loggers
from styleexp.runs import records
from styleexp.runs.identity import essence, job_key
from styleexp.system.errors import UserError

SMOKE = (
    "source=torus", "style=bubble", "method=robust", "profile=smoke", "encoder=vgg19_random",
    "report=false", "metrics.judge=none", "metrics.windows=2",
    "preview.turntable_frames=2", "preview.resolution=64", "threads=1",
)  # fmt: skip
LOGGER = """
from dataclasses import dataclass
from styleexp.plugins.spec import Spec

@dataclass
class Options:
    name: str = "broken"

class Broken:
    def log(self, values, step):
        if step == 2:
            raise OSError("the server is gone")
    def finish(self, result, folder): raise AssertionError
    def close(self, status): raise AssertionError

BROKEN = Spec("broken", "breaks", Options, lambda options, **given: Broken())
"""


def stylise(folder, *overrides):
    """The command, in this process, on a small mesh beside the folder."""
    folder.mkdir()
    trimesh.creation.icosphere(subdivisions=3).export(folder.parent / "ball.obj")
    given = [*SMOKE, f"source.path={folder.parent}/ball.obj", *overrides]
    return command.run(compose.compose(given), folder, given)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run that both loggers heard, and that was then gone on with from another folder."""
    for name in ("tensorboard", "mlflow"):
        pytest.importorskip(name, reason=f"{name} is not installed (extra {name})")
    cwd = tmp_path_factory.mktemp("loggers")
    folder = cwd / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(cwd)
        both = ("logger=[tensorboard,mlflow]", "optim.checkpoint_every=3")
        assert stylise(folder, *both) == 0
        # As after a kill -9 while the last checkpoint was being written: step 4 had been logged.
        os.replace(folder / "checkpoint.previous.safetensors", folder / "checkpoint.safetensors")
        (folder / "status.json").write_text('{"schema": 1, "status": "running"}')
        (cwd / "elsewhere").mkdir()
        patch.chdir(cwd / "elsewhere")
        assert command.resume(folder) == 0
    assert not (cwd / "elsewhere" / "outputs").exists()
    return folder


def steps(folder):
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def test_tensorboard_has_scalars_picture_and_meshes(run):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    found = EventAccumulator(
        str(run / "tensorboard"), size_guidance={"images": 0, "tensors": 0}
    ).Reload()
    for key in ("loss", "loss_global", "loss_local", "rms_displacement"):
        told = [(e.step, e.value) for e in found.Scalars(key)]
        assert told == [(s["step"], pytest.approx(s[key], rel=1e-6)) for s in steps(run)]
    final = json.loads((run / "metrics.json").read_text())
    (iou,) = found.Scalars("final/silhouette_iou")
    assert iou.value == pytest.approx(final["silhouette_iou"])
    (picture,) = found.Images("preview")
    with Image.open(run / "preview.png") as preview:
        assert (picture.width, picture.height) == preview.size
    from tensorboard.util.tensor_util import make_ndarray

    written = trimesh.load(run / "result.ply", process=False)
    event = found.Tensors("result_VERTEX")[-1]  # TensorBoard purges no tensors, it shows the last
    shape = make_ndarray(event.tensor_proto)[0]
    assert shape.shape == written.vertices.shape
    radius = np.ptp(written.vertices, axis=0) / np.ptp(shape, axis=0)
    np.testing.assert_allclose(radius, radius[0], rtol=1e-4)  # the same shape, in a unit sphere
    event = found.Tensors("result_FACE")[-1]
    faces = make_ndarray(event.tensor_proto)[0]
    assert len(faces) == len(written.faces)


def test_mlflow_has_parameters_metrics_and_files_in_sqlite(run, tmp_path):
    from mlflow import MlflowClient

    assert (run.parent / "outputs" / "mlflow.db").read_bytes().startswith(b"SQLite format 3")
    client = MlflowClient(f"sqlite:///{run.parent / 'outputs' / 'mlflow.db'}")
    experiment = client.get_experiment_by_name("styleexp")
    (kept,) = client.search_runs([experiment.experiment_id])  # the resumed run is the same one
    assert kept.info.status == "FINISHED"
    assert kept.data.params["style.name"] == "bubble"
    assert kept.data.params["optim.steps"] == "4"
    assert kept.data.tags["styleexp.folder"] == str(run)
    told = client.get_metric_history(kept.info.run_id, "loss")
    assert [(m.step, m.value) for m in told] == [(s["step"], s["loss"]) for s in steps(run)]
    final = json.loads((run / "metrics.json").read_text())
    assert kept.data.metrics["final/silhouette_iou"] == final["silhouette_iou"]
    saved = {each.path for each in client.list_artifacts(kept.info.run_id)}
    assert saved == {"run.json", "metrics.json", "preview.png", "result.glb"}
    copy = client.download_artifacts(kept.info.run_id, "result.glb", str(tmp_path))
    assert Path(copy).read_bytes() == (run / "result.glb").read_bytes()


@pytest.fixture(scope="module")
def broken(tmp_path_factory):
    """A run whose logger broke in the middle."""
    cwd = tmp_path_factory.mktemp("broken")
    (cwd / "lab_logger.py").write_text(LOGGER)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(cwd)
        patch.setenv("STYLEEXP_PLUGINS", "logger=lab_logger:BROKEN")
        told = "'broken' failed .the server is gone.; the run continues"
        with pytest.warns(UserWarning, match=told):
            assert stylise(cwd / "run", "logger=broken") == 0
    return cwd / "run"


def test_a_logger_that_breaks_is_dropped_and_the_run_goes_on(broken):
    assert [each["step"] for each in steps(broken)] == [1, 2, 3, 4]
    record = json.loads((broken / "run.json").read_text())
    assert [each["name"] for each in record["plugins"]] == ["broken"]


def test_results_have_the_same_bits_whoever_listens(run, broken):
    assert (run / "result.ply").read_bytes() == (broken / "result.ply").read_bytes()


@pytest.mark.parametrize("name", ["tensorboard", "mlflow"])
def test_a_missing_package_is_said_before_the_run(name, tmp_path, monkeypatch):
    installed = discovery._importable
    monkeypatch.setattr(discovery, "_importable", lambda each: each != name and installed(each))
    with pytest.raises(UserError, match=rf"needs {name}: pip install 'styleexp\[{name}\]'"):
        stylise(tmp_path / "run", f"logger={name}")
    assert not (tmp_path / "run" / "metrics.jsonl").exists()


def test_loggers_do_not_make_another_job(tmp_path):
    plain = compose.compose(SMOKE)
    told = compose.compose([*SMOKE, "logger=tensorboard", "logger.tensorboard.mesh=false"])
    assert told.logger["tensorboard"].mesh is False
    assert job_key(told) == job_key(plain)
    assert essence(vars(told)).keys() == essence(vars(plain)).keys()
    assert job_key(compose.compose([*SMOKE, "strength=0.5"])) != job_key(plain)


def test_a_store_that_cannot_be_used_is_named(tmp_path):
    pytest.importorskip("mlflow", reason="mlflow is not installed (extra mlflow)")
    (tmp_path / "notes.db").write_text("not a database, but long enough to look at " * 9)
    config = compose.compose([*SMOKE, "logger=mlflow"])
    config.logger["mlflow"].uri = f"sqlite:///{tmp_path / 'notes.db'}"
    with pytest.raises(UserError, match=r"^the MLflow store 'sqlite:.*notes.db' can't be used"):
        Loggers(config, tmp_path, records.describe(config, [], []), 0)
