"""Whose folder it is: two commands of one second, and what a job takes for its own result."""

import csv
import json
import os
from concurrent.futures import ThreadPoolExecutor

import pytest

from styleexp.experiments.sweeps import claim, manifest, report
from styleexp.runs import finding, identity, reading
from styleexp.runs.jobs import Job, planned
from styleexp.system import locks
from tests.helpers import warm

PAIRS = int(os.environ.get("STYLEEXP_PAIRS", "1"))
"""How often two sweeps are started at once; ``make stress`` does it twenty times."""
TINY = (
    "profile=smoke", "method=displacement_map", "encoder=vgg19_random", "report=false",
    "preview.resolution=32", "preview.turntable_frames=1", "threads=1",
)  # fmt: skip
"""A job without a step."""
# The clock stands still, so that all commands are of one second.
STOPPED = """\
import datetime
class Stopped(datetime.datetime):
    @classmethod
    def now(cls, tz=None):
        return cls(2026, 1, 31, 12, 0, 0, tzinfo=tz)
import hydra.core.utils
hydra.core.utils.datetime = Stopped
import sys
from styleexp.cli.main import main
main()
"""


def styleexp(*arguments, cwd):
    return warm.run("-c", STOPPED, *arguments, cwd=cwd, env=warm.coarse())


def at_once(*commands, cwd):
    with ThreadPoolExecutor(len(commands)) as pool:
        return list(pool.map(lambda each: styleexp(*each, cwd=cwd), commands))


def complaint(done):
    assert done.returncode == 2, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    lines = [x for x in done.stderr.splitlines() if x.strip() and not x.startswith("warning: ")]
    assert len(lines) == 1, done.stderr
    return lines[0]


def rows(folder):
    with open(folder / "table.csv", newline="") as file:
        return list(csv.DictReader(file))


def record(folder):
    return json.loads((folder / "run.json").read_text())


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """What each style's job measures when nothing else runs."""
    folder = tmp_path_factory.mktemp("alone")
    done = styleexp("-m", "source=torus", "style=bubble,stripe,rail,scales", *TINY,
                    "hydra.sweep.dir=all", cwd=folder)  # fmt: skip
    assert done.returncode == 0, done.stderr
    return {row["style"]: row["silhouette_iou"] for row in rows(folder / "all")}


# ------------------------------------------------------------------------ two at once


@pytest.mark.parametrize(
    ("where", "launcher"), [("default", "basic"), ("given", "basic"), ("default", "joblib")]
)
def test_two_sweeps_at_once_keep_their_numbers_apart(where, launcher, alone, tmp_path):
    """In default folders both are done; of two in one folder, one is refused."""
    if launcher == "joblib":
        pytest.importorskip("hydra_plugins.hydra_joblib_launcher", reason="needs the extra sweep")
    assert len(set(alone.values())) == 4
    for number in range(PAIRS):
        cwd = tmp_path / str(number)
        cwd.mkdir()
        more = [*TINY, f"launcher={launcher}"]
        more += ["hydra.sweep.dir=all"] if where == "given" else []
        done = at_once(
            ("-m", "source=torus", "style=bubble,stripe", *more),
            ("-m", "source=torus", "style=rail,scales", *more),
            cwd=cwd,
        )
        found = sorted(path.parent for path in cwd.rglob("jobs.json"))
        if where == "given":
            assert sorted(each.returncode for each in done) == [0, 2]
            (refused,) = (each for each in done if each.returncode)
            told = complaint(refused)
            assert "all' contains another sweep" in told or "is using 'all'" in told
        else:
            assert [each.returncode for each in done] == [0, 0], done[0].stderr + done[1].stderr
            names = [path.name for path in found]
            assert names == ["2026-01-31_12-00-00", "2026-01-31_12-00-00_2"]
        shown = [row for folder in found for row in rows(folder)]
        assert len(shown) == 2 * len(found) == 2 * sum(not each.returncode for each in done)
        for row in shown:
            assert row["status"] == "done"
            assert row["silhouette_iou"] == alone[row["style"]], row["style"]


def test_two_runs_of_one_second_have_folders_of_their_own(tmp_path):
    given = ("source=torus", "style=rail", *TINY)
    done = at_once((*given, "strength=0.5"), (*given, "strength=1"), cwd=tmp_path)
    assert [each.returncode for each in done] == [0, 0], done[0].stderr + done[1].stderr
    made = sorted((tmp_path / "outputs" / "torus-rail").iterdir())
    assert [path.name for path in made] == ["2026-01-31_12-00-00", "2026-01-31_12-00-00_2"]
    assert {record(path)["config"]["strength"] for path in made} == {0.5, 1.0}
    for path in made:  # Hydra's own files, too
        strength = record(path)["config"]["strength"]
        assert f"strength: {strength:g}" in (path / ".hydra" / "config.yaml").read_text()


def test_a_folder_is_claimed_once_by_many(tmp_path):
    """Threads are enough here: a lock belongs to an open file, a folder is made once."""
    with ThreadPoolExecutor(8) as pool:
        made = list(pool.map(lambda _: claim.fresh(tmp_path / "a"), range(24)))
    assert len(set(made)) == 24
    assert tmp_path / "a" in made
    for folder in made:
        assert locks.held(folder)
        locks.drop(folder)
        assert not locks.held(folder)


# ------------------------------------------------------------------------- a folder given by hand


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    """A finished sweep of two jobs."""
    cwd = tmp_path_factory.mktemp("swept")
    asked = ("-m", "source=torus", "style=bubble,rail", *TINY, "hydra.sweep.dir=all")
    assert styleexp(*asked, cwd=cwd).returncode == 0
    return cwd, asked


def test_a_sweep_goes_on_in_its_own_folder_and_does_nothing_twice(swept):
    import shutil

    cwd, asked = swept
    before = (cwd / "all" / "0" / "result.ply").stat().st_mtime_ns
    table = (cwd / "all" / "table.csv").read_text()
    shutil.rmtree(cwd / "all" / "1")
    again = styleexp(*asked, cwd=cwd)
    assert again.returncode == 0, again.stderr
    assert again.stdout.count("already done") == 1
    assert (cwd / "all" / "0" / "result.ply").stat().st_mtime_ns == before
    drop = [row.pop("seconds") for row in (*rows(cwd / "all"), *csv.DictReader(table.split("\n")))]
    assert len(drop) == 4
    assert [row["style"] for row in rows(cwd / "all")] == ["bubble", "rail"]


def test_another_sweep_is_refused_in_a_folder_that_one_held(swept):
    cwd, asked = swept
    before = {p: p.read_bytes() for p in cwd.rglob("*") if p.is_file()}
    told = complaint(styleexp(*(a.replace("rail", "scales") for a in asked), cwd=cwd))
    assert "'all' contains another sweep: choose another folder with hydra.sweep.dir=FOLDER" in told
    told = complaint(styleexp("hydra.sweep.dir=all", *asked[:-1], "strength=0.5", cwd=cwd))
    assert "'all' contains another sweep" in told
    assert {p: p.read_bytes() for p in cwd.rglob("*") if p.is_file()} == before


def test_a_sweep_is_refused_where_its_source_has_changed_since(tmp_path):
    from styleexp.inputs import meshes, shapes

    asked = ("-m", "source.path=t.ply", "style=rail,bubble", *TINY, "hydra.sweep.dir=all")
    for name, code in (("torus", 0), ("sphere", 2)):
        mesh = shapes.make(name, detail=800)
        meshes.save_mesh(mesh, mesh.vertices, tmp_path / "t.ply")
        done = styleexp(*asked, cwd=tmp_path)
        assert done.returncode == code, done.stderr
    told = complaint(done)
    assert "the same overrides with other files" in told
    assert "hydra.sweep.dir=FOLDER" in told


def test_a_job_that_failed_for_want_of_a_file_is_tried_again(tmp_path):
    from styleexp.inputs import meshes, shapes

    asked = ("-m", "source.path=t.ply", "style=rail,bubble", *TINY, "hydra.sweep.dir=all")
    assert styleexp(*asked, cwd=tmp_path).returncode == 2
    mesh = shapes.make("torus", detail=800)
    meshes.save_mesh(mesh, mesh.vertices, tmp_path / "t.ply")
    done = styleexp(*asked, cwd=tmp_path)
    assert done.returncode == 0, done.stderr


def test_a_sweep_that_is_at_work_keeps_its_folder(swept):
    cwd, asked = swept
    with locks.hold(cwd / "all"):
        told = complaint(styleexp(*asked, cwd=cwd))
    assert "another process is using 'all'" in told
    assert "hydra.sweep.dir=FOLDER" in told


def test_jobs_in_folders_of_another_name_are_found_by_what_they_are(tmp_path):
    done = styleexp("-m", "source=torus", "style=bubble,rail", *TINY, "hydra.sweep.dir=all",
                    "hydra.sweep.subdir=job-${style.name}", cwd=tmp_path)  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert [row["status"] for row in rows(tmp_path / "all")] == ["done", "done"]
    assert [job.folder.name for job in planned(tmp_path / "all")] == ["job-bubble", "job-rail"]


# ----------------------------------------------------------------- state and numbers by identity


@pytest.fixture
def exchanged(swept, tmp_path):
    """The sweep with the second job's folder in the place of the first's."""
    import shutil

    shutil.copytree(swept[0] / "all", tmp_path / "all")
    shutil.rmtree(tmp_path / "all" / "0")
    shutil.copytree(tmp_path / "all" / "1", tmp_path / "all" / "0")
    return tmp_path / "all"


def test_another_runs_folder_is_shown_as_what_it_is(exchanged):
    assert report.exit_code(exchanged) == 2
    first, second = report.table(planned(exchanged))
    assert (first["status"], second["status"]) == ("other", "done")
    assert (first["=style"], second["=style"]) == ("bubble", "rail")
    assert "another run (styleexp source=torus style=rail" in first["reason"]
    assert first["seconds"] is None
    assert not [key for key in first if key.startswith("silhouette")]
    report.finish(exchanged)
    assert rows(exchanged)[0]["silhouette_iou"] == ""
    seen = finding.find(exchanged)
    assert [run.status for run in seen] == ["other", "done"]
    assert seen[0].summary == {}


def test_a_collected_table_shows_it_so_too(exchanged):
    pytest.importorskip("pandas", reason="needs the extra report")
    from styleexp.experiments.reports.collect import collect

    frame = collect(exchanged)
    assert list(frame["status"]) == ["other", "done"]
    assert frame["metric.silhouette_iou"].isna().tolist() == [True, False]


def test_a_sweep_of_an_earlier_version_is_known_by_its_overrides(exchanged):
    content = json.loads((exchanged / "jobs.json").read_text())
    (exchanged / "jobs.json").write_text(json.dumps({"jobs": content["jobs"]}))
    for number in (0, 1):
        old = record(exchanged / str(number))
        del old["key"]
        (exchanged / str(number) / "run.json").write_text(json.dumps(old))
    assert [row["status"] for row in report.table(planned(exchanged))] == ["other", "done"]


def test_a_record_without_a_key_has_the_same_one(swept):
    told = record(swept[0] / "all" / "0")
    key = told.pop("key")
    assert identity.of(told) == key
    assert planned(swept[0] / "all")[0].key == key


def test_numbers_without_a_record_are_nobodys(exchanged):
    (exchanged / "0" / "run.json").unlink()
    found = reading.of_job(planned(exchanged)[0])
    assert (found.status, found.loss) == ("unreadable", None)
    assert "no run.json" in found.reason


def test_a_plan_refuses_another_run_in_a_jobs_folder(swept, tmp_path):
    import shutil

    from styleexp.cli.sweep import main

    text = "profile: smoke\noverrides: [method=robust, encoder=vgg19_random]\nexperiments:\n"
    (tmp_path / "plan.yaml").write_text(text + "  - {name: a, pairs: [[torus, rail]]}\n")
    from styleexp.experiments.sweeps import plan

    ((job,),) = plan.jobs(plan.read(tmp_path / "plan.yaml"), tmp_path / "out").values()
    shutil.copytree(swept[0] / "all" / "1", job.folder)
    done = warm.run(
        "-m", main.__module__, "plan.yaml", "--folder", "out", cwd=tmp_path, env=warm.coarse()
    )
    told = complaint(done)
    assert job.name in told
    assert "doesn't belong to this plan" in told
    assert record(job.folder) == record(swept[0] / "all" / "1")


def test_the_manifest_counts_no_attempts_of_another_job(tmp_path):
    from styleexp.experiments.sweeps.plan import Planned

    job = Planned("a/x", (), tmp_path / "a" / "x", "k1", "a")
    manifest.write(tmp_path, [job])
    manifest.update(tmp_path, job.name, "running")
    manifest.write(tmp_path, [Planned("a/x", (), job.folder, "k2", "a")])
    assert manifest.read(tmp_path)["a/x"]["attempts"] == 0


def test_a_job_does_not_replace_another_run(swept):
    from styleexp.config.compose import compose
    from styleexp.experiments.execute import run
    from styleexp.system.errors import UserError

    folder = swept[0] / "all" / "1"
    before = {p: p.read_bytes() for p in folder.iterdir() if p.is_file()}
    with pytest.raises(UserError, match="doesn't belong to this job: the folder holds another run"):
        run(compose(["source=torus", "style=scales", *TINY]), folder, ["style=scales"], again=False)
    assert {p: p.read_bytes() for p in folder.iterdir() if p.is_file()} == before
    assert Job("1", (), folder).key is None
