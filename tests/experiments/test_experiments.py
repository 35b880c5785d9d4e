"""Every experiment: a delta that says what it is for, and runs; its table and its figure."""

import csv
import json
import os
import re
from dataclasses import asdict
from pathlib import Path

import pytest
from omegaconf import OmegaConf
from PIL import Image

from styleexp.config import schema
from styleexp.config.compose import compose
from styleexp.experiments.sweeps import figure, plan, preflight, report
from styleexp.experiments.sweeps.figure import Shown, layout
from styleexp.experiments.sweeps.plan import experiment_jobs
from styleexp.experiments.sweeps.settings import setting, varying
from styleexp.inputs import assets, meshes, shapes
from styleexp.runs.jobs import Job
from tests.helpers import ROOT, warm

CONF = ROOT / "conf"
EXPERIMENTS = sorted((CONF / "experiment").glob("*.yaml"))
GIVEN = ("source=torus", "style=bubble")
"""What an experiment may leave to be chosen, chosen."""

BY_SYNTHESIS = {"board", "image_styles", "mesh_styles", "multi_style"}
"""Experiments that show results, by the default method; others study learning or compare."""

each_experiment = pytest.mark.parametrize("path", EXPERIMENTS, ids=lambda path: path.stem)


def styleexp(*arguments, cwd, **environment):
    return warm.run("-m", "styleexp", *arguments, cwd=cwd, env=warm.coarse(**environment))


def flat(tree, prefix=""):
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value


@each_experiment
def test_experiment_names_its_figure_its_command_and_its_time(path):
    head = path.read_text().split("\n\n")[0]
    assert re.search(r"\((.*; )?(Figs?\. \d|.*no figure)|Figs?\. \d", head)
    assert f"styleexp +experiment={path.stem}" in head
    assert re.search(r"[Mm]inutes.*fast \d+|fast \d+ minutes", head)
    assert re.search(r"standard (about )?\d+", head)
    assert ("With method=robust:" in head) == (path.stem in BY_SYNTHESIS)
    assert (re.search(r"On two cores: \d+ minutes, a", head) is not None) == (
        path.stem in BY_SYNTHESIS
    )


@each_experiment
def test_experiment_is_a_delta(path):
    """It chooses among options, sweeps, and repeats no default."""
    body = OmegaConf.to_container(OmegaConf.load(path), resolve=False)
    defaults = body.pop("defaults", [])
    assert all(next(iter(entry)).startswith("override /") for entry in defaults)
    hydra = body.pop("hydra")
    assert hydra["mode"] == "MULTIRUN"
    assert hydra["sweeper"]["params"]
    default = dict(flat(asdict(compose(GIVEN))))
    assert not [key for key, value in flat(body) if default.get(key) == value]
    assert len(path.read_text().splitlines()) < 30


@each_experiment
def test_every_job_of_every_experiment_is_valid(path):
    read = plan.Plan([plan.Entry(path.stem, path.stem)], profile="smoke")
    planned = plan.jobs(read, Path("out"))[path.stem]
    assert len(planned) > 1
    # Whatever a machine may lack of meshes, pictures, weights and extras, but nothing else.
    lacking = ("is not on this machine", "are not on this machine", "can't be used: needs")
    assert not [told for told in preflight.missing(planned) if not any(x in told for x in lacking)]
    jobs = [job.overrides for job in planned]
    methods = {getattr(job.config.baseline, "name", "learned") for job in planned}
    if path.stem == "methods":  # each contender names its own
        assert methods == {"synthesis", "displacement_map", "learned"}
        return
    robust = compose([*jobs[0], "method=robust", "hydra.mode=RUN"])
    assert (robust.baseline, robust.source.refine) == (None, "none")
    if path.stem.startswith("baselines"):
        assert methods >= {"synthesis", "learned", "displacement_map"}
    else:
        assert methods == {"synthesis" if path.stem in BY_SYNTHESIS else "learned"}


SETS = {
    "robust": {},
    "paper": {},
    "paper_amended": {},
    "vertex": {},
    "text2mesh": {},
    "displacement_map": {"baseline": "displacement_map"},
    "geometric_textures": {"baseline": "geometric_textures"},
    "synthesis": {"baseline": "synthesis", "source.refine": "auto"},
}


@pytest.mark.parametrize("name", SETS)
def test_a_method_sets_what_its_file_says_and_nothing_of_the_default(name):
    """It is `robust`, whose values are the dataclasses', but for its own file."""
    assert {path.stem for path in (CONF / "method").glob("*.yaml")} == set(SETS)
    sized = ["views.local.per_view"]  # by the profile, which comes after
    body = OmegaConf.to_container(OmegaConf.load(CONF / "method" / f"{name}.yaml"))
    chosen = [each for each in body.pop("defaults", []) if isinstance(each, dict)]
    parts = dict(next(iter(each.items())) for each in chosen)
    parts = {key.removeprefix("override /"): value for key, value in parts.items()}
    made, robust = (compose([*GIVEN, f"method={each}"]) for each in (name, "robust"))
    assert (made.baseline and made.baseline.name) == SETS[name].get("baseline")
    assert made.source.refine == SETS[name].get("source.refine", "none")
    assert all(getattr(made, part).name == chosen for part, chosen in parts.items())
    made, robust = (dict(flat(asdict(each))) for each in (made, robust))
    if name == "paper_amended":
        paper = OmegaConf.load(CONF / "method" / "paper.yaml")
        body = OmegaConf.to_container(OmegaConf.merge(paper, body))
    own = {key: value for key, value in flat(body) if key not in sized}
    assert own.items() <= made.items()
    differing = {key for key in made.keys() | robust.keys() if made.get(key) != robust.get(key)}
    assert not {key for key in differing - own.keys() if key.split(".")[0] not in parts}


def test_robust_is_the_dataclasses_defaults():
    made = dict(flat(asdict(compose(["method=robust"]))))
    default = dict(flat(asdict(schema.Config())))
    sizes = dict(flat(OmegaConf.to_container(OmegaConf.load(CONF / "profile" / "standard.yaml"))))
    assert not {key for key in default if made.get(key) != default[key]} - sizes.keys()


@each_experiment
def test_experiment_runs(path, tmp_path):
    """The ends of each of its axes, at ``profile=smoke``."""
    params = OmegaConf.load(path).hydra.sweeper.params
    arguments = []
    for key, values in params.items():
        names = [name.strip() for name in values.split(",")]
        arguments.append(f"{key}={names[0]},{names[-1]}")
    if path.stem == "multi_style":  # one by the default, which takes longer than four steps
        arguments += ["source.refine=none", "baseline.bank=500"]
    elif path.stem in BY_SYNTHESIS:
        arguments.append("method=robust")
    elif "synthesis" in params.get("method", ""):
        arguments.append("source.refine=none")
    elif path.stem == "methods":  # without synthesis, which takes longer than three steps
        arguments[:2] = ["+contender=displacement_map,paper", "+pair=critter_bubble,torus_stripe"]
        arguments.append("source.refine=none")
    for overrides in experiment_jobs([f"+experiment={path.stem}", *arguments]):
        chosen = compose([*overrides, "hydra.mode=RUN"])
        for name in (chosen.source.name, chosen.style.name):
            for kind in ("mesh", "image"):
                if name in assets.names(kind) and assets.locate(name, kind) is None:
                    pytest.skip(f"the {kind} '{name}' is in no folder of STYLEEXP_ASSETS")
    arguments += ["profile=smoke", "encoder=vgg19_random", "hydra.sweep.dir=all", "optim.steps=3"]
    if path.stem.startswith("baselines"):  # which lay more than one kind of relief on spot
        ball = shapes.make("sphere", detail=1000)
        meshes.save_mesh(ball, ball.vertices, tmp_path / "ball.ply")
        arguments.append("source.path=ball.ply")
    done = styleexp(f"+experiment={path.stem}", *arguments, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    jobs = report.planned(tmp_path / "all")
    assert len(jobs) == 2 ** len(params)
    for job in jobs:
        assert json.loads((job.folder / "status.json").read_text())["status"] == "done"
    assert (tmp_path / "all" / "figure.png").exists()


def test_every_switch_between_the_methods_has_its_file():
    """method_ablation covers each key in which ``paper`` differs from ``robust``."""
    paper, robust = (
        dict(flat(asdict(compose([*GIVEN, f"method={name}"])))) for name in ("paper", "robust")
    )
    differing = {key for key in paper if paper[key] != robust[key]}
    flipped = {
        key
        for path in (CONF / "switch").glob("*.yaml")
        for key, value in flat(OmegaConf.to_container(OmegaConf.load(path)))
        if key != "defaults" and paper[key] == value
    }
    sizes = {"views.local.per_view"}  # the profile's
    assert differing - sizes <= flipped
    swept = OmegaConf.load(CONF / "experiment" / "method_ablation.yaml").hydra.sweeper.params
    names = {name.strip() for name in swept["+switch"].split(",")}
    files = {path.stem for path in (CONF / "switch").glob("*.yaml")}
    assert names == files - {"image_tone"}


@pytest.mark.parametrize(
    ("experiment", "group"), [("method_ablation", "switch"), ("readings", "reading")]
)
def test_every_job_of_an_ablation_differs_from_its_first_by_its_file_alone(experiment, group):
    first, *others = (
        (overrides, dict(flat(asdict(compose([*overrides, "hydra.mode=RUN"])))))
        for overrides in experiment_jobs([f"+experiment={experiment}"])
    )
    source, style = (f"{key}={first[1][f'{key}.name']}" for key in ("source", "style"))
    paper = dict(flat(asdict(compose([source, style, "method=paper"]))))
    names = set()
    for overrides, made in others:
        (name,) = (each.partition("=")[2] for each in overrides if each.startswith(f"+{group}="))
        names.add(name)
        body = OmegaConf.to_container(OmegaConf.load(CONF / group / f"{name}.yaml"))
        if "defaults" in body:
            assert made == paper
            continue
        own = dict(flat(body))
        assert own.items() <= made.items()
        differing = {key for key in made if made[key] != first[1][key]}
        assert differing
        assert differing <= own.keys()
    files = {path.stem for path in (CONF / group).glob("*.yaml")}
    assert names | {"robust", "amended", "image_tone"} >= files


def test_a_failed_job_under_joblib_fails_the_sweep_and_is_in_the_table(tmp_path):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher", reason="needs the extra sweep")
    done = styleexp(
        "-m", "source=torus", "style=bubble", "style.path=null,none.obj", "launcher=joblib",
        "method=robust", "profile=smoke", "encoder=vgg19_random", "hydra.sweep.dir=all",
        cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 2
    assert "none.obj" in done.stdout
    with open(tmp_path / "all" / "table.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["status"] for row in rows] == ["done", "failed"]
    assert [row["style.path"] for row in rows] == ["null", "none.obj"]
    assert "none.obj" in rows[1]["reason"]
    assert float(rows[0]["seconds"]) > 0
    assert Image.open(tmp_path / "all" / "figure.png").width > 96
    threads = json.loads((tmp_path / "all" / "0" / "run.json").read_text())["threads"]
    assert threads == max(1, len(os.sched_getaffinity(0)) // 2)


def test_a_job_that_never_began_is_missing_and_fails_the_sweep(tmp_path):
    (tmp_path / "jobs.json").write_text(json.dumps({"jobs": [["style=bubble"], ["style=rail"]]}))
    (tmp_path / "0").mkdir()
    (tmp_path / "0" / "status.json").write_text('{"status": "done", "seconds": 3.0}')
    (tmp_path / "0" / "run.json").write_text('{"overrides": ["style=bubble"]}')
    assert report.exit_code(tmp_path) == 2
    rows = report.table(report.planned(tmp_path))
    assert [row["status"] for row in rows] == ["done", "missing"]
    assert [row["=style"] for row in rows] == ["bubble", "rail"]


def kinds(lines):
    return [[cell and (cell.kind, cell.job) for cell in line] for line in lines]


def test_settings_are_columns():
    shown = [Shown("spot", "bubble", name) for name in ("low", "mixed", "high", "a", "b")]
    assert kinds(layout(shown)) == [
        [("source", 0), ("style", 0), *(("result", n) for n in range(4))],
        [None, None, ("result", 4)],
    ]
    assert layout(shown)[0][3].caption == "mixed"


def test_products_of_sources_and_styles_are_a_grid():
    shown = [Shown(source, style, "") for source in ("spot", "fish") for style in ("rail", "wave")]
    assert kinds(layout(shown)) == [
        [None, ("style", 0), ("style", 1)],
        [("source", 0), ("result", 0), ("result", 1)],
        [("source", 2), ("result", 2), ("result", 3)],
    ]


def test_pairs_are_triples():
    shown = [Shown("spot", "rail", ""), Shown("fish", "wave", ""), Shown("cat", "rail", "")]
    triple = [[("source", n), ("style", n), ("result", n)] for n in range(3)]
    assert kinds(layout(shown)) == [triple[0] + triple[1], triple[2]]


def test_labels_name_what_differs():
    told = varying([["layers=low", "field.sigma=1", "+experiment=x"],
                    ["layers=high", "field.sigma=1", "+experiment=x"]])  # fmt: skip
    assert told == [{"layers": "low"}, {"layers": "high"}]
    assert setting({"layers": "low", "field.sigma": "1", "source": "x"}) == "low, field.sigma=1"


def test_jobs_without_a_folder_are_drawn_as_missing(tmp_path):
    jobs = [Job(name, (*GIVEN, f"optim.seed={name}", "preview.resolution=96"), tmp_path / name)
            for name in "01"]  # fmt: skip
    report.report(jobs, tmp_path, "two that never began")
    picture = Image.open(tmp_path / "figure.png")
    assert picture.width == 4 * 96
    assert min(picture.crop((2 * 96, 20, 4 * 96, 112)).tobytes()) < 128  # words


def test_a_sheet_shows_no_more_jobs_than_a_browser_can_open(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(figure, "MOST", 2)
    jobs = [Job(name, (*GIVEN, f"optim.seed={name}", "preview.resolution=96"), tmp_path / name)
            for name in "0123"]  # fmt: skip
    report.report(jobs, tmp_path, "four that never began")
    assert Image.open(tmp_path / "figure.png").width == 4 * 96
    assert "the first 2 of 4 jobs" in capsys.readouterr().out
    assert len((tmp_path / "table.csv").read_text().splitlines()) == 1 + 4
