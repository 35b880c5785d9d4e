"""Any file name is a file name: on the command line, in Python, in a plan and in a sweep."""

from __future__ import annotations

import csv
import json
import os
from pathlib import Path

import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from styleexp.cli import arguments
from styleexp.config import overrides
from styleexp.config.compose import compose
from styleexp.system.errors import UserError
from tests.helpers import warm
from tests.helpers.corpus.writers import obj

NAMES = (
    "my file (1).obj", "a=b.obj", "a,b.obj", "李明.obj", "Käse.obj", "part#2.obj",
    "salt&pepper.obj", "o'neil.obj", "[x].obj", "{v}.obj", "x!.obj", "50%.obj", "$v.obj",
    "${v}.obj", " both ends .obj", 'say "x".obj', "back\\slash.obj", "a\\'b.obj", "null.obj",
    "1e3.obj", "~tilde.obj", "+plus.obj", "line\nbreak.obj", "tab\t.obj", "x" * 200 + ".obj",
)  # fmt: skip
HARDEST = ("a,b.obj", "my file (1).obj", "o'neil.obj", "${v}.obj", "李明.obj", "back\\slash.obj")
"""Those that a sweep and a plan take: each has another meaning in Hydra's grammar."""
CHEAP = (
    "method=displacement_map", "profile=smoke", "encoder=vgg19_random", "metrics.judge=none",
    "report=false", "preview.turntable_frames=1", "preview.resolution=32",
)  # fmt: skip


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty working folder with a file of each odd name."""
    monkeypatch.chdir(tmp_path)
    for name in NAMES:
        Path(name).write_bytes(obj())
    return tmp_path


def command(*given, cwd, **variables):
    return warm.run("-m", "styleexp", *given, cwd=cwd, env=warm.coarse(**variables))


@pytest.mark.parametrize("name", NAMES, ids=ascii)
def test_an_odd_name_is_that_file_in_every_way_of_giving_it(name, here):
    expected = arguments.for_hydra([f"source.path={name}"])
    assert compose([*expected, "style=bubble"]).source.path == name
    for words in ([name], ["--", name], [f"source={name}"]):
        assert arguments.for_hydra(words) == expected
    assert overrides.understood(arguments.for_hydra([name])) == arguments.for_hydra([name])


TEXT = st.one_of(
    st.text(st.characters(exclude_categories=("Cs",), exclude_characters="/\0"), min_size=1),
    st.text(st.sampled_from("ab'\"\\${}(),=: []#~+-"), min_size=1),
)


@settings(max_examples=200, deadline=None)
@given(TEXT, TEXT)
@example("\\'", "a\\'${b}\\")
@example("${oc.env:HOME}", "x")
def test_any_text_comes_through_hydra_and_its_sweeper(first, second):
    from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from omegaconf import OmegaConf

    parser = OverridesParser.create()
    swept = f"source.path={overrides.quote(first)},{overrides.quote(second)}"
    jobs = BasicSweeper.split_arguments(parser.parse_overrides([swept]), None)[0]
    for (job,), text in zip(jobs, (first, second), strict=True):
        value = parser.parse_overrides([job])[0].value()
        assert OmegaConf.create({"path": value}).path == text


@settings(max_examples=10, deadline=None)
@given(TEXT)
def test_a_file_of_any_name_is_found(tmp_path_factory, text):
    name = f"{text}.obj"
    assume(len(name.encode()) <= 255)
    folder = tmp_path_factory.mktemp("named")
    (folder / name).write_bytes(obj())
    before = os.getcwd()
    os.chdir(folder)
    try:
        config = compose([f"source.path={name}", "style=bubble"])
        assert config.source.path == name
        recorded = json.loads(json.dumps({"source": {"path": name, "name": None}}))
        from styleexp.config.compose import recorded as read

        assert read({**recorded, "style": {"name": "bubble"}}).source.path == name
    finally:
        os.chdir(before)


def test_odd_names_run_in_a_sweep_with_workers_and_keep_their_own_results(here):
    """One job for each name, in processes of joblib: what a record says is what the job took."""
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    done = command(
        "-m", "source.path=" + ",".join(HARDEST), "style=bubble", *CHEAP,
        "launcher=joblib", "hydra.launcher.n_jobs=2", "hydra.sweep.dir=out (1)", cwd=here,
        OMP_NUM_THREADS="1",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    records = [json.loads(p.read_text()) for p in sorted((here / "out (1)").glob("*/run.json"))]
    taken = {Path(r["config"]["source"]["path"]).name for r in records}
    assert taken == set(HARDEST)


def test_odd_names_run_in_a_plan(here):
    pytest.importorskip("pandas")
    chosen = list(HARDEST[2:])
    plan = {
        "profile": "smoke",
        "overrides": list(CHEAP[:1] + CHEAP[2:]),
        "experiments": [{"name": "李 pairs", "pairs": [[name, "stripe"] for name in chosen]}],
    }
    (here / "plan.yaml").write_text(json.dumps(plan))
    code = "import sys; from styleexp.cli.sweep import main; sys.exit(main())"
    done = warm.run("-c", code, "plan.yaml", cwd=here, env=warm.coarse())
    assert done.returncode == 0, done.stderr + done.stdout
    assert warm.run("-c", code, "collect", "outputs/plan", cwd=here).returncode == 0
    with open(here / "outputs/plan/runs.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(chosen)
    records = [json.loads(p.read_text()) for p in (here / "outputs/plan").rglob("run.json")]
    assert {Path(r["config"]["source"]["path"]).name for r in records} == set(chosen)


def test_two_words_are_source_and_style(here):
    assert overrides.understood(["critter", "bubble"]) == ["source=critter", "style=bubble"]
    words = overrides.understood(["my file (1).obj", "her.ply", "profile=fast"])
    assert words == ["source.path='my file (1).obj'", "style.path=her.ply", "profile=fast"]
    assert overrides.understood(["~logger"]) == ["~logger"]  # Hydra's deletion
    with pytest.raises(UserError, match="'x' is one word too many"):
        overrides.understood(["critter", "bubble", "x"])
    for empty in ("", " ", "source=", "style.path="):
        with pytest.raises(UserError, match=r"one word is empty|has no value"):
            overrides.understood(["critter", empty])
    with pytest.raises(UserError, match="the source is given twice"):
        overrides.understood(["critter", "source.path=x.obj"])


def test_a_comma_separates_in_a_sweep_unless_it_belongs_to_a_file(here):
    def swept(value):
        return overrides.understood([f"source.path={value}"], multirun=True)[0]

    assert swept("x.obj,y.obj") == "source.path=x.obj,y.obj"
    assert swept("a,b.obj") == "source.path='a,b.obj'"
    assert swept("x.obj,a,b.obj,y.obj") == "source.path=x.obj,'a,b.obj',y.obj"
    assert swept("'q,r.obj',y.obj") == "source.path='q,r.obj',y.obj"
    assert swept("glob(*)") == "source.path=glob(*)"
    (here / "E=f.obj").write_bytes(obj())
    two = overrides.understood(["E=f.obj,a=b.obj", "bubble"], multirun=True)
    assert two == ["source.path='E=f.obj','a=b.obj'", "style=bubble"]
    one = overrides.understood(["source=a.obj,b.obj"], multirun=True)
    assert one == ["source.path=a.obj,b.obj"]
    with pytest.raises(UserError, match="mixes files with the name 'critter'"):
        overrides.understood(["source=a.obj,critter"], multirun=True)
    with pytest.raises(UserError, match="add -m"):
        overrides.understood(["source.path=Käse.obj,x!.obj"])


def test_the_home_folder_is_found(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "my.obj").write_bytes(obj())
    for word in ("source.path=~/my.obj", "~/my.obj"):
        assert overrides.understood([word]) == [f"source.path={tmp_path / 'my.obj'}"]


def test_a_known_name_wins_over_a_file_and_an_interpolation_stays_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "critter").write_bytes(obj())
    assert overrides.understood(["critter"]) == ["source=critter"]
    assert overrides.understood(["source.path=${oc.env:HOME}/x.obj"]) == [
        "source.path=${oc.env:HOME}/x.obj"
    ]
    assert overrides.understood(["encoder.weights=null"]) == ["encoder.weights=null"]


def test_flags_may_stand_anywhere():
    assert arguments.for_hydra(["critter", "--cfg", "job", "bubble"]) == [
        "--cfg", "job", "source=critter", "style=bubble",
    ]  # fmt: skip
    for words, told in (
        (["--cfgs", "job"], "did you mean '--cfg'"),
        (["critter", "--cfg"], "needs a value"),
        (["--experimental-rerun", "x.pickle"], "is not supported"),
    ):
        with pytest.raises(UserError, match=told):
            arguments.for_hydra(words)


def test_a_name_that_is_no_utf8_is_refused_before_anything_is_written(tmp_path):
    name = os.fsdecode(b"\xff.obj")
    (tmp_path / name).write_bytes(obj())
    done = command(name, "bubble", *CHEAP, cwd=tmp_path)
    assert done.returncode == 2
    assert "is not valid UTF-8" in done.stderr
    assert not (tmp_path / "outputs").exists()
