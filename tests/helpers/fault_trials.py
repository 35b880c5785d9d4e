"""Faults that can befall a run, a sweep, a cache or a download, made for real: processes are killed
with signal 9, disks are full, folders vanish. Tried by test_faults.py and benchmarks/faults.py.

A trial raises where something was lost, and returns what the user saw, if anything.
"""

from __future__ import annotations

import contextlib
import csv
import functools
import itertools
import json
import multiprocessing
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

NUMBERS = itertools.count()
STEPS = 6
SMALL = (
    "source.path=ball.ply", "style.path=knobs.ply", "method=robust", "profile=smoke",
    "encoder=vgg19_random", "preview.resolution=32", "metrics.judge=none",
    "optim.checkpoint_every=1",
)  # fmt: skip
RUN = (*SMALL, f"optim.steps={STEPS}")
PLAN = f"""\
profile: smoke
overrides: [{", ".join(f'"{each}"' for each in SMALL)}, report=false, optim.steps=4, threads=1]
experiments:
  - name: seeds
    overrides: ["optim.seed=0,1,2"]
"""
JOBS = 3
SAME = (
    "result.ply", "result.obj", "result.glb", "preview.png", "turntable.gif", "metrics.json",
)  # fmt: skip
"""Files of a run that must have the bits of an undisturbed one, as must the last checkpoint's
tensors and all of ``metrics.jsonl`` but its seconds."""
FAKETIME = "/usr/lib/x86_64-linux-gnu/faketime/libfaketime.so.1"

PRELOADED = (
    "torch", "torch._dynamo", "trimesh", "hydra", "rich.console", "safetensors.torch", "PIL.Image",
    "styleexp.cli.main", "styleexp.experiments.execute", "styleexp.cli.sweep", "styleexp.api",
    "styleexp.runs.previews", "styleexp.experiments.metrics", "styleexp.encoders.vgg",
    "styleexp.experiments.reports.page", "styleexp.experiments.sweeps.runner",
    "styleexp.experiments.sweeps.figure", "styleexp.renderers.soft_raster",
)  # fmt: skip
"""What processes are forked with, so that a life takes a second and not five."""


class Missing(Exception):
    """What a trial needs is not on this machine."""


# -------------------------------------------------------------------------------------- the stage


@dataclass
class Stage:
    """A folder with a small source and style, a cache of its own, and an undisturbed run."""

    folder: Path
    environment: dict[str, str] = field(default_factory=dict)
    seconds: float = 20.0
    """A run's, from the shell."""
    sweep_seconds: float = 20.0

    def __post_init__(self) -> None:
        from styleexp.inputs import meshes, shapes

        for name, shape, detail in (("ball", "sphere", 300), ("knobs", "bubble", 600)):
            mesh = shapes.make(shape, detail=detail)
            meshes.save_mesh(mesh, mesh.vertices, self.folder / f"{name}.ply")
        (self.folder / "plan.yaml").write_text(PLAN)
        self.environment = {
            **os.environ, "STYLEEXP_CACHE": str(self.folder / "cache"), "OMP_NUM_THREADS": "1",
            "OMP_WAIT_POLICY": "PASSIVE", "STYLEEXP_ASSETS": "",
        }  # fmt: skip

    def start(self, *arguments: str, **more: Any) -> Life:
        """A command in a process, and a session, of its own; ``more`` is what `Life` takes."""
        return Life(self, [str(each) for each in arguments], **more)

    def command(self, *arguments: str, **more: Any) -> Done:
        """The same, when it has ended."""
        life = self.start(*arguments, **more)
        try:
            life.wait(900)
        finally:
            life.end()
        return life.done()

    def run(self, folder: Path, *more: str, **options: Any) -> Done:
        """The small run in a folder."""
        return self.command(*RUN, *more, f"hydra.run.dir={folder}", **options)

    def resume(self, folder: Path, **options: Any) -> Done:
        """As a user would: ``resume=``, or the same command where the run has no record yet."""
        if (folder / "run.json").exists():
            return self.command(f"resume={folder}", **options)
        return self.run(folder, **options)

    def tidy(self) -> None:
        """Remove what a trial that failed left."""
        for path in self.folder.iterdir():
            if path.is_dir() and path.name not in ("cache", "undisturbed", "undisturbed-sweep"):
                shutil.rmtree(path, ignore_errors=True)

    @property
    def whole(self) -> Path:
        """The folder of a run that nothing befell."""
        folder = self.folder / "undisturbed"
        if not folder.exists():
            begun = time.perf_counter()
            done = self.run(folder, fresh=True)
            self.seconds = time.perf_counter() - begun
            assert done.code == 0, done.complained
        return folder

    @functools.cached_property
    def changes(self) -> int:
        """How many changes a run makes to its folder."""
        folder = self.folder / "counted"
        arguments = [*RUN, f"hydra.run.dir={folder}"]
        life = self.start(*arguments, watched=str(folder), dies_at=0)
        assert life.wait(900) == 0, life.done().complained
        return int(Path(f"{life.out}.count").read_text())

    @property
    def swept(self) -> Path:
        """The folder of a sweep that nothing befell."""
        folder = self.folder / "undisturbed-sweep"
        if not folder.exists():
            begun = time.perf_counter()
            done = self.sweep(folder)
            self.sweep_seconds = max(10.0, time.perf_counter() - begun)
            assert done.code == 0, done.complained
        return folder

    def sweep(self, folder: Path, *more: str, **options: Any) -> Done:
        """The small plan in a folder."""
        arguments = ("plan.yaml", "--folder", str(folder), *more)
        return self.command(*arguments, sweeping=True, **options)


class Life:
    """A process of ``styleexp``, or of ``styleexp-sweep`` where ``sweeping``.

    ``fresh``: it loads everything itself, as from a shell. ``memory``: bytes that it may map.
    ``dies_at``: the number of the change below the folder ``watched`` before which it is killed;
    ``torn``: after half of the change.
    """

    def __init__(
        self,
        stage: Stage,
        arguments: list[str],
        *,
        fresh: bool = False,
        sweeping: bool = False,
        environment: Mapping[str, str] | None = None,
        **fault: Any,
    ):
        self.out = stage.folder / f"told-{next(NUMBERS)}.txt"
        self.fault = fault
        environment = {**stage.environment, **(environment or {})}
        given = (arguments, str(stage.folder), environment, str(self.out), sweeping, fault)
        kind = "spawn" if fresh else "forkserver"
        context = multiprocessing.get_context(kind)
        if not fresh:
            os.environ.update(OMP_NUM_THREADS="1", OMP_WAIT_POLICY="PASSIVE")
            context.set_forkserver_preload(list(PRELOADED))
        if fresh:
            module = "styleexp.cli.sweep" if sweeping else "styleexp"
            with open(self.out, "w") as told, open(f"{self.out}.err", "w") as complained:
                self.process: Any = subprocess.Popen(
                    [sys.executable, "-m", module, *arguments], cwd=stage.folder, env=environment,
                    stdout=told, stderr=complained, start_new_session=True,
                    preexec_fn=functools.partial(_confine, **fault),
                )  # fmt: skip
        else:
            self.process = context.Process(target=_live, args=given)
            self.process.start()
        self.pid = self.process.pid

    def poll(self) -> int | None:
        """The exit code; None while it lives."""
        if isinstance(self.process, subprocess.Popen):
            return self.process.poll()
        return self.process.exitcode

    def wait(self, seconds: float) -> int | None:
        """Wait so long for its end; the exit code, None where it goes on."""
        if isinstance(self.process, subprocess.Popen):
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(seconds)
        else:
            self.process.join(seconds)
        return self.poll()

    def kill(self) -> None:
        """Signal 9, to it alone."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGKILL)
        self.wait(60)

    def stand_still(self) -> None:
        """Stop it where it is, until `go_on`."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGSTOP)
            time.sleep(0.05)  # all its threads

    def go_on(self) -> None:
        """Wake it."""
        os.kill(self.pid, signal.SIGCONT)

    def end(self) -> None:
        """Kill it and all that it started."""
        with contextlib.suppress(ProcessLookupError, PermissionError):
            if os.getpgid(self.pid) == self.pid:  # its own session has begun
                os.killpg(self.pid, signal.SIGKILL)
        self.kill()

    def done(self) -> Done:
        """How it ended."""
        code = self.poll()
        assert code is not None, "it did not end"
        told, complained = (Path(f"{self.out}{more}") for more in ("", ".err"))
        found = Done(code, _text(told), _text(complained))
        return found


def _confine(memory: int | None = None) -> None:
    if memory:
        resource.setrlimit(resource.RLIMIT_AS, (memory, memory))


def _text(path: Path) -> str:
    return path.read_text(errors="replace") if path.exists() else ""


def _live(
    arguments: list[str],
    folder: str,
    environment: dict[str, str],
    out: str,
    sweeping: bool,
    fault: dict[str, Any],
) -> None:
    """What a forked process does: the command, with a fault to come."""
    os.setsid()
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    for number, name in ((1, out), (2, f"{out}.err")):
        handle = os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        os.dup2(handle, number)
        os.close(handle)
    sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", closefd=False)  # noqa: SIM115
    sys.argv = ["styleexp", *arguments]
    _confine(fault.pop("memory", None))
    changes = [0]
    if fault:
        _watch(changes, **fault)
    from styleexp.cli import main, sweep

    try:
        sys.exit(sweep.main() if sweeping else main.main())
    finally:
        sys.stdout.flush()
        if fault.get("dies_at") == 0:
            Path(f"{out}.count").write_text(str(changes[0]))


def _watch(changes: list[int], watched: str, dies_at: int, torn: bool = False) -> None:
    """End this process before the ``dies_at``-th time that it changes something below a folder."""
    writing = os.O_WRONLY | os.O_RDWR

    def hook(event: str, given: tuple[Any, ...]) -> None:
        if event not in ("open", "os.rename", "os.remove", "os.mkdir", "os.rmdir"):
            return
        if not isinstance(given[0], str | bytes | os.PathLike):
            return
        if event == "open" and not given[2] & writing:
            return
        path = os.path.abspath(os.fsdecode(given[0]))
        if not path.startswith(watched + os.sep):
            return
        changes[0] += 1
        if changes[0] != dies_at:
            return
        if torn and event == "os.rename" and ".partial" in path:
            os.truncate(path, os.path.getsize(path) // 2)
        if torn and event == "open" and "a" in str(given[1]):
            handle = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
            os.write(handle, b'{"step": 1, "lo')
        os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(hook)


@dataclass(frozen=True)
class Done:
    """How a command ended."""

    code: int
    told: str
    complained: str

    @property
    def complaint(self) -> str:
        """What it said on standard error, without warnings."""
        lines = [x for x in self.complained.splitlines() if x.strip()]
        return "\n".join(x for x in lines if not x.startswith("warning: "))

    def sentence(self) -> str:
        """The one line that a fault should give, with exit code 2."""
        assert self.code == 2, f"exit code {self.code}: {self.complained[-2000:]}"
        assert "Traceback" not in self.complained, self.complained[-3000:]
        lines = self.complaint.splitlines()
        assert len(lines) == 1, self.complaint
        return lines[0]


# ------------------------------------------------------------------------------- what is compared


def lines(folder: Path) -> list[dict[str, Any]]:
    """``metrics.jsonl`` without what depends on the clock."""
    read = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [{k: v for k, v in line.items() if k != "seconds"} for line in read]


def checkpoint(path: Path) -> str:
    """The digest of what a whole checkpoint holds."""
    from safetensors import safe_open

    from styleexp.system import digests

    with safe_open(path, framework="pt") as opened:
        told = opened.metadata()
        tensors = {key: opened.get_tensor(key) for key in opened.keys()}  # noqa: SIM118
    found = digests.of(tensors, told["step"])
    assert found == told["digest"], f"{path.name} is torn"
    return found


def check_same(folder: Path, whole: Path) -> None:
    """A finished run has the bits of the undisturbed one, and nothing is left lying about."""
    assert json.loads((folder / "status.json").read_text())["status"] == "done"
    for name in SAME:
        assert (folder / name).read_bytes() == (whole / name).read_bytes(), f"{name} differs"
    assert lines(folder) == lines(whole)
    name = "checkpoint.safetensors"
    assert checkpoint(folder / name) == checkpoint(whole / name), f"{name} differs"
    left = [path.name for path in folder.iterdir() if ".partial" in path.name]
    assert not left, f"left behind: {left}"


def check_whole(folder: Path, whole: Path, alive: bool = False) -> None:
    """Whatever a killed run left under a final name is whole; ``alive``: another may be at it."""
    for name in SAME:
        if (folder / name).exists():
            assert (folder / name).read_bytes() == (whole / name).read_bytes(), f"{name} is torn"
    for name in ("status.json", "run.json"):
        if (folder / name).exists():
            json.loads((folder / name).read_text())
    for path in folder.glob("[!.]*.safetensors"):
        with contextlib.suppress(*((OSError,) if alive else ())):  # moved in the meantime
            checkpoint(path)
    if (folder / "report.html").exists():
        assert (folder / "report.html").read_text().rstrip().endswith("</html>")


def check_swept(folder: Path, whole: Path) -> None:
    """All jobs of a finished sweep are those of the undisturbed one, and so are their tables."""
    from styleexp.experiments.sweeps import manifest

    jobs = manifest.read(folder)
    assert [job["state"] for job in jobs.values()] == ["done"] * JOBS
    for name in jobs:
        check_same(folder / name, whole / name)

    def table(root: Path) -> list[dict[str, str]]:
        with open(root / "seeds" / "table.csv", newline="") as file:
            rows = list(csv.DictReader(file))
        return [{k: v for k, v in row.items() if k != "seconds"} for row in rows]

    assert table(folder) == table(whole)
    assert (folder / "seeds" / "figure.png").exists()


# ------------------------------------------------------------------------------------------- kills


def kill_run(stage: Stage, chance: random.Random, how: str, most: int = 5) -> tuple[int, str]:
    """Kill a run and what resumes it, up to ``most`` times, then let it finish; returns how many
    processes were killed. ``how``: "time", at a random moment of its life, or "change", before a
    random change to its folder or, every other time, after half of it."""
    folder, killed = stage.folder / f"killed-{chance.random()}", 0
    while killed < most:
        arguments = [f"resume={folder}"]
        if not (folder / "run.json").exists():
            arguments = [*RUN, f"hydra.run.dir={folder}"]
        if how == "change":
            at = 1 + int(chance.random() * stage.changes)
            torn = chance.random() < 0.5
            life = stage.start(*arguments, watched=str(folder), dies_at=at, torn=torn)
            life.wait(900)
        else:
            life = stage.start(*arguments, fresh=True)
            life.wait(chance.uniform(0, stage.seconds))
            life.kill()
        if life.poll() == 0:
            break
        assert life.poll() == -signal.SIGKILL, life.done().complained[-2000:]
        killed += 1
        if folder.exists():
            check_whole(folder, stage.whole)
    done = stage.resume(folder)
    assert done.code == 0, done.complained[-2000:]
    check_same(folder, stage.whole)
    shutil.rmtree(folder)
    return killed, "the shell's `Killed`; `resume=` goes on"


def kill_sweep(
    stage: Stage, chance: random.Random, launcher: str = "joblib", most: int = 5
) -> tuple[int, str]:
    """Kill runners and workers of a sweep, up to ``most`` of them, and let it finish."""
    folder, killed, alone = stage.folder / f"swept-{chance.random()}", 0, 0
    whole, seconds = stage.swept, stage.sweep_seconds

    def start() -> Life:
        return stage.start(
            "plan.yaml", "--folder", str(folder), "--launcher", launcher, sweeping=True, fresh=True
        )

    runner = start()
    try:
        while killed < most:
            if runner.wait(chance.uniform(0, seconds)) is not None:
                break
            workers = [pid for pid in _workers(folder) if pid != runner.pid]
            # Three times the same job alone, and the runner rightly calls it failed.
            if workers and alone < 2 and chance.random() < 0.5:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(chance.choice(workers), signal.SIGKILL)
                    killed, alone = killed + 1, alone + 1
            else:
                runner.kill()
                killed, alone = killed + 1, 0
                runner = start()
            for path in folder.glob("seeds/*/run.json"):
                check_whole(path.parent, whole / "seeds" / path.parent.name, alive=True)
        assert runner.wait(900) == 0, runner.done().complained[-3000:] + runner.done().told[-3000:]
        check_swept(folder, whole)
    finally:
        runner.end()
    shutil.rmtree(folder)
    return (
        killed,
        "`a worker failed …; going on`, or the shell's `Killed`: the same command goes on",
    )


def _workers(folder: Path) -> list[int]:
    """Processes that are at a job of the sweep."""
    from styleexp.experiments.sweeps import manifest
    from styleexp.runs import reading

    if not (folder / manifest.NAME).exists():
        return []
    return [
        job["process"]
        for name, job in manifest.read(folder).items()
        if job["state"] == "running" and reading.read(folder / name).status == "running"
    ]


# ------------------------------------------------------------------------------- disks and folders


@contextlib.contextmanager
def disk(folder: Path, size: int) -> Iterator[None]:
    """A file system of so many bytes at ``folder``."""
    if os.geteuid() != 0:
        raise Missing("mounting a file system needs root")
    folder.mkdir()
    options = ["-t", "tmpfs", "-o", f"size={size},mode=755", "tmpfs", str(folder)]
    done = subprocess.run(["mount", *options], capture_output=True, text=True, check=False)
    if done.returncode:
        raise Missing(f"mounting a file system is refused ({done.stderr.strip()})")
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)
        folder.rmdir()


def remount(folder: Path, options: str) -> None:
    """Change a mounted disk: ``size=…``, ``ro``."""
    subprocess.run(["mount", "-o", f"remount,{options}", str(folder)], check=True)


def size_of(folder: Path) -> int:
    """Bytes of the files below a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def full_disk(stage: Stage, chance: random.Random) -> str:
    """The disk is full at some moment of a run; when there is room, it is resumed."""
    needed = size_of(stage.whole)
    small = stage.folder / "disk"
    with disk(small, chance.randint(64 << 10, int(0.95 * needed))):
        said = stage.run(small / "run").sentence()
        if (small / "run").exists():
            check_whole(small / "run", stage.whole)
        remount(small, f"size={4 * needed}")
        done = stage.resume(small / "run")
        assert done.code == 0, done.complaint
        check_same(small / "run", stage.whole)
    return said


def full_disk_of_a_sweep(stage: Stage, chance: random.Random) -> str:
    """The same with a sweep."""
    needed = size_of(stage.swept)
    small = stage.folder / "disk"
    with disk(small, chance.randint(64 << 10, int(0.95 * needed))):
        done = stage.sweep(small / "sweep")
        assert done.code == 2
        assert "Traceback" not in done.complained + done.told, done.complained[-2000:]
        said = next(x for x in (done.complaint + done.told).splitlines() if "space" in x)
        remount(small, f"size={4 * needed}")
        again = stage.sweep(small / "sweep", "--retry")
        assert again.code == 0, again.complaint + again.told
        check_swept(small / "sweep", stage.swept)
    return said


@contextlib.contextmanager
def frozen(*paths: Path) -> Iterator[None]:
    """Nobody, root included, may change these files, or what these folders list."""
    done = subprocess.run(["chattr", "+i", *paths], capture_output=True, text=True, check=False)
    try:
        if done.returncode:
            raise Missing(f"chattr +i is refused ({done.stderr.strip()})")
        yield
    finally:
        subprocess.run(["chattr", "-i", *paths], capture_output=True, check=False)


def read_only(stage: Stage, chance: random.Random) -> str:
    """A run's folder becomes read-only under it, and writable again."""
    folder = stage.folder / "frozen"
    with at_work(stage, folder) as life, frozen(folder, folder / "metrics.jsonl"):
        life.go_on()
        assert life.wait(600) is not None
        begun = stage.run(folder / "other").sentence()
        assert "hydra.run.dir" in begun
    said = life.done().sentence()
    check_whole(folder, stage.whole)
    done = stage.resume(folder)
    assert done.code == 0, done.complained[-2000:]
    check_same(folder, stage.whole)
    shutil.rmtree(folder)
    return said


def frozen_job(stage: Stage, chance: random.Random) -> str:
    """The folder of one job of a sweep can't be written; the others are done."""
    from styleexp.experiments.sweeps import manifest

    folder = stage.folder / "frozen-sweep"
    names = sorted(manifest.read(stage.swept))
    lost = folder / chance.choice(names)
    lost.mkdir(parents=True)
    with frozen(lost):
        done = stage.sweep(folder)
        assert "Traceback" not in done.complained + done.told, done.complained[-2000:]
        said = done.sentence()
        for name in set(names) - {str(lost.relative_to(folder))}:
            check_same(folder / name, stage.swept / name)
    again = stage.sweep(folder, "--retry")
    assert again.code == 0, again.complaint
    check_swept(folder, stage.swept)
    shutil.rmtree(folder)
    return said


def read_only_disk(stage: Stage, chance: random.Random) -> str:
    """A whole disk is read-only: the run's, then the cache's."""
    assert stage.whole
    small = stage.folder / "disk"
    with disk(small, 64 << 20):
        shutil.copytree(stage.folder / "cache", small / "cache")
        remount(small, "ro")
        said = stage.run(small / "run").sentence()
        folder = stage.folder / "cacheless"
        seed = f"optim.seed={chance.randrange(1, 100)}"  # not in the cache
        for given in ((), (seed,)):
            done = stage.run(folder, *given, environment={"STYLEEXP_CACHE": str(small / "cache")})
            assert done.code == 0, done.complained[-2000:]
            if not given:
                check_same(folder, stage.whole)
            shutil.rmtree(folder)
    return said


def removed_folder(stage: Stage, chance: random.Random) -> str:
    """A run's folder is removed while it is at work; the same command starts it anew."""
    folder = stage.folder / "removed"
    with at_work(stage, folder, after=chance.uniform(0, 0.3)) as life:
        shutil.rmtree(folder)
        life.go_on()
        life.wait(600)
    said = life.done().sentence()
    assert stage.run(folder).code == 0
    check_same(folder, stage.whole)
    shutil.rmtree(folder)
    return said


def removed_sweep(stage: Stage, chance: random.Random) -> str:
    """A job's folder, or the whole sweep's, is removed while it is at work."""
    folder = stage.folder / "removed-sweep"
    life = stage.start("plan.yaml", "--folder", str(folder), sweeping=True)
    try:
        while not (found := list(folder.glob("seeds/*/metrics.jsonl"))):
            assert life.poll() is None
            time.sleep(0.05)
        shutil.rmtree(chance.choice([folder, found[0].parent]), ignore_errors=True)
        life.wait(900)
    finally:
        life.end()
    done = life.done()
    told = done.told + done.complained
    assert "Traceback" not in told, told[-3000:]
    if done.code != 0:
        again = stage.sweep(folder, "--retry")
        assert again.code == 0, again.complaint
    check_swept(folder, stage.swept)
    shutil.rmtree(folder)
    notes = [x for x in told.splitlines() if "was removed" in x or "continuing" in x]
    return notes[0] if notes else "nothing"


@contextlib.contextmanager
def at_work(
    stage: Stage, folder: Path, name: str = "metrics.jsonl", after: float = 0.0
) -> Iterator[Life]:
    """The small run, made to stand still so many seconds after a file of its folder is there; tried
    again where this machine was too busy to catch it before its end."""
    for _ in range(20):
        life = stage.start(*RUN, f"hydra.run.dir={folder}")
        try:
            wait_for(folder / name, life)
            time.sleep(after)
            life.stand_still()
            if life.poll() is None and not ended(folder):
                yield life
                return
        finally:
            life.end()
        shutil.rmtree(folder)
        after /= 2
    raise AssertionError("the run always ended before it could be made to stand still")


def ended(folder: Path) -> bool:
    """Whether a run's folder says so."""
    return json.loads((folder / "status.json").read_text())["status"] != "running"


def wait_for(path: Path, life: Life, seconds: float = 300) -> None:
    """Until a file is there."""
    until = time.monotonic() + seconds
    while not path.exists():
        assert life.poll() is None, life.done().complained[-2000:]
        assert time.monotonic() < until, f"no {path.name} after {seconds:.0f} s"
        time.sleep(0.02)


# ------------------------------------------------------------------------------ clocks and memory


def clock_jumps(stage: Stage, chance: random.Random) -> str:
    """The system's clock jumps years back and forth under a run, which is killed and resumed."""
    if not Path(FAKETIME).exists():
        raise Missing("libfaketime (apt-get install faketime)")
    folder, clock = stage.folder / "clock", stage.folder / "clock.txt"
    moments = ["-30y", "+40y", "-3d", "@1970-01-02 00:00:00", "+1h", "-1s"]
    clock.write_text(chance.choice(moments))
    faked = {
        "LD_PRELOAD": FAKETIME, "FAKETIME_TIMESTAMP_FILE": str(clock), "FAKETIME_NO_CACHE": "1",
        "DONT_FAKE_MONOTONIC": "1", "FAKETIME_DONT_RESET": "1",
    }  # fmt: skip
    for kill in (True, False):
        recorded = (folder / "run.json").exists()
        arguments = [f"resume={folder}"] if recorded else [*RUN, f"hydra.run.dir={folder}"]
        life = stage.start(*arguments, environment=faked, fresh=True)
        try:
            until = time.monotonic() + 600
            while life.poll() is None and time.monotonic() < until:
                time.sleep(0.1)
                clock.write_text(chance.choice(moments))
                steps = folder / "metrics.jsonl"
                if kill and steps.exists() and steps.read_bytes().count(b"\n") >= 2:
                    life.kill()
        finally:
            life.end()
    assert life.poll() == 0, life.done().complained[-2000:]
    check_same(folder, stage.whole)
    shutil.rmtree(folder)
    return "nothing"


def out_of_memory(stage: Stage, chance: random.Random) -> str:
    """A run may not have the memory that its views need; the same command with smaller ones can."""
    limit = chance.randint(2500, 3500) << 20
    folder = stage.folder / "memory"
    greedy = ("views.resolution=2000", "views.count=8")
    said = stage.run(folder, *greedy, memory=limit).sentence()
    assert "not enough memory" in said, said
    assert stage.run(folder).code == 0
    check_same(folder, stage.whole)
    shutil.rmtree(folder)
    return said


def out_of_memory_in_a_worker(stage: Stage, chance: random.Random) -> str:
    """One job of a sweep gets no memory: it fails, its neighbours are done."""
    from styleexp.experiments.sweeps import manifest
    from styleexp.runs import reading

    limit = chance.randint(2500, 3500) << 20
    plan = PLAN + '  - name: greedy\n    overrides: ["views.resolution=2000", "views.count=8"]\n'
    (stage.folder / "greedy.yaml").write_text(plan)
    folder = stage.folder / "memory-sweep"
    arguments = ("greedy.yaml", "--folder", str(folder), "--launcher", "joblib")
    done = stage.command(*arguments, sweeping=True, fresh=True, memory=limit)
    assert done.code == 2, done.complaint
    assert "Traceback" not in done.told + done.complained, done.complained[-2000:]
    states = {name: job["state"] for name, job in manifest.read(folder).items()}
    assert sorted(states.values()) == ["done"] * JOBS + ["failed"], states
    (failed,) = (name for name, state in states.items() if state == "failed")
    for name in states.keys() - {failed}:
        check_same(folder / name, stage.swept / name)
    reason = str(reading.read(folder / failed).reason)
    shutil.rmtree(folder)
    return reason


# ----------------------------------------------------------------------------------- damaged files


def damage(path: Path, chance: random.Random) -> None:
    """Cut a file off, turn one of its bits, or fill it with zeros or something else."""
    content = bytearray(path.read_bytes())
    kind = chance.choice(["cut", "bit", "bit", "zeros", "empty", "other"])
    if kind == "cut":
        content = content[: chance.randrange(len(content))]
    elif kind == "bit":
        content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
    elif kind == "zeros":
        start = chance.randrange(len(content))
        content[start : start + 4096] = bytes(len(content[start : start + 4096]))
    path.write_bytes({"empty": b"", "other": b"<html>" * 100}.get(kind, bytes(content)))


def damaged_checkpoint(stage: Stage, chance: random.Random) -> str:
    """The last checkpoint, or both, or a record of an interrupted run is damaged."""
    folder = stage.folder / "damaged"
    shutil.copytree(stage.whole, folder)
    for name in SAME:
        (folder / name).unlink()
    status = folder / "status.json"
    status.write_text(status.read_text().replace('"done"', '"running"'))
    names = ["checkpoint.safetensors"]
    names += chance.choice([[], [], ["checkpoint.previous.safetensors"], ["metrics.jsonl"]])
    for name in names:
        before = (folder / name).read_bytes()
        while (folder / name).read_bytes() == before:  # zeros may have been zeros
            damage(folder / name, chance)
    done = stage.command(f"resume={folder}")
    assert done.code == 0, done.complained[-2000:]
    (said,) = (x for x in done.told.splitlines() if "safetensors is damaged" in x)
    anew = "checkpoint.previous.safetensors" in names
    assert ("restarting the run" if anew else "using the previous checkpoint") in said
    lost = [line for line in lines(stage.whole) if line not in lines(folder)]
    assert len(lost) == 0 or "metrics.jsonl" in names
    if "metrics.jsonl" in names:  # a flipped bit may be one of the clock's
        assert f"{len(lost)} lines are lost" in done.told or len(lost) <= 1
        (folder / "metrics.jsonl").write_bytes((stage.whole / "metrics.jsonl").read_bytes())
    check_same(folder, stage.whole)
    shutil.rmtree(folder)
    return said


def damaged_record(stage: Stage, chance: random.Random) -> str:
    """``run.json`` or ``status.json`` of a run is damaged: the same command still ends well."""
    folder = stage.folder / "damaged"
    shutil.copytree(stage.whole, folder)
    status = folder / "status.json"
    status.write_text(status.read_text().replace('"done"', '"running"'))
    name = chance.choice(["run.json", "status.json"])
    content = (folder / name).read_bytes()
    (folder / name).write_bytes(content[: chance.randrange(len(content) - 2)])
    said = "nothing: restarting the run"
    if name == "run.json":
        said = stage.command(f"resume={folder}").sentence()
    done = stage.run(folder)
    assert done.code == 0, done.complained[-2000:]
    check_same(folder, stage.whole)
    shutil.rmtree(folder)
    return said


def damaged_cache(stage: Stage, chance: random.Random) -> str:
    """Remembered Gram matrices are damaged; they are made again."""
    assert stage.whole
    files = sorted((stage.folder / "cache" / "grams").glob("*.safetensors"))
    before = {path: path.read_bytes() for path in files}
    assert before
    for path in files:
        while path.read_bytes() == before[path]:
            damage(path, chance)
    folder = stage.folder / "cached"
    done = stage.run(folder)
    assert done.code == 0, done.complained[-2000:]
    check_same(folder, stage.whole)
    made = [path for path in files if path.read_bytes() == before[path]]
    assert made, "no file was made again"
    for path in files:
        path.write_bytes(before[path])
    shutil.rmtree(folder)
    return "nothing"


def damaged_sweep(stage: Stage, chance: random.Random) -> str:
    """The manifest of a sweep is damaged: the sweep says so, and goes on without it."""
    folder = stage.folder / "damaged-sweep"
    shutil.copytree(stage.swept, folder)
    path = folder / "manifest.json"
    content = path.read_bytes()
    path.write_bytes(content[: chance.randrange(1, len(content) - 2)])
    said = stage.sweep(folder).sentence()
    path.unlink()
    assert stage.sweep(folder).code == 0
    check_swept(folder, stage.swept)
    shutil.rmtree(folder)
    return said


# -------------------------------------------------------------------------------- two at one place


def two_runs(stage: Stage, chance: random.Random) -> str:
    """A second run, with other settings, is sent to the folder of one that is at work."""
    folder = stage.folder / "shared"
    name = "run.json" if chance.random() < 0.5 else "metrics.jsonl"
    with at_work(stage, folder, name) as life:  # it is still there when the others have begun
        more = chance.choice([("optim.seed=7",), ()])
        said = stage.run(folder, *more, "optim.steps=30").sentence()
        assert stage.command(f"resume={folder}").sentence()
        life.go_on()
        life.wait(600)
    assert life.poll() == 0, life.done().complained[-2000:]
    check_same(folder, stage.whole)
    overrides = (folder / ".hydra" / "overrides.yaml").read_text()
    assert "optim.steps=30" not in overrides, "the second run's settings lie in the first's folder"
    shutil.rmtree(folder)
    return said


# ------------------------------------------------------------------------------------- downloads

FETCH = """\
import dataclasses, sys
import pooch.core
from styleexp.inputs import assets
from styleexp.cli.assets import main
pooch.core.time.sleep = lambda seconds: None
known = assets.ASSETS["vgg19"]
assets.ASSETS["vgg19"] = dataclasses.replace(known, url=sys.argv[1], sha256=sys.argv[2])
sys.exit(main(["fetch", "vgg19"]))
"""


@contextlib.contextmanager
def shop(body: bytes, fault: str) -> Iterator[str]:
    """A server on this machine that sends a file: ``whole``, ``cut`` in the middle of it, with a
    ``wrong`` byte, or ``stalled`` in the middle; yields the file's address."""
    import http.server
    import threading

    stop = threading.Event()

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            if fault in ("whole", "wrong"):
                self.wfile.write(body[:-1] + bytes([body[-1] ^ (fault == "wrong")]))
                return
            self.wfile.write(body[: len(body) // 2])
            self.wfile.flush()
            if fault == "stalled":
                stop.wait(120)

        def log_message(self, *_: object) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/vgg19.pth"
    finally:
        stop.set()
        server.shutdown()
        server.server_close()


def _shelf(stage: Stage) -> bytes:
    from test_assets import make_state_dict

    path = stage.folder / "shelf.pth"
    if not path.exists():
        make_state_dict(path)
    return path.read_bytes()


def _fetch(stage: Stage, url: str, body: bytes, cache: Path) -> subprocess.Popen:
    import hashlib

    digest = hashlib.sha256(body).hexdigest()[:8]
    environment = {**stage.environment, "STYLEEXP_CACHE": str(cache), "NO_PROXY": "127.0.0.1"}
    return subprocess.Popen(
        [sys.executable, "-c", FETCH, url, digest], cwd=stage.folder, env=environment, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True,
    )  # fmt: skip


def bad_download(stage: Stage, chance: random.Random, fault: str) -> str:
    """Weights are fetched from a server that sends half of them or something else, or the process
    is killed, or the cache's disk is full, in the middle; then from a whole one."""
    from styleexp.inputs import weights

    body, cache = _shelf(stage), stage.folder / f"cache-{chance.random()}"
    room = disk(cache, 16 << 10) if fault == "full" else contextlib.nullcontext()
    served = {"killed": "stalled", "full": "whole"}.get(fault, fault)
    with room:
        with shop(body, served) as url:
            process = _fetch(stage, url, body, cache)
            if fault == "killed":
                while not list(cache.glob("weights/.fetch*/*")):
                    assert process.poll() is None, process.communicate()
                    time.sleep(0.05)
                time.sleep(chance.uniform(0, 0.3))
                os.kill(process.pid, signal.SIGKILL)
            told, complained = process.communicate(timeout=300)
        said = "nothing but the shell's 'Killed'; the next run fetches it again"
        if fault != "killed":
            assert "Traceback" not in complained, complained
            said = Done(process.returncode, told, complained.splitlines()[-1]).sentence()
        assert not list(cache.glob("weights/[!.]*.safetensors"))
        if fault == "full":
            remount(cache, "size=64m")
        with shop(body, "whole") as url:
            process = _fetch(stage, url, body, cache)
            told, complained = process.communicate(timeout=300)
            assert process.returncode == 0, complained
        assert len(weights.read(told.strip()).tensors) == 32
    shutil.rmtree(cache, ignore_errors=True)
    return re.sub(r"127\.0\.0\.1:\d+", "127.0.0.1", said).replace(str(stage.folder), "…")


# ----------------------------------------------------------------------------------------- the list


@dataclass(frozen=True)
class Fault:
    """A row of the table in docs/robustness.md."""

    name: str
    trial: Callable[..., Any]
    """Takes the stage and a source of chance; returns what the user saw, or how many processes were
    killed and that."""
    times: int
    given: Mapping[str, Any] = field(default_factory=dict)

    def tried(self, stage: Stage, chance: random.Random, **more: Any) -> tuple[int, str]:
        """How often it was tried, which is once but for kills, and what the user saw."""
        found = self.trial(stage, chance, **self.given, **more)
        count, said = found if isinstance(found, tuple) else (1, found)
        return count, said.replace(f"{stage.folder}/", "")


FAULTS = {
    each.name: each
    for each in (
        Fault("kill -9 of a run, at any moment of its life", kill_run, 25, {"how": "time"}),
        Fault("kill -9 of a run, as it changes its folder", kill_run, 25, {"how": "change"}),
        Fault("kill -9 of a sweep's runner or worker", kill_sweep, 20),
        Fault("disk full under a run", full_disk, 5),
        Fault("disk full under a sweep", full_disk_of_a_sweep, 3),
        Fault("folder made read-only under a run", read_only, 2),
        Fault("folder of a job of a sweep can't be written", frozen_job, 2),
        Fault("read-only disk: the run's, the cache's", read_only_disk, 2),
        Fault("folder removed under a run", removed_folder, 3),
        Fault("folder of a job, or of all, removed under a sweep", removed_sweep, 3),
        Fault("clock jumps by up to 40 years, with a kill -9", clock_jumps, 2),
        Fault("not enough memory for a run", out_of_memory, 2),
        Fault("not enough memory for a job of a sweep", out_of_memory_in_a_worker, 2),
        Fault("damaged checkpoint, or both, or metrics.jsonl", damaged_checkpoint, 10),
        Fault("damaged run.json or status.json", damaged_record, 5),
        Fault("damaged manifest.json", damaged_sweep, 3),
        Fault("damaged cache of Gram matrices", damaged_cache, 5),
        Fault("a second run, and a resume, in a run's folder", two_runs, 2),
        Fault("download cut in the middle", bad_download, 3, {"fault": "cut"}),
        Fault("download with a wrong byte", bad_download, 3, {"fault": "wrong"}),
        Fault("kill -9 in the middle of a download", bad_download, 3, {"fault": "killed"}),
        Fault("disk full in the middle of a download", bad_download, 3, {"fault": "full"}),
    )
}
