"""The loop in plain PyTorch that examples/ has."""

import importlib.util
from pathlib import Path

import pytest

import styleexp

PATH = Path(__file__).resolve().parents[2] / "examples/plain_loop.py"


@pytest.mark.filterwarnings("ignore:the encoder 'vgg19_random'")
def test_it_runs_without_a_configuration_and_lowers_its_loss(monkeypatch, tmp_path):
    spec = importlib.util.spec_from_file_location("plain_loop", PATH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(module, "SIZE", 64)
    losses = module.main(encoder="vgg19_random", steps=12)
    assert len(losses) == 12
    assert sum(losses[-4:]) < sum(losses[:4])
    assert len(styleexp.load_mesh("bumpy.ply").vertices) > 5000


def test_it_needs_neither_hydra_nor_the_configuration():
    text = PATH.read_text()
    assert "hydra" not in text
    assert "styleexp.config" not in text
    assert len([line for line in text.splitlines() if line.strip()]) < 80
