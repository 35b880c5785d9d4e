"""Execute one run, from its configuration to its folder."""

from __future__ import annotations

import os
import re
import shlex
import signal
import sys
import time
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from styleexp.experiments.sweeps.claim import PATIENCE, busy
from styleexp.experiments.sweeps.jobs import Job
from styleexp.runs import identity, origins, reading, records
from styleexp.system import atomic, locks, process
from styleexp.system.errors import UserError
from styleexp.system.progress import announced, doing

if TYPE_CHECKING:
    from collections.abc import Iterator

    from styleexp.config.schema import Config
    from styleexp.method.base import Method, Result, Scene, State, Step
    from styleexp.plugins.loggers import Loggers


SHOWN_METRICS = ("style_distance", "silhouette_iou", "flipped_faces", "spike")
"""Metrics printed at the end of a run."""


def run(config: Config, folder: Path, overrides: list[str], again: bool = True) -> int:
    """Stylise and write everything into ``folder``; return the exit code.

    Without ``again``, as in a sweep, a finished run isn't repeated, and a different run in the
    folder is an error instead of being replaced, unless it failed.
    """
    with _alone(folder):
        if not again:
            job = Job(folder.name, tuple(overrides), folder, identity.job_key(config))
            found = reading.of_job(job)
            if found["status"] == "done":
                print(f"already done: {folder}")
                return 0
            if found["status"] == "other" and reading.status(folder) != "failed":
                raise UserError(
                    f"'{folder}' doesn't belong to this job: {found['reason']}; choose another "
                    "folder with hydra.sweep.dir=FOLDER, or remove it."
                )
        return begin(config, folder, overrides)


def begin(config: Config, folder: Path, overrides: list[str]) -> int:
    """Stylise into a folder whose lock is held; return the exit code.

    If the folder holds the same run, unfinished, it is resumed. So a job that a cluster requeues
    continues.
    """
    record = records.describe(config, overrides, ["styleexp", *overrides]) | origins.noted(config)
    run_folder = records.RunFolder(folder)
    unfinished = run_folder.unfinished(record)
    if unfinished is None and reading.status(folder) in ("running", "interrupted"):
        print(
            f"note: replacing the unfinished run in '{folder}', which had other settings, files or "
            "another version"
        )
    return _guarded(config, run_folder, unfinished or record, resumed=unfinished is not None)


def resume(folder: Path) -> int:
    """Resume an interrupted run from its checkpoint."""
    record = records.read_record(folder)
    config = origins.restored(record, folder, "resume", print)
    if changed := records.changed_versions(record):
        print(f"note: the run was started with {changed}: results may differ slightly")
    with _alone(folder):
        return _guarded(config, records.RunFolder(folder), record, resumed=True)


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Hold the folder's lock, so that two processes don't mix their files."""
    try:
        with locks.hold(folder, PATIENCE):
            yield
    except locks.Busy:
        raise UserError(busy(folder)) from None


def _guarded(
    config: Config, folder: records.RunFolder, record: dict[str, Any], resumed: bool
) -> int:
    """Run, and write a final status in any case."""
    atomic.sweep(folder.path)
    # Replace a finished run only once the new one can start: a typo must not cost a result.
    replaced = not resumed and reading.status(folder.path) == "done"
    try:
        if not replaced:
            folder.begin(None if resumed else record)
        with announced():
            return _run(config, folder, record, resumed)
    except BrokenPipeError:  # as with `styleexp ... | head`; not the folder's fault
        folder.write_status("interrupted", reason="the output pipe was closed")
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        if not folder.path.is_dir():
            raise UserError(
                f"the run's folder '{folder.path}' was removed during the run: start the run again."
            ) from error
        if isinstance(error, FileNotFoundError) and _within(error.filename, folder.path):
            told = (
                f"files of the run's folder '{folder.path}' were removed during the run: start the "
                "run again."
            )
            folder.forget()
            _fail(folder, told)
            raise UserError(told) from error
        _fail(folder, str(error))
        raise UserError(
            f"writing to '{folder.path}' failed ({error.strerror or error}): free some space or "
            "choose another folder with hydra.run.dir=FOLDER."
        ) from error
    except KeyboardInterrupt:
        if folder.begun:
            folder.write_status("interrupted", reason="stopped by the user")
            again = shlex.join(["styleexp", f"resume={folder.path.absolute()}"])
            with suppress(OSError):
                print(f"\nstopped; rerun with: {again}", file=sys.stderr)
        raise
    except Exception as error:
        if not _out_of_memory(error):
            _fail(folder, str(error))
            raise
        asked = re.search(r"allocate (\d+) bytes", str(error))
        more = f" (failed to allocate {int(asked[1]) / 1e6:.0f} MB)" if asked else ""
        views = "fewer or smaller views (views.count, views.resolution), "
        told = (
            f"there is not enough memory for this run{more}: use "
            f"{'' if config.baseline else views}a mesh with fewer faces, or fewer runs at once."
        )
        _fail(folder, told)
        raise UserError(told) from error


def _within(name: object, folder: Path) -> bool:
    if not isinstance(name, str | Path):
        return False
    return Path(os.path.abspath(name)).is_relative_to(os.path.abspath(folder))


def _out_of_memory(error: BaseException) -> bool:
    """Whether Python, torch's CPU allocator or CUDA ran out of memory."""
    import torch

    kinds = (MemoryError, torch.OutOfMemoryError)
    return isinstance(error, kinds) or "can't allocate memory" in str(error)


def _fail(folder: records.RunFolder, reason: str) -> None:
    with suppress(OSError):  # report the error even if it can't be recorded
        if folder.begun:
            folder.write_status("failed", reason=reason)


def _run(config: Config, folder: records.RunFolder, record: dict[str, Any], resumed: bool) -> int:
    import torch

    from styleexp import plugins
    from styleexp.config import build
    from styleexp.config.checks import check
    from styleexp.experiments import metrics
    from styleexp.inputs import assets
    from styleexp.method.scene import PaperScene
    from styleexp.plugins.loggers import Loggers

    started = time.perf_counter()
    check(config)
    process.prepare(config.threads, config.optim.seed)
    if config.preview.name == "pyrender":
        from styleexp.runs.previews import check_available

        check_available(config.preview.platform)
    for name in config.logger:
        plugins.usable("logger", name)  # if unusable, fail before the run
    judge = metrics.judge_name(config.metrics.judge, config.encoder.name)
    if judge in assets.names("weights"):
        assets.find(judge, "weights")  # if unavailable, fail before the run, not after
    method, scene = build.prepare(config)
    subject = scene.subject
    notes = (*subject.notes, *scene.notes)
    if not folder.begun:
        folder.begin(record)
    doing("")
    for note in notes:
        print(f"note: {note}")
    read = origins.describe(config)
    for kind, before in (record.get("assets") or {}).items():
        if before["sha256"] != read[kind]["sha256"]:
            raise UserError(
                f"the {kind} '{read[kind]['path']}' was changed while it was being read: start the "
                "run again."
            )
    state = method.start(scene)
    if resumed and state is not None:
        told = folder.load_checkpoint(state)
        if told:
            print(f"note: {told}")
        print(f"resuming at step {state.step} of {config.optim.steps}")
        lost = folder.begin_metrics(state.step)
        if lost:
            print(f"note: metrics.jsonl is damaged: {lost} lines are lost.")
    record |= {
        "device": str(subject.surface.vertices.device),
        "threads": torch.get_num_threads(),
        "chosen": {"sigma": subject.sigma, "bound": subject.bound, "relief": subject.relief},
        "assets": record.get("assets") or read,
        "notes": list(notes),
        "judge": judge,
    }
    if isinstance(scene, PaperScene):
        record["encoder_precision"] = scene.encoder.precision
    folder.write_json("run.json", record)

    with Loggers(config, folder.path, record, state.step if state else 0) as loggers:
        if state is not None and not _optimise(method, scene, state, config, folder, loggers):
            return 130
        result = method.finish(scene, state)
        step = state.step if state else 0
        written, measured = _write_results(result, config, folder)
        seconds = time.perf_counter() - started
        if config.report:  # last, because it shows the other files
            from styleexp.experiments.reports import page

            doing("writing the run's page")
            written.insert(0, page.write_ended(folder.path, result, seconds))
        loggers.finish(result, folder.path, measured, step)
        folder.check()
        folder.write_status("done", step=step, seconds=round(seconds, 1))
    print(f"done in {seconds:.0f} s")
    _print_paths(written)
    return 0


def _optimise(
    method: Method[Any],
    scene: Scene,
    state: State,
    config: Config,
    folder: records.RunFolder,
    loggers: Loggers,
) -> bool:
    """Run the remaining steps; return False if the user stopped them."""
    optim = config.optim
    blank = 0
    with _interruptible() as interrupted:
        steps = _explained(method.optimise(scene, state), folder)
        for step in _progress(steps, state, optim.steps):
            folder.append_metrics(step)
            loggers.step(step)
            blank += getattr(step, "blank_views", 0)
            if state.step % optim.checkpoint_every == 0 or interrupted:
                folder.save_checkpoint(state)
            if interrupted and state.step < optim.steps:
                folder.write_status("interrupted", step=state.step)
                loggers.ended = "interrupted"
                again = shlex.join(["styleexp", f"resume={folder.path.absolute()}"])
                print(f"\nstopped at step {state.step}; continue with: {again}")
                return False
    if folder.checkpoint_step() != state.step:
        folder.save_checkpoint(state)
    if blank:
        what = "were skipped" if config.loss.masked else "counted as background"
        print(
            f"note: {blank} views did not show the mesh and {what} (blank_views in metrics.jsonl)"
        )
    return True


def _explained(steps: Iterator[Step], folder: records.RunFolder) -> Iterator[Step]:
    """Yield the steps; if they diverge, name the last good checkpoint in the error."""
    from styleexp.method.base import Diverged

    try:
        yield from steps
    except Diverged as error:
        good = folder.checkpoint_step()
        kept = "There is no checkpoint yet."
        if good is not None:
            kept = f"The last good checkpoint is from step {good}: {folder.checkpoint}."
        raise UserError(f"{error} {kept}") from None


def _write_results(
    result: Result, config: Config, folder: records.RunFolder
) -> tuple[list[Path], dict[str, float]]:
    from styleexp import plugins
    from styleexp.runs import previews

    for name in ("result.ply", "result.obj", "result.glb"):
        doing(f"writing {name}")
        result.save(folder.path / name)
    doing("drawing the preview and the turntable")
    shown = config.preview
    folder.write("preview.png", lambda path: previews.write_preview(result, shown.resolution, path))
    folder.write(
        "turntable.gif",
        lambda path: previews.write_turntable(
            result, shown.turntable_frames, shown.resolution, path
        ),
    )
    names = ("preview.png", "turntable.gif", "result.glb", "result.ply", "result.obj")
    written = [folder.path / name for name in names]
    doing("measuring the result")
    found = _measure(result, config)
    doing("")
    folder.write_json("metrics.json", found)
    print("  ".join(f"{name} {found[name]:.3g}" for name in SHOWN_METRICS if name in found))
    if config.preview.name == "pyrender":
        written += previews.write_check(
            result, plugins.build("renderer", config.renderer), config, folder.write
        )
    return written, found


def _measure(result: Result, config: Config) -> dict[str, float]:
    """Measure against the result's own source, whose faces a baseline may have subdivided."""
    from styleexp.experiments import metrics

    name = metrics.judge_name(config.metrics.judge, config.encoder.name)
    judge = metrics.load_judge(name, config.metrics.windows)
    source, style = result.subject.source, result.subject.style
    return metrics.measure(config, source, style, result.vertices, source.faces, judge)


@contextmanager
def _interruptible() -> Iterator[list[int]]:
    """Yield a list that the first Ctrl-C (or SIGTERM, or a closed terminal) appends to; a second
    one stops at once."""
    caught: list[int] = []

    def note(number: int, frame: Any) -> None:
        if caught:
            raise KeyboardInterrupt
        caught.append(number)

    signals = [signal.SIGINT, signal.SIGTERM]
    # Windows has no SIGHUP, and nohup ignores it.
    hangup = getattr(signal, "SIGHUP", None)
    if hangup is not None and signal.getsignal(hangup) is not signal.SIG_IGN:
        signals.append(hangup)
    before = {s: signal.signal(s, note) for s in signals}
    try:
        yield caught
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _progress(steps: Iterator[Step], state: State, total: int) -> Iterator[Step]:
    """Show progress: a bar on a terminal, else an occasional line."""
    from rich.console import Console

    if not Console().is_terminal:
        begun, first = time.perf_counter(), state.step
        every = max(1, total // 10)
        for step in steps:
            if step.step == 1 or step.step % every == 0 or step.step == total:
                rate = (step.step - first) / (time.perf_counter() - begun)
                print(
                    f"step {step.step}/{total}  loss {step.loss:.4g}  {rate:.2f} steps/s  "
                    f"{(total - step.step) / rate:.0f} s left",
                    flush=True,
                )
            yield step
        return

    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("stylising"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("loss {task.fields[loss]:.4g}  {task.fields[rate]:.2f} steps/s"),
        TimeRemainingColumn(),
    )
    with Progress(*columns) as bar:
        task = bar.add_task("", total=total, completed=state.step, loss=float("nan"), rate=0.0)
        for step in steps:
            bar.update(task, completed=step.step, loss=step.loss, rate=1 / step.seconds)
            yield step


def _print_paths(paths: list[Path]) -> None:
    from rich.console import Console
    from rich.text import Text

    console = Console(soft_wrap=True)
    for path in paths:
        absolute = path.resolve()
        console.print(Text("  ").append(str(path), style=f"link {absolute.as_uri()}"))
