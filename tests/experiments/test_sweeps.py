"""Plans: what they run, skip, repeat and resume. Real processes, really killed."""

import json
import os
import random
import shlex
import signal
import subprocess
import sys
import time
from contextlib import suppress

import pytest

from styleexp.experiments.sweeps import launchers, manifest, plan, state
from styleexp.runs import reading
from styleexp.runs.identity import job_key
from styleexp.system import locks
from styleexp.system.errors import UserError
from tests.helpers import warm

KILLS = int(os.environ.get("STYLEEXP_KILLS", "2"))
"""How often the kill tests kill; ``make stress`` has ten."""

STEPS = 5 * KILLS
"""Enough for all those kills."""

PLAN = f"""\
profile: smoke
overrides: [method=robust, encoder=vgg19_random, source=torus, optim.steps={STEPS}, threads=1]
experiments:
  - name: styles
    figure: Fig. 2
    minutes: {{smoke: 1}}
    overrides: ["style=bubble,rail,stripe"]
  - name: pairs
    pairs: [[sphere, scales], [torus, rail]]
"""
JOBS = 4
"""Of that plan: one of the five is another's."""


SWEEP = ("-m", "styleexp.cli.sweep")


def sweep(*arguments, cwd, **environment):
    return warm.run(*SWEEP, *arguments, cwd=cwd, env=warm.coarse(**environment))


def results(folder):
    """Every job's mesh, by the job's name."""
    return {
        str(path.parent.relative_to(folder)): path.read_bytes()
        for path in folder.glob("*/*/result.ply")
    }


def write_plan(folder, text=PLAN):
    path = folder / "plan.yaml"
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The plan run once without any trouble: its folder and what it printed."""
    cwd = tmp_path_factory.mktemp("undisturbed")
    done = sweep(write_plan(cwd), "--folder", "out", cwd=cwd)
    assert done.returncode == 0, done.stderr
    assert len(results(cwd / "out")) == JOBS
    return cwd / "out", done


# -------------------------------------------------------------------------------- what is planned


def test_pairs_are_pairs_and_lists_are_products(tmp_path):
    jobs = plan.jobs(plan.read(write_plan(tmp_path)), tmp_path)
    assert [len(listed) for listed in jobs.values()] == [3, 2]
    assert jobs["pairs"][1].folder == jobs["styles"][1].folder  # torus and rail, twice
    assert "source=sphere" in jobs["pairs"][0].overrides
    assert jobs["styles"][0].name.startswith("styles/bubble-")


def test_seeds_multiply_unless_the_experiment_sweeps_them_itself(tmp_path):
    text = "seeds: [0, 1]\nexperiments:\n  - experiment: multi_style\n"
    text += "  - {experiment: renderer_ablation, overrides: [renderer=soft_raster]}\n"
    jobs = plan.jobs(plan.read(write_plan(tmp_path, text)), tmp_path)
    assert [len(listed) for listed in jobs.values()] == [6, 3]


def test_the_key_is_of_what_the_result_follows_from(tmp_path, monkeypatch):
    from styleexp.config.compose import compose
    from styleexp.inputs import meshes, shapes

    torus = shapes.make("torus", detail=800)
    path = tmp_path / "ring.ply"
    meshes.save_mesh(torus, torus.vertices, path)
    given = [f"source.path={path}", "style=rail"]
    key = job_key(compose(given))
    assert job_key(compose([*given, "threads=1", "debug=true"])) == key
    assert job_key(compose([*given, "optim.seed=1"])) != key
    meshes.save_mesh(torus, 2 * torus.vertices, path)
    assert job_key(compose(given)) != key


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("experiments: []", "lists no experiments"),
        ("experiments:\n  - {experimnt: board}", "did you mean 'experiment'"),
        ("launchr: joblib\nexperiments:\n  - {experiment: board}", "did you mean 'launcher'"),
        ("experiments:\n  - {figure: Fig. 2}", "no experiment and no name"),
        ("experiments:\n  - {name: a, pairs: [[spot]]}", "[source, style]"),
        ("experiments:\n  - {name: a}\n  - {name: a}", "'a' twice"),
        ("experiments:\n  - {name: a, seeds: many}", "seeds can't be 'many'"),
        ("experiments: [", "can't be read"),
        ("experiments:\n  - {experiment: bord}", "did you mean 'board'"),
        ("experiments:\n  - {name: a, overrides: [optim.stps=3]}", "optim.steps"),
    ],
)
def test_mistakes_in_a_plan_get_one_sentence(text, told, tmp_path):
    done = sweep(write_plan(tmp_path, text), cwd=tmp_path)
    assert done.returncode == 2
    assert told in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["plan.yaml"]


def test_there_is_no_such_plan(tmp_path):
    with pytest.raises(UserError, match="no plan"):
        plan.read(tmp_path / "none.yaml")


def test_help_loads_nothing_heavy():
    code = (
        "import sys\nfrom styleexp.cli.sweep import main\n"
        "try: main(['--help'])\nexcept SystemExit: pass\n"
        "print('HEAVY', sorted({'torch', 'pandas', 'hydra', 'submitit'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "HEAVY []" in done.stdout
    assert "--dry-run" in done.stdout


# ---------------------------------------------------------------------------------- what is run


def test_dry_run_prints_the_very_commands_and_runs_nothing(undisturbed, tmp_path):
    done = sweep(write_plan(tmp_path), "--folder", "out", "--dry-run", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert not (tmp_path / "out").exists()
    assert "# styles, Fig. 2: 3 jobs; left: about 2 core-minutes (plan's estimate)" in done.stdout
    assert "and 1 job of unknown time" in done.stdout
    commands = [line for line in done.stdout.splitlines() if line.startswith("styleexp ")]
    assert len(commands) == JOBS + 1
    assert "# the same job as above" in commands[-1]
    words = shlex.split(commands[0], comments=True)
    run = warm.run("-m", *words, cwd=tmp_path, env=warm.coarse())
    assert run.returncode == 0
    ((name, mesh),) = results(tmp_path / "out").items()
    assert results(undisturbed[0])[name] == mesh


def test_every_experiment_has_its_table_and_its_figure(undisturbed):
    folder, done = undisturbed
    for name in ("styles", "pairs"):
        assert (folder / name / "figure.png").exists()
        assert (folder / name / "table.csv").exists()
    assert "styles (Fig. 2)" in done.stdout
    assert "(4 of 4 done)" in done.stdout
    log = next((folder / "styles").glob("bubble-*")) / "log.txt"
    assert f"step {STEPS}/{STEPS}" in log.read_text()
    assert f"step {STEPS}/{STEPS}" not in done.stdout


def test_what_is_done_is_not_done_again_and_a_changed_job_is(undisturbed, tmp_path):
    import shutil

    shutil.copytree(undisturbed[0], tmp_path / "out")
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / "out").glob("*/*/result.ply")}
    write_plan(tmp_path)
    again = sweep("plan.yaml", "--folder", "out", cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    assert "done in" not in again.stdout
    assert {p: p.stat().st_mtime_ns for p in before} == before
    changed = PLAN.replace("style=bubble,", "style=wave_small,")
    write_plan(tmp_path, changed)
    after = sweep("plan.yaml", "--folder", "out", cwd=tmp_path)
    assert after.returncode == 0, after.stderr
    assert after.stdout.count("done in") == 1
    assert {p: p.stat().st_mtime_ns for p in before} == before
    states = {name: job["state"] for name, job in manifest.read(tmp_path / "out").items()}
    assert sorted(states.values()) == ["done"] * JOBS + ["outdated"]
    assert next(n for n, s in states.items() if s == "outdated").startswith("styles/bubble-")
    shown = sweep("status", "out", cwd=tmp_path)
    assert "4 done, 1 outdated" in shown.stdout


def test_a_failed_job_stays_failed_until_it_is_retried(tmp_path):
    from styleexp.inputs import meshes, shapes

    text = "profile: smoke\noverrides: [method=robust, encoder=vgg19_random]\nexperiments:\n"
    text += '  - {name: a, overrides: [source=torus, style=rail, "style.path=null,ring.ply"]}\n'
    write_plan(tmp_path, text)
    done = sweep("plan.yaml", "--folder", "out", cwd=tmp_path)
    assert done.returncode == 2
    assert "'ring.ply' does not exist" in done.stdout
    assert "Traceback" not in done.stdout + done.stderr
    again = sweep("plan.yaml", "--folder", "out", cwd=tmp_path)
    assert again.returncode == 2
    assert "failed in" not in again.stdout
    # The file is part of the job's key, so its appearance alone makes another job; keep the key.
    failed = next(
        path.parent
        for path in (tmp_path / "out").glob("a/*/status.json")
        if reading.read(path.parent).last_status == "failed"
    )
    record = json.loads((failed / "status.json").read_text())
    (failed / "status.json").write_text(json.dumps({**record, "reason": "the disk was full"}))
    retried = sweep("plan.yaml", "--folder", "out", "--retry", cwd=tmp_path)
    assert retried.returncode == 2
    assert retried.stdout.count("failed in") == 1
    assert manifest.read(tmp_path / "out")[f"a/{failed.name}"]["attempts"] == 2
    torus = shapes.make("stripe", detail=2000)
    meshes.save_mesh(torus, torus.vertices, tmp_path / "ring.ply")
    assert sweep("plan.yaml", "--folder", "out", cwd=tmp_path).returncode == 0


# ------------------------------------------------------------------------------- several at once


def test_a_run_refuses_a_folder_that_another_process_is_at(tmp_path):
    with locks.hold(tmp_path / "run"):
        done = warm.run(
            "-m", "styleexp", "source=torus", "style=rail", "hydra.run.dir=run", cwd=tmp_path
        )
    assert done.returncode == 2
    assert "another process is using" in done.stderr
    assert not (tmp_path / "run" / "run.json").exists()


def test_two_runners_share_a_plan_and_do_no_job_twice(undisturbed, tmp_path):
    path = write_plan(tmp_path)
    runners = [
        warm.start(
            *SWEEP, path, "--folder", "out", cwd=tmp_path, env=warm.coarse(), stdout=warm.PIPE
        )
        for _ in range(2)
    ]
    told = [runner.communicate(timeout=600)[0] for runner in runners]
    assert [runner.returncode for runner in runners] == [0, 0]
    assert results(tmp_path / "out") == results(undisturbed[0])
    jobs = manifest.read(tmp_path / "out")
    assert [job["attempts"] for job in jobs.values()] == [1] * JOBS
    assert all(text.count(": done in") for text in told), "one runner did all the work"
    assert sum(text.count(": done in") for text in told) == JOBS


class Victims:
    """Runners in sessions of their own, so that all they leave behind can be ended."""

    def __init__(self, cwd, *arguments):
        self.cwd, self.arguments, self.started = cwd, arguments, []

    def start(self):
        with open(self.cwd / "told.txt", "a") as told:
            runner = warm.start(
                *SWEEP, *self.arguments, cwd=self.cwd, env=warm.coarse(), stdout=told, stderr=told,
                start_new_session=True,
            )  # fmt: skip
        self.started.append(runner)
        return runner

    def end(self):
        for runner in self.started:
            with suppress(ProcessLookupError):
                os.killpg(runner.pid, signal.SIGKILL)
            runner.wait()


def running(folder):
    """Processes that are at a job of a plan now, by the job."""
    if not (folder / manifest.NAME).exists():
        return {}
    return {
        name: job["process"]
        for name, job in manifest.read(folder).items()
        if job["state"] == "running" and reading.read(folder / name).status == "running"
    }


@pytest.mark.parametrize("launcher", ["joblib", "submitit_local"])
def test_kill_9_of_runners_and_workers_loses_nothing(launcher, undisturbed, tmp_path):
    pytest.importorskip(f"hydra_plugins.hydra_{launcher.split('_')[0]}_launcher",
                        reason="needs the extra sweep")  # fmt: skip
    chance = random.Random(f"{launcher} {KILLS}")
    out, path = tmp_path / "out", write_plan(tmp_path)
    victims = Victims(tmp_path, path, "--folder", "out", "--launcher", launcher)
    killed = []
    try:
        runner = victims.start()
        deadline = time.monotonic() + 120 + 60 * KILLS
        while len(killed) < KILLS and runner.poll() is None:
            moment = time.monotonic() + chance.uniform(0, 2)
            while not running(out) or time.monotonic() < moment:
                assert time.monotonic() < deadline, (tmp_path / "told.txt").read_text()
                if runner.poll() is not None:
                    break
                time.sleep(0.05)
            workers = list(running(out).values())
            # Three times the same job alone, and the runner rightly calls it failed.
            if chance.random() < 0.5 or not workers or killed[-2:] == ["worker", "worker"]:
                os.kill(runner.pid, signal.SIGKILL)
                runner.wait()
                killed.append("runner")
                runner = victims.start()
            else:
                with suppress(ProcessLookupError):
                    os.kill(chance.choice(workers), signal.SIGKILL)
                    killed.append("worker")
        assert runner.wait(timeout=600) == 0, (tmp_path / "told.txt").read_text()
    finally:
        victims.end()
    assert len(killed) == KILLS
    assert results(out) == results(undisturbed[0])
    for name in results(out):
        lines = (out / name / "metrics.jsonl").read_text().splitlines()
        steps = [json.loads(line)["step"] for line in lines]
        assert steps == list(range(1, STEPS + 1))


def test_a_preempted_job_is_requeued_and_resumes(undisturbed, tmp_path):
    """Submitit's own signal, as SLURM sends it before the time is over."""
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher", reason="needs the extra sweep")
    text = PLAN.replace("pairs: [[sphere, scales], [torus, rail]]", "pairs: [[sphere, scales]]")
    start, end = text.index("  - name: styles"), text.index("  - name: pairs")
    out, path = tmp_path / "out", write_plan(tmp_path, text[:start] + text[end:])
    arguments = (path, "--folder", "out", "--launcher", "submitit_local", "--jobs", "1")
    victims = Victims(tmp_path, *arguments)
    try:
        runner = victims.start()
        while not any(len(reading.read(out / name).steps) >= 3 for name in running(out)):
            assert runner.poll() is None, (tmp_path / "told.txt").read_text()
            time.sleep(0.02)
        ((name, process),) = running(out).items()
        os.kill(process, signal.SIGUSR2)
        assert runner.wait(timeout=600) == 0, (tmp_path / "told.txt").read_text()
    finally:
        victims.end()
    assert manifest.read(out)[name]["attempts"] == 2
    assert "resuming at step" in (out / name / "log.txt").read_text()
    assert "a worker failed" not in (tmp_path / "told.txt").read_text()
    assert results(out)[name] in results(undisturbed[0]).values()


DEADLY = """\
import os, signal
from dataclasses import dataclass
from styleexp.plugins.spec import Spec

@dataclass
class Options:
    name: str = "deadly"

def make(options):
    os.kill(os.getpid(), signal.SIGKILL)

SPEC = Spec("deadly", "kills its process", Options, make)
"""


def test_a_job_that_kills_its_process_each_time_fails_and_the_others_go_on(tmp_path):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher", reason="needs the extra sweep")
    (tmp_path / "deadly.py").write_text(DEADLY)
    text = "profile: smoke\noverrides: [method=robust, encoder=vgg19_random]\nexperiments:\n"
    text += (
        "  - name: a\n    overrides: [source=torus, style=rail, 'renderer=deadly,soft_raster']\n"
    )
    write_plan(tmp_path, text)
    plugin = {"STYLEEXP_PLUGINS": "renderer=deadly:SPEC", "PYTHONPATH": str(tmp_path)}
    given = ("plan.yaml", "--launcher=joblib", "--per-task=2", "--folder=out")  # both in one task
    done = sweep(*given, cwd=tmp_path, **plugin)
    assert done.returncode == 2, done.stderr
    assert "its process died 3 times" in done.stdout
    states = [job["state"] for job in manifest.read(tmp_path / "out").values()]
    assert states == ["failed", "done"]


# ------------------------------------------------------------------------------------- launchers


def test_a_job_finds_nothing_of_the_one_before_it_in_its_process():
    import numpy as np
    import torch

    from styleexp.system.process import _default_threads, prepare

    default = _default_threads()
    prepare(threads=default + 1, seed=0)
    assert torch.get_num_threads() == default + 1
    first = torch.rand(3).tolist(), np.random.rand(3).tolist(), random.random()
    prepare(threads=0, seed=0)
    assert torch.get_num_threads() == default
    assert (torch.rand(3).tolist(), np.random.rand(3).tolist(), random.random()) == first


def test_jobs_side_by_side_share_the_cores(monkeypatch):
    import hydra

    monkeypatch.setattr(launchers, "cores", lambda: 8)

    def threads(name, jobs=None):
        from styleexp.config import compose

        compose.register()
        with hydra.initialize_config_module("styleexp.conf", version_base="1.3"):
            given = launchers.overrides(name, jobs)
            config = hydra.compose("config", given, return_hydra_config=True)
            return launchers.threads_each(config.hydra)

    assert threads("basic") == 0
    assert threads("joblib") == 4
    assert threads("joblib", 3) == 2
    assert threads("submitit_local", 8) == 1
    assert threads("submitit_local", 16) == 1
    assert threads("submitit_slurm") == 4
    with pytest.raises(UserError, match="--jobs 2"):
        launchers.overrides("basic", 2)


def test_jobs_given_in_batches_are_all_done(undisturbed, tmp_path):
    """A launcher keeps what each of its jobs returned: of thousands, that fills the memory."""
    code = "import sys; from styleexp.cli.sweep import main; "
    code += "from styleexp.experiments.sweeps import launchers; "

    code += "launchers.MANY = 3; sys.exit(main(sys.argv[1:]))"
    done = warm.run(
        "-c", code, write_plan(tmp_path), "--folder", "out", cwd=tmp_path, env=warm.coarse()
    )
    assert done.returncode == 0, done.stderr
    assert "(4 of 4 done)" in done.stdout
    assert results(tmp_path / "out") == results(undisturbed[0])


SBATCH = """\
#!/bin/sh
for last; do :; done
cp "$last" "$HERE/submitted.sh"
echo "sbatch: error: this is no cluster" >&2
exit 1
"""


def test_what_slurm_is_asked_for(tmp_path):
    """The batch file that sbatch gets; and one sentence where it refuses it."""
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher", reason="needs the extra sweep")
    for name in ("sbatch", "srun"):
        (tmp_path / name).write_text(SBATCH)
        (tmp_path / name).chmod(0o755)
    path = os.pathsep.join([str(tmp_path), os.environ["PATH"]])
    done = sweep(
        write_plan(tmp_path), "--launcher", "submitit_slurm", "--jobs", "3", "--folder", "out",
        "hydra.launcher.partition=gpu", cwd=tmp_path, PATH=path, HERE=str(tmp_path),
    )  # fmt: skip
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    told = done.stderr.strip().splitlines()[-1]
    assert told.startswith("styleexp-sweep: the launcher failed before any job started (sbatch: ")
    asked = (tmp_path / "submitted.sh").read_text()
    for line in (
        f"--array=0-{JOBS - 1}%3",
        "--partition=gpu",
        "--cpus-per-task=4",
        "--mem=8GB",
        "--time=240",
        "--signal=USR2@120",
        "--job-name=styleexp",
        "--open-mode=append",
    ):
        assert f"#SBATCH {line}" in asked
    assert "submitit.core._submit" in asked
    assert {job["state"] for job in manifest.read(tmp_path / "out").values()} == {"missing"}
    told = slurm_lines(tmp_path, "--jobs=3", "hydra.launcher.partition=gpu")
    lines = [line for line in asked.splitlines() if line.startswith("#SBATCH")]
    assert [line for line in told if "put=" not in line and "error=" not in line] == [
        line for line in lines if "put=" not in line and "error=" not in line
    ]


def test_a_task_of_slurm_needs_more_time_than_its_warning(monkeypatch):
    from types import SimpleNamespace as Given

    def check(minutes):
        asked = Given(_target_="SlurmLauncher", timeout_min=minutes, signal_delay_s=120)
        launchers.check(Given(launcher=asked))

    monkeypatch.setattr(launchers.shutil, "which", lambda name: name)
    check(4)
    with pytest.raises(UserError, match="give at least 4"):
        check(3)
    monkeypatch.setattr(launchers.shutil, "which", lambda name: None)
    with pytest.raises(UserError, match="there is no sbatch and no srun"):
        check(4)


def test_more_tasks_than_slurm_takes_in_an_array_are_several_arrays(tmp_path, monkeypatch):
    from types import SimpleNamespace as Given

    for name in ("sbatch", "sacct"):
        (tmp_path / name).write_text("#!/bin/sh\n")
    (tmp_path / "scontrol").write_text(
        '#!/bin/sh\ntest "$*" = "show config" && echo "MaxArraySize            = 1001"\n'
    )
    for name in ("sbatch", "sacct", "scontrol"):
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", os.pathsep.join([str(tmp_path), os.environ["PATH"]]))
    slurm = Given(launcher=Given(_target_="SlurmLauncher"))
    assert launchers.batch_size(slurm) == 1001
    assert launchers.notes(slurm, 1001, 1) == []
    (told,) = launchers.notes(slurm, 2003, 2)
    assert "at most 1001 tasks in an array" in told
    assert "there are 3 arrays" in told
    assert told.endswith("give --per-task 5.")
    assert -(-2 * 2003 // 5) <= 1001
    (tmp_path / "scontrol").write_text("#!/bin/sh\nexit 1\n")  # no answer: no limit is known
    assert launchers.batch_size(slurm) is None


def slurm_lines(folder, *arguments):
    """The options in the batch file that ``--check`` shows; SLURM's commands may be missing."""
    done = sweep(
        "plan.yaml", "--folder=out", "--check", "--launcher=submitit_slurm", *arguments, cwd=folder
    )
    assert "Traceback" not in done.stderr
    return [line.strip() for line in done.stdout.splitlines() if "#SBATCH" in line]


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (["--launcher=submitit_slurm", "hydra.launcher.partitoin=gpu"], "did you mean 'partition'"),
        (["--launcher=submitit_slurm", "+hydra.launcher.mem=8"], "did you mean 'mem_gb'"),
        (["hydra.launcher.partition=gpu"], "the launcher 'basic' has no keys"),
        (["--launcher=joblib", "hydra.lancher.n_jobs=3"], "did you mean 'launcher'"),
        (["--launcher=slurm"], "did you mean 'submitit_slurm'"),
        (["--launcher=joblib", "--per-task=0"], "--per-task 0 is not possible"),
    ],
)
def test_mistyped_launchers_and_their_keys_get_one_sentence(given, told, tmp_path):
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher", reason="needs the extra sweep")
    done = sweep(write_plan(tmp_path), *given, cwd=tmp_path)
    assert done.returncode == 2
    assert told in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["plan.yaml"]


LACKING = """\
profile: smoke
overrides: [encoder=vgg19_random, metrics.judge=none]
experiments:
  - name: meshes
    minutes: {smoke: 3}
    overrides: [method=robust, style=bubble, "source=torus,spot", "optim.seed=0,1,2"]
  - name: pictures
    pairs: [[torus, gravel], [torus, none.png]]
  - name: weights
    overrides: [method=robust, source=torus, style=rail, "encoder=vgg19,clip"]
"""


def test_a_check_names_what_is_missing_once_and_runs_nothing(tmp_path):
    empty = {"STYLEEXP_ASSETS": "", "STYLEEXP_CACHE": str(tmp_path / "cache")}
    empty |= {"PIP_NO_INDEX": "1", "PIP_CONFIG_FILE": os.devnull, "PIP_FIND_LINKS": ""}
    done = sweep(write_plan(tmp_path, LACKING), "--folder=out", "--check", cwd=tmp_path, **empty)
    assert done.returncode == 2, done.stderr
    for told, jobs in (("'spot'", 3), ("'gravel'", 1), ("'none.png'", 1), ("'vgg19'", 1)):
        assert done.stdout.count(told) == 1
        rest = done.stdout.partition(told)[2].splitlines()
        assert f"stops {jobs} of 10 jobs" in rest[1]
    assert "6 jobs; left: about 6 core-minutes (plan's estimate)" in done.stdout
    assert "and 4 jobs of unknown time; disk space unknown" in done.stdout
    if have("hydra_plugins.hydra_joblib_launcher"):
        refused = sweep("plan.yaml", "--folder=out", "--launcher=joblib", cwd=tmp_path, **empty)
        assert refused.returncode == 2
        assert "nothing was started" in refused.stderr.splitlines()[-1]
    assert not (tmp_path / "out").exists()


def have(module):
    from importlib.util import find_spec

    return find_spec(module.partition(".")[0]) is not None and find_spec(module) is not None


def test_a_check_tells_the_cost_of_what_is_left_from_what_is_done(undisturbed, tmp_path):
    import shutil

    shutil.copytree(undisturbed[0], tmp_path / "out")
    shutil.rmtree(next((tmp_path / "out" / "styles").glob("bubble-*")))
    done = sweep(write_plan(tmp_path), "--folder=out", "--check", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "3 jobs, 2 done; left: about" in done.stdout
    assert "MB (measured on 2 jobs)" in done.stdout
    assert "1 job, all done" in done.stdout
    assert "nothing is missing" in done.stdout


def test_jobs_of_one_task_are_jobs_of_their_own(undisturbed, tmp_path):
    """Each has its folder and its record; the one that fails doesn't take the others along."""
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher", reason="needs the extra sweep")
    text = PLAN.replace("pairs: [[sphere", "pairs: [[none.ply, rail], [sphere")
    arguments = ("--per-task=5", "--launcher=submitit_local", "--jobs=1", "--folder=out")
    given = (write_plan(tmp_path, text), *arguments, "keep_checkpoint=false")
    done = sweep(*given, "--no-check", cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    out = tmp_path / "out"
    assert len(list((out / ".submitit").glob("*/*_submitted.pkl"))) == 1
    assert results(out) == results(undisturbed[0])
    ended = [(job["state"], job["attempts"]) for job in manifest.read(out).values()]
    assert sorted(ended) == [("done", 1)] * JOBS + [("failed", 1)]
    assert not list(out.glob("*/*/*.safetensors"))
    assert list(undisturbed[0].glob("*/*/*.safetensors"))
    for name in results(out):
        run = reading.read(out / name)
        assert run.record["threads"] == 1
        assert f"step {STEPS}/{STEPS}" in (out / name / "log.txt").read_text()
    again = warm.run("-m", "styleexp", f"resume={out / name}", cwd=tmp_path)
    assert again.returncode == 2
    assert "kept no checkpoint" in again.stderr


def test_tasks_of_several_jobs_are_for_launchers_that_start_processes(tmp_path):
    done = sweep(write_plan(tmp_path), "--per-task=2", cwd=tmp_path)
    assert done.returncode == 2
    assert "--per-task 2 is not possible with the launcher 'basic'" in done.stderr


def test_the_state_tells_the_time_left_and_each_reason_once(undisturbed, tmp_path):
    import shutil

    shutil.copytree(undisturbed[0], tmp_path / "out")
    first, second, third, fourth = manifest.read(tmp_path / "out")
    for name, status in ((first, "failed"), (second, "failed"), (third, "running")):
        content = {"schema": 1, "status": status, "reason": "no space"}
        if status == "running":
            del content["reason"]
        (tmp_path / "out" / name / "status.json").write_text(json.dumps(content))
    took = {"schema": 1, "status": "done", "seconds": 600}
    (tmp_path / "out" / fourth / "status.json").write_text(json.dumps(took))
    assert "1 died" in state.of_folder(tmp_path / "out").summary()[0]
    with locks.hold(tmp_path / "out" / third):
        found = state.of_folder(tmp_path / "out")
        told = found.summary()
    assert found.left == 1
    assert told[1:] == ["about 10 min left", f"{first} and 1 more: failed: no space"]


def test_a_cancelled_plan_stops_and_goes_on_when_it_is_started_again(undisturbed, tmp_path):
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher", reason="needs the extra sweep")
    out, path = tmp_path / "out", write_plan(tmp_path)
    victims = Victims(tmp_path, path, "--folder=out", "--launcher=submitit_local", "--jobs=1")
    try:
        runner = victims.start()
        while not any(len(reading.read(out / name).steps) >= 2 for name in running(out)):
            assert runner.poll() is None, (tmp_path / "told.txt").read_text()
            time.sleep(0.02)
        told = list(state.cancel(out))
        assert runner.wait(timeout=600) == 2, (tmp_path / "told.txt").read_text()
    finally:
        victims.end()
    assert "cancelled by styleexp-sweep cancel" in (tmp_path / "told.txt").read_text()
    states = [reading.read(out / name).last_status for name in manifest.read(out)]
    assert states.count("done") < JOBS
    if "done" not in states:  # the running job may have ended before the signal came
        assert "interrupted" in states
        assert any(line.endswith(": stopped") for line in told)
    assert sweep(path, "--folder", "out", cwd=tmp_path).returncode == 0
    assert results(out) == results(undisturbed[0])


IDLE = """\
import os, sys, time
from joblib import Parallel, delayed
from styleexp.experiments.sweeps import runner

def job(number):
    runner.end_with_runner()
    print(os.getpid(), flush=True)
    time.sleep(0.2)

if __name__ == "__main__":
    Parallel(n_jobs=2)(delayed(job)(n) for n in range(2))
    time.sleep(600)
"""


def test_workers_of_a_killed_runner_end(tmp_path):
    """joblib's own wait for ever for the next job of a runner that is no more."""
    pytest.importorskip("joblib", reason="needs the extra sweep")
    (tmp_path / "idle.py").write_text(IDLE)
    parent = subprocess.Popen(
        [sys.executable, "idle.py"], cwd=tmp_path, stdout=subprocess.PIPE, text=True
    )
    workers = {int(parent.stdout.readline()) for _ in range(2)}
    assert parent.pid not in workers
    time.sleep(1)
    parent.kill()
    parent.wait()
    until = time.monotonic() + 60
    while any(os.path.exists(f"/proc/{pid}") for pid in workers):
        assert time.monotonic() < until, "a worker outlives its runner"
        time.sleep(0.2)
