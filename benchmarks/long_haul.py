"""Soak test: many steps in a run, many runs in one process, and a sweep of many jobs. Checks for
growth, leaks and losses.

    python benchmarks/long_haul.py                          # 500 steps, 500 runs, 2000 jobs
    python benchmarks/long_haul.py --runs 100 --jobs 0 --steps 0    # only the runs, fewer
    python benchmarks/long_haul.py --runs 0 --jobs 2000 --steps 0 --launcher joblib
    python benchmarks/long_haul.py --seconds 1800           # as many of all as there is time for

Prints and writes into docs/robustness.md: memory and its slope after a warm-up (least squares),
what of it the C library has given out (where that is glibc: the rest are holes between), open
files, threads, OpenGL contexts and temporary files at the beginning and at the end; of the sweep
also its table's rows and the time that the report took. Exit code 1 if a run failed, a row is
missing, or files, contexts or temporary files are more than they were.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import ctypes
import gc
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "robustness.md"
MARKS = {
    kind: (f"<!-- begin: benchmarks/long_haul.py, {kind} -->\n", f"<!-- end: {kind} -->\n")
    for kind in ("steps", "runs", "jobs")
}
SMALL = (
    "method=robust", "profile=smoke", "encoder=vgg16", "optim.steps=1", "views.resolution=48",
    "preview.resolution=32", "preview.turntable_frames=2", "report=false",
)  # fmt: skip
WARM_UP = 0.2
"""Warm-up fraction excluded from the slope, while caches fill and allocators settle."""
PAGE_SIZE = os.sysconf("SC_PAGE_SIZE")


@dataclass(frozen=True)
class Sample:
    """Resources held by one or several processes at one time."""

    at: float
    """Number of steps, runs or jobs done."""
    memory: float
    """Resident memory in MB."""
    files: int
    threads: int
    contexts: int = 0
    temporary: int = 0
    used: float = float("nan")
    """MB allocated by the C library and not freed; resident memory also includes its holes."""


def of_process(pid: int) -> tuple[float, int, int]:
    """Resident MB, open files and threads of a process."""
    at = Path(f"/proc/{pid}")
    pages = int((at / "statm").read_text().split()[1])
    return pages * PAGE_SIZE / 1e6, len(list((at / "fd").iterdir())), len(list(at.glob("task/*")))


class _Arenas(ctypes.Structure):
    """glibc's ``struct mallinfo2``."""

    _fields_ = tuple(
        (name, ctypes.c_size_t)
        for name in ("arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks",
                     "uordblks", "fordblks", "keepcost")
    )  # fmt: skip


def given_out() -> float:
    """MB that this process has allocated from the C library; NaN unless it is glibc 2.33 or
    newer."""
    tell = getattr(ctypes.CDLL(None), "mallinfo2", None)
    if tell is None:
        return float("nan")
    tell.restype = _Arenas
    told = tell()
    return float(told.uordblks + told.hblkhd) / 1e6


def contexts() -> int:
    """Number of unfreed OpenGL contexts in this process."""
    if "moderngl" not in sys.modules:
        return 0
    kind: Any = sys.modules["moderngl"].Context
    return sum(type(each) is kind for each in gc.get_objects())


def slope(samples: list[Sample]) -> float:
    """MB per unit of ``at`` after the warm-up."""
    import numpy as np

    kept = samples[int(WARM_UP * len(samples)) :]
    return float(np.polyfit([s.at for s in kept], [s.memory for s in kept], 1)[0])


def prepare(folder: Path) -> None:
    """Small sources and styles, meshes and a picture."""
    import numpy as np
    from PIL import Image

    from styleexp.inputs import meshes, shapes

    for name, shape in (("ball", "sphere"), ("ring", "torus"), ("knobs", "bubble"),
                        ("ridges", "rail")):  # fmt: skip
        mesh = shapes.make(shape, detail=500)
        meshes.save_mesh(mesh, mesh.vertices, folder / f"{name}.ply")
    rows = (np.sin(np.arange(96) / 3) * 100 + 128).astype(np.uint8)
    Image.fromarray(np.repeat(rows[:, None], 96, axis=1)).save(folder / "rows.png")


# --------------------------------------------------------------------------------- steps, one run


def many_steps(count: int, until: float, every: int = 5) -> list[Sample]:
    """Run this many steps with the sizes of ``profile=fast``."""
    from styleexp.config.compose import compose
    from styleexp.method import baselines

    given = [
        "source=torus",
        "style=bubble",
        "method=robust",
        "profile=fast",
        "threads=1",
        f"optim.steps={count}",
    ]
    config = compose(given)
    method = baselines.method(config)
    scene = method.prepare(config)
    samples = []
    for step in method.optimise(scene, method.start(scene)):
        if step.step % every == 0:
            samples.append(Sample(step.step, *of_process(os.getpid()), used=given_out()))
        if time.perf_counter() > until and samples:
            break
    return samples


# ------------------------------------------------------------------------------ runs, one process


def renderers() -> list[str]:
    """Renderers that are usable here."""
    from styleexp import plugins
    from styleexp.system.errors import UserError

    found = []
    for name in ("soft_raster", "moderngl_deferred", "mitsuba_ad"):
        with contextlib.suppress(UserError):
            plugins.usable("renderer", name)
            found.append(name)
    return found


def variants(folder: Path) -> Iterator[list[str]]:
    """Endless sequence of different runs; a cycle of sixty covers every combination."""
    usable, number = renderers(), 0
    while True:
        source = ("ball", "ring")[number % 2]
        style = ("knobs.ply", "rows.png", "ridges.ply")[number % 3]
        yield [
            *SMALL, f"source.path={folder}/{source}.ply", f"style.path={folder}/{style}",
            f"renderer={usable[number // 2 % len(usable)]}", f"optim.seed={number % 7}",
            f"method={'paper' if number % 5 == 4 else 'robust'}",
            f"metrics.judge={'auto' if number % 10 == 9 else 'none'}",
        ]  # fmt: skip
        number += 1


def many_runs(count: int, folder: Path, until: float, every: int = 5) -> list[Sample]:
    """Run this many in this process, time permitting, sampling resources every few runs."""
    from styleexp.config.compose import compose
    from styleexp.experiments.execute import run

    samples, given = [], variants(folder)
    with open(os.devnull, "w") as nowhere:
        for number in range(1, count + 1):
            if time.perf_counter() > until and samples:
                break
            overrides = next(given)
            with contextlib.redirect_stdout(nowhere), contextlib.redirect_stderr(nowhere):
                code = run(compose(overrides), folder / "run", overrides)
            if code:
                raise SystemExit(f"run {number} ended with {code}: {' '.join(overrides)}")
            if number % every == 0:
                gc.collect()
                left = len(list(Path(tempfile.gettempdir()).iterdir()))
                samples.append(
                    Sample(number, *of_process(os.getpid()), contexts(), left, given_out())
                )
            if number % 50 == 0:
                print(f"{number} runs, {samples[-1].memory:.0f} MB", flush=True)
    return samples


# ----------------------------------------------------------------------------------- jobs, a sweep


def plan(jobs: int, folder: Path) -> Path:
    """A plan of so many jobs: two sources, two styles, as many seeds as it takes. A tenth of them
    learn; the others lay the style's height map on, as a sweep's jobs are here for what is around
    them: composing, launching, locks, records, tables."""
    small = ", ".join(SMALL)
    text = f"profile: smoke\noverrides: [{small}, metrics.judge=none]\nexperiments:\n"
    learning = max(1, jobs // 40)
    pairs = f'"source.path={folder}/ball.ply,{folder}/ring.ply", '
    pairs += f'"style.path={folder}/knobs.ply,{folder}/ridges.ply"'
    for name, method, count in (
        ("learned", "robust", learning),
        ("laid", "displacement_map", -(-jobs // 4) - learning),
    ):
        text += f"  - name: {name}\n    seeds: [{', '.join(map(str, range(count)))}]\n"
        text += f'    overrides: [{pairs}, "method={method}"]\n'
    path = folder / "plan.yaml"
    path.write_text(text)
    return path


def family(pid: int) -> list[int]:
    """A process and its descendants."""
    found = [pid]
    for each in found:  # grows
        for path in Path(f"/proc/{each}/task").glob("*/children"):
            with contextlib.suppress(OSError):
                found += map(int, path.read_text().split())
    return found


def many_jobs(
    jobs: int, launcher: str, folder: Path, until: float
) -> tuple[dict[int, list[Sample]], dict[str, Any]]:
    """Run the sweep; samples of the runner and of its workers by process, and what came out. When
    time is up it is stopped."""
    command = [sys.executable, "-m", "styleexp.cli.sweep", str(plan(jobs, folder))]
    command += ["--folder", str(folder / "sweep"), "--launcher", launcher]
    samples: dict[int, list[Sample]] = {}
    begun, planned, last = time.perf_counter(), 0.0, 0.0
    with open(folder / "told.txt", "w") as told:
        runner = subprocess.Popen(command, stdout=told, stderr=told)
        while runner.poll() is None:
            time.sleep(5)
            if time.perf_counter() > until:
                runner.send_signal(signal.SIGINT)
                runner.wait()
            lines = (folder / "told.txt").read_text().splitlines()
            done = sum(": done in" in line for line in lines)
            if done and not planned:
                planned = time.perf_counter() - begun
            if done < jobs:
                last = time.perf_counter() - begun
            for pid in family(runner.pid):
                with contextlib.suppress(OSError):
                    held = of_process(pid)
                    if held[0]:  # of one that has just ended nothing is left
                        samples.setdefault(pid, []).append(Sample(done, *held))
    seconds = time.perf_counter() - begun
    rows = []
    for table in (folder / "sweep").glob("*/table.csv"):
        with open(table, newline="") as file:
            rows += csv.DictReader(file)
    found = {
        "reached": done,
        "code": runner.returncode, "rows": len(rows), "seconds": seconds, "planned": planned,
        "done": sum(row["status"] == "done" for row in rows), "report": seconds - last,
    }  # fmt: skip
    return samples, found


# ------------------------------------------------------------------------------------- the report


def row(name: str, unit: str, samples: list[Sample]) -> str:
    """A process's row in the table."""
    first, last = samples[int(WARM_UP * len(samples))], samples[-1]
    cells = [
        name, f"{len(samples)}", f"{first.memory:.0f} → {last.memory:.0f}",
        f"{max(s.memory for s in samples):.0f}", f"{1000 * slope(samples):+.1f} kB a {unit}",
        f"{first.files} → {last.files}", f"{first.threads} → {last.threads}",
        f"{first.contexts} → {last.contexts}", f"{first.temporary} → {last.temporary}",
        f"{first.used:.1f} → {last.used:.1f}".replace("nan → nan", ""),
    ]  # fmt: skip
    return "| " + " | ".join(cells) + " |\n"


HEAD = (
    "| process | looked at | memory, MB | most | slope | open files | threads | OpenGL contexts "
    "| temporary files | given out, MB |\n" + "| --- " * 10 + "|\n"
)


def write(kind: str, text: str) -> None:
    """Insert a section into the page."""
    begin, end = MARKS[kind]
    page = PAGE.read_text(encoding="utf-8")
    start = page.index(begin) + len(begin)
    PAGE.write_text(page[:start] + text + page[page.index(end) :], encoding="utf-8")
    print(text)


def main() -> int:
    """Run all tests and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--runs", type=int, default=500)
    parser.add_argument("--jobs", type=int, default=2000)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="for all together")
    parser.add_argument("--launcher", default="basic", choices=["basic", "joblib"])
    options = parser.parse_args()
    started = time.perf_counter()
    folder, wrong = Path(tempfile.mkdtemp(prefix="styleexp-haul-")), False
    from styleexp.inputs import assets

    known = [os.environ.get("STYLEEXP_ASSETS", ""), str(assets.cache_dir())]  # weights are there
    os.environ["STYLEEXP_ASSETS"] = os.pathsep.join(known)
    os.environ["STYLEEXP_CACHE"] = str(folder / "cache")
    tempfile.tempdir = str(folder / "tmp")  # so that what is left there is seen
    os.environ["TMPDIR"] = tempfile.tempdir
    (folder / "tmp").mkdir()
    try:
        prepare(folder)
        if options.steps:
            begun = time.perf_counter()
            samples = many_steps(options.steps, started + options.seconds / 4)
            minutes = (time.perf_counter() - begun) / 60
            text = f"One run of {samples[-1].at:.0f} steps, torus with bubbles at `profile=fast`, "
            text += f"{minutes:.0f} min:\n\n"
            write("steps", text + HEAD + row("the process", "step", samples))
        if options.runs:
            begun, used = time.perf_counter(), time.process_time()
            samples = many_runs(options.runs, folder, started + options.seconds / 2)
            seconds = time.perf_counter() - begun
            text = f"{samples[-1].at:.0f} runs with {', '.join(renderers())} in {seconds / 60:.0f} "
            text += f"min ({time.process_time() - used:.0f} s of CPU):\n\n"
            write("runs", text + HEAD + row("the process", "run", samples))
            first, last = samples[int(WARM_UP * len(samples))], samples[-1]
            wrong |= last.files > first.files or last.contexts > first.contexts
            wrong |= last.temporary > first.temporary
        if options.jobs:
            until = started + options.seconds
            processes, found = many_jobs(options.jobs, options.launcher, folder, until)
            ended = time.perf_counter() < until
            text = f"A sweep of {options.jobs} jobs, launcher {options.launcher}: "
            text += f"{found['seconds'] / 60:.0f} min in all, {found['planned']:.0f} s before the "
            text += "first job was done; "
            if ended:
                text += f"exit code {found['code']}, {found['rows']} rows in its tables, "
                text += f"{found['done']} of them done, {found['report']:.0f} s from the last job "
                text += "to the end (tables and figures):\n\n"
                wrong |= found["code"] != 0 or found["done"] != options.jobs
            else:
                text += f"stopped after {found['reached']} jobs, as time was up:\n\n"
            long = [each for each in processes.values() if len(each) >= 20]
            names = ["the runner", *(f"worker {n}" for n in range(1, len(long)))][: len(long)]
            lines = [row(n, "job", s) for n, s in zip(names, long, strict=True)]
            write("jobs", text + HEAD + "".join(lines))
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return int(wrong)


if __name__ == "__main__":
    sys.exit(main())
