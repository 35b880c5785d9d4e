"""Every file of the corpus comes out as it should; see docs/robustness.md for the list."""

from __future__ import annotations

import pytest

from benchmarks import robustness
from tests.helpers import warm
from tests.helpers.corpus import CASES, REFUSED, REPAIRED
from tests.helpers.corpus.writers import obj
from tests.helpers.trying import OVERRIDES, check

pytestmark = [pytest.mark.filterwarnings("ignore"), pytest.mark.usefixtures("valid_glbs")]


@pytest.fixture(scope="session")
def shared(tmp_path_factory):
    return tmp_path_factory.mktemp("shared")


@pytest.mark.parametrize("name", CASES, ids=lambda name: ascii(name)[1:-1])
def test_case(name, tmp_path, shared):
    check(CASES[name], tmp_path, shared)


THROUGH_THE_COMMAND = (
    "soup.stl", "link.obj", "moving.webp", "new\nline.obj", "cut60.glb", "vast.png", "up.gltf",
    "nan.ply", "draco.glb", "cycle.glb", "folder.obj/inside.txt", "source.png",
)  # fmt: skip


@pytest.mark.parametrize("name", THROUGH_THE_COMMAND, ids=lambda name: ascii(name)[1:-1])
def test_through_the_command(name, tmp_path):
    """A real process: its exit code, its one line, and what it leaves in the run's folder."""
    case = CASES[name]
    path = str(case.write(tmp_path)).replace("\\", "\\\\").replace("'", "\\'")
    (tmp_path / "ball.obj").write_bytes(obj())
    given = ["source.path=ball.obj", f"style.path='{path}'"]
    if not case.style:
        given = [f"source.path='{path}'", "style.path=ball.obj"]
    done = warm.run(
        "-m", "styleexp", *given, *OVERRIDES, "report=false", "preview.turntable_frames=1",
        "hydra.run.dir=run", cwd=tmp_path,
    )  # fmt: skip
    assert "Traceback" not in done.stderr
    left = {file.name for file in (tmp_path / "run").iterdir()}
    if case.outcome == REFUSED:
        assert done.returncode == 2
        lines = [x for x in done.stderr.splitlines() if x.strip() and "vgg19_random" not in x]
        assert len(lines) == 1, done.stderr
        assert case.says in lines[0]
        assert not left & {"result.ply", "result.obj", "result.glb"}
    else:
        assert done.returncode == 0, done.stderr
        assert {"result.ply", "result.obj", "result.glb"} <= left
        if case.outcome == REPAIRED:
            assert case.says in done.stdout + done.stderr


def test_the_page_lists_the_corpus_as_it_is():
    text = robustness.PAGE.read_text(encoding="utf-8")
    assert text == robustness.page(text), "run: python -m benchmarks.robustness"
    assert len(CASES) >= 150
