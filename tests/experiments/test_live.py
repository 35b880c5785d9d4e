"""The page of a run while it goes."""

import json
import time

import numpy as np
import pytest

from styleexp.experiments import live
from styleexp.runs.records import RunFolder
from tests.helpers import warm
from tests.helpers.browser import browser, check_quiet, wait


@pytest.fixture
def folder(tmp_path):
    folder = RunFolder(tmp_path / "run")
    folder.path.mkdir()
    config = {"source": {"path": "<img src=x onerror=alert(1)>.obj"}, "style": {"name": "bubble"}}
    folder.begin({"schema": 1, "key": "0", "config": config, "overrides": ["style=bubble"]})
    return folder


class Stepped:
    step, loss = 1, 0.5


def drawn(monkeypatch):
    """The results that are asked for and drawn, and a stand-in for drawing that takes 0.1 s."""
    asked = []

    def draw(self, kind, vertices, faces):
        asked.append(kind)
        time.sleep(0.1)

    class Subject:
        class frame:
            apply = staticmethod(lambda points: points)

    class Result:
        subject, vertices, faces = Subject, np.zeros((3, 3)), np.zeros((1, 3), int)

    monkeypatch.setattr(live.Live, "_draw", draw)
    return asked, lambda: Result


def test_drawing_takes_a_small_share_of_the_time(folder, monkeypatch):
    asked, result = drawn(monkeypatch)
    monkeypatch.setattr(live, "SEVERAL", 0.01)
    look = live.Live(folder, wanted=True)
    begun = time.monotonic()
    while time.monotonic() - begun < 1:
        look.step(Stepped, 10, result)
        time.sleep(0.01)
    assert len(asked) == 1  # the next one is due after 0.1 s / SHARE
    look._drawn -= 0.1 / live.SHARE
    look.step(Stepped, 10, result)
    look.end()
    assert len(asked) == 2


def test_a_run_without_page_draws_and_writes_nothing(folder, monkeypatch):
    asked, result = drawn(monkeypatch)
    look = live.Live(folder, wanted=False)
    look.step(Stepped, 10, result)
    look.result(result())
    look.end()
    assert not asked
    assert not look.path.exists()


def test_the_page_says_how_a_run_ended_and_names_are_only_names(folder):
    look = live.Live(folder, wanted=True)
    deadline = time.monotonic() + 60
    while not look.path.exists():
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert 'data-goes="1"' in look.path.read_text()
    folder.write_status("failed", reason="the disk is <full>")
    look.end()
    text = look.path.read_text()
    assert 'data-goes="0"' in text
    assert "the disk is &lt;full&gt;" in text
    assert f"styleexp resume={folder.path}" in text
    assert "&lt;img src=x" in text
    assert "<img src=x" not in text


def test_a_removed_folder_is_not_made_again(folder):
    look = live.Live(folder, wanted=True)
    for path in folder.path.iterdir():
        path.unlink()
    folder.path.rmdir()
    look.end()
    assert not folder.path.exists()


def test_an_open_page_follows_a_run_to_its_result(tmp_path):
    folder = tmp_path / "run"
    process = warm.start(
        "-m", "styleexp", "torus", "bubble", "method=robust", "profile=smoke",
        "encoder=vgg19_random", "optim.steps=60", f"hydra.run.dir={folder}",
        cwd=tmp_path, env=warm.coarse(), stdout=warm.PIPE,
    )  # fmt: skip
    with browser(tmp_path / "browser") as page:
        page_file = folder / "report.html"
        deadline = time.monotonic() + 120
        while not page_file.exists():
            assert time.monotonic() < deadline
            time.sleep(0.05)
        page.get(page_file.as_uri())
        wait(page, "[...document.images].some(i => i.alt.includes('unfinished') && i.naturalWidth)")
        assert page.find_element("tag name", "progress").get_attribute("max") == "60"
        told, _ = process.communicate(timeout=240)
        assert process.returncode == 0
        assert told.count(str(page_file)) == 2  # while it goes, and at the end
        wait(page, "document.getElementById('stage')?.dataset.shown")  # nobody has touched the page
        check_quiet(page)
    assert json.loads((folder / "status.json").read_text())["status"] == "done"
