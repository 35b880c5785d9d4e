"""Some of the trials of fault_trials.py; `make stress` and benchmarks/faults.py try them all."""

import random

import pytest

from styleexp.runs import records
from tests.helpers.fault_trials import FAULTS, Missing, Stage, kill_run


@pytest.fixture(scope="module")
def stage(tmp_path_factory):
    return Stage(tmp_path_factory.mktemp("faults"))


def test_kill_9_at_any_change_loses_nothing(stage):
    """Every process but the last dies as it writes, removes or moves something."""
    killed, _ = kill_run(stage, random.Random(110), "change", most=3)
    assert killed == 3


@pytest.mark.parametrize(
    "name",
    [
        "disk full under a run",
        "folder made read-only under a run",
        "folder removed under a run",
        "not enough memory for a run",
        "damaged checkpoint, or both, or metrics.jsonl",
        "a second run, and a resume, in a run's folder",
    ],
)
def test_what_a_fault_leaves_can_be_gone_on_with(name, stage):
    try:
        FAULTS[name].tried(stage, random.Random(name))
    except Missing as missing:
        pytest.skip(str(missing))


def test_a_good_checkpoint_outlives_the_next_one_saved_after_a_damaged_one(tmp_path):
    """What is damaged must not take the place of the one before it."""
    import torch

    from styleexp.method.base import State

    def state(step):
        field = torch.nn.Linear(3, 2)
        field.weight.data.fill_(step)
        return State(field, torch.optim.Adam(field.parameters()), step)

    folder = records.RunFolder(tmp_path)
    for step in (1, 2):
        folder.save_checkpoint(state(step))
    content = bytearray(folder.checkpoint.read_bytes())
    content[-1] ^= 1  # a value that safetensors alone would take
    folder.checkpoint.write_bytes(bytes(content))
    found = state(0)
    told = folder.load_checkpoint(found)
    assert "does not match its digest" in told
    assert "using the previous checkpoint" in told
    assert (found.step, found.field.weight[0, 0].item()) == (1, 1)
    folder.save_checkpoint(found)
    folder.checkpoint.unlink()  # killed before the new one was in its place
    previous = state(0)
    assert folder.load_checkpoint(previous) is None
    assert previous.step == 1


def test_with_both_checkpoints_damaged_the_run_begins_anew(tmp_path):
    import torch

    from styleexp.method.base import State

    field = torch.nn.Linear(3, 2)
    begun = State(field, torch.optim.Adam(field.parameters()))
    before = field.weight.clone()
    for name in ("checkpoint.safetensors", "checkpoint.previous.safetensors"):
        (tmp_path / name).write_bytes(b"junk")
    told = records.RunFolder(tmp_path).load_checkpoint(begun)
    assert told.count("is damaged") == 2
    assert told.endswith("restarting the run.")
    assert (begun.step, torch.equal(field.weight, before)) == (0, True)


def test_a_file_elsewhere_is_named_not_the_runs_folder(tmp_path):
    from styleexp.experiments import endings

    folder = records.RunFolder(tmp_path / "run")
    folder.path.mkdir()
    elsewhere = PermissionError(13, "Permission denied", str(tmp_path / "weights.safetensors"))
    message = str(endings.failed_writing(folder, elsewhere))
    assert message.startswith(f"'{tmp_path / 'weights.safetensors'}' can't be read or written")
    full = OSError(28, "No space left on device", str(folder.path / "result.ply"))
    assert f"writing to '{folder.path}' failed" in str(endings.failed_writing(folder, full))
