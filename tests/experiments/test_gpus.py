"""Several GPUs, of which there are only the names: one job a GPU."""

import json
import os
import tempfile

import pytest

from styleexp.experiments.sweeps import launchers
from styleexp.system import gpus
from tests.experiments.test_sweeps import sweep, write_plan
from tests.helpers import warm

PLAN = """\
profile: smoke
overrides: [method=displacement_map, source=torus, metrics.judge=none, report=false, threads=1]
experiments:
  - name: styles
    figure: Fig. 2
    minutes: {smoke: 1}
    overrides: ["style=bubble,rail,stripe"]
"""


@pytest.fixture
def alone(monkeypatch, tmp_path):
    """No GPU is known or taken."""
    for name in (gpus.VISIBLE, gpus.GIVEN, "SUBMITIT_EXECUTOR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(gpus, "DRIVER", tmp_path / "driver")
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    return tmp_path


def test_visible_gpus_are_those_given_else_the_machines(alone, monkeypatch):
    assert gpus.visible() == []
    assert gpus.take_one() is None
    assert gpus.VISIBLE not in os.environ
    for name in ("0000:01:00.0", "0000:02:00.0", "0000:03:00.0"):
        (alone / "driver" / name).mkdir(parents=True)
    assert gpus.visible() == ["0", "1", "2"]
    monkeypatch.setenv(gpus.VISIBLE, "GPU-ab12, 2")
    assert gpus.visible() == ["GPU-ab12", "2"]
    monkeypatch.setenv(gpus.VISIBLE, "")
    assert gpus.visible() == [], "all are hidden"


def test_what_submitit_hides_from_its_local_processes_is_found(alone, monkeypatch):
    monkeypatch.setenv(gpus.VISIBLE, "3,5")
    gpus.remember()
    monkeypatch.setenv(gpus.VISIBLE, "")
    assert gpus.visible() == [], "hidden by the user"
    monkeypatch.setenv("SUBMITIT_EXECUTOR", "local")
    assert gpus.visible() == ["3", "5"]


TAKES = """
import os, sys, time
from pathlib import Path
from styleexp.system import gpus
first, again = gpus.take_one(), gpus.take_one()
assert first == again == os.environ["CUDA_VISIBLE_DEVICES"], (first, again)
print(first, flush=True)
while not Path(sys.argv[1]).exists():
    time.sleep(0.02)
"""


def test_each_process_takes_another_gpu_and_more_processes_share(alone):
    environment = {**os.environ, gpus.VISIBLE: "4,6", "TMPDIR": str(alone)}
    end = alone / "end"
    taken, processes = [], []
    try:
        for _ in range(3):
            process = warm.start("-c", TAKES, str(end), env=environment, stdout=warm.PIPE)
            processes.append(process)
            taken.append(process.stdout.readline().strip())
    finally:
        end.touch()
    assert [process.wait(60) for process in processes] == [0, 0, 0]
    assert taken[:2] == ["4", "6"]
    assert taken[2] in ("4", "6")
    again = warm.run("-c", TAKES, str(end), env=environment)
    assert again.stdout.strip() == "4", "it is free once its process has ended"


@pytest.mark.parametrize("launcher", ["joblib", "submitit_local"])
def test_a_plan_has_a_job_on_each_gpu(launcher, alone):
    plan = write_plan(alone, PLAN)
    arguments = ("--launcher", launcher, "--jobs", "2", "--folder", "out")
    done = sweep(plan, *arguments, cwd=alone, CUDA_VISIBLE_DEVICES="1,3", TMPDIR=str(alone))
    assert done.returncode == 0, done.stderr
    records = [json.loads(path.read_text()) for path in alone.glob("out/*/*/run.json")]
    used = [record["visible_gpus"] for record in records]
    assert len(used) == 3
    assert set(used) <= {"1", "3"}, "each sees one"
    if launcher == "joblib":  # whose workers stay, side by side
        assert set(used) == {"1", "3"}


def test_who_asks_for_a_gpu_or_none_isnt_given_another(alone, monkeypatch):
    class Hydra:
        class launcher:
            _target_ = "hydra_plugins.hydra_joblib_launcher.joblib_launcher.JoblibLauncher"

    monkeypatch.setenv(gpus.VISIBLE, "0,1")
    for device in ("cpu", "cuda:1"):
        launchers.place(Hydra, device)
        assert os.environ[gpus.VISIBLE] == "0,1"
    launchers.place(Hydra, "auto")
    assert os.environ[gpus.VISIBLE] == "0"
