"""Execute one run, from its configuration to its folder.

`run`, `begin` and `resume` decide whether a folder's run starts, continues or is done already. All
three end in `_guarded`, which writes the final status whatever happens in `_execute`.
"""

from __future__ import annotations

import os
import shlex
import sys
import time
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from styleexp.encoders.options import judge_name
from styleexp.experiments import endings, live, progress
from styleexp.experiments.sweeps.claim import PATIENCE, busy
from styleexp.runs import identity, origins, reading, records
from styleexp.runs.jobs import Job
from styleexp.system import atomic, gpus, locks, process
from styleexp.system.errors import UserError
from styleexp.system.progress import announced, doing

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from styleexp.config.schema import Config
    from styleexp.experiments.metrics import Banks, Judge
    from styleexp.experiments.sweeps.pruning import Trial
    from styleexp.method.base import Method, Result, Scene, State, Step
    from styleexp.plugins.loggers import Loggers

    Measure = Callable[[Result], dict[str, float]]

SHOWN_METRICS = ("style_distance", "silhouette_iou", "flipped_faces")
"""Metrics printed at the end of a run."""
INTERRUPTED = 130
"""Exit code of a run that the user stopped, as of a program that Ctrl-C ends."""


# ------------------------------------------------------------------- whether and how a run starts


def run(
    config: Config,
    folder: Path,
    overrides: list[str],
    again: bool = True,
    command: list[str] | None = None,
    trial: Trial | None = None,
) -> int:
    """Stylise and write everything into ``folder``; return the exit code. ``command`` is recorded;
    by default it is ``styleexp`` with the overrides. A ``trial`` ends early where it is hopeless.

    Without ``again``, as in a sweep, a finished run isn't repeated, and a different run in the
    folder is an error instead of being replaced, unless it failed, or differs only in the code of
    its plugins.
    """
    with _alone(folder):
        if not again:
            job = Job(folder.name, tuple(overrides), folder, identity.job_key(config))
            found = reading.of_job(job)
            if found.status in ("done", "pruned"):
                print(f"already {found.status}: {folder}")
                return 0
            if found.status == "other" and found.last_status != "failed":
                edited = identity.edited_since(config, overrides, reading.read(folder).record)
                if not edited:
                    raise UserError(
                        f"'{folder}' doesn't belong to this job: {found.reason}; choose another "
                        "folder with hydra.sweep.dir=FOLDER, or remove it."
                    )
                told = " and ".join(edited)
                print(f"note: the run in '{folder}' was of other code of {told}: running it again")
        return begin(config, folder, overrides, command, trial)


def begin(
    config: Config,
    folder: Path,
    overrides: list[str],
    command: list[str] | None = None,
    trial: Trial | None = None,
) -> int:
    """Stylise into a folder whose lock is held; return the exit code.

    If the folder holds the same run, unfinished, it is resumed. So a job that a cluster requeues
    continues.
    """
    record = records.describe(config, overrides, command or ["styleexp", *overrides])
    record |= origins.noted(config, (config.encoder.name, _judge_name(config)))
    run_folder = records.RunFolder(folder)
    unfinished = run_folder.unfinished(record)
    if unfinished is None and reading.read(folder).last_status in ("running", "interrupted"):
        print(
            f"note: replacing the unfinished run in '{folder}', which had other settings, files or "
            "another version"
        )
    resumed = unfinished is not None
    return _guarded(config, run_folder, unfinished or record, resumed, trial)


def resume(folder: Path) -> int:
    """Resume an interrupted run from its checkpoint; return the exit code."""
    found = reading.recorded(folder, "resume")
    record = found.record
    config = origins.restored(record, folder, "resume", print)
    if found.status == "done" and not config.keep_checkpoint:
        raise UserError(
            f"the run in '{folder}' is done and kept no checkpoint (keep_checkpoint=false): to "
            f"repeat it, start it anew: {found.command}"
        )
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


# ---------------------------------------------------------------------------------- how a run ends


def _guarded(
    config: Config,
    folder: records.RunFolder,
    record: dict[str, Any],
    resumed: bool,
    trial: Trial | None = None,
) -> int:
    """Execute the run, and write its final status in any case; return the exit code."""
    if resumed:
        record, apart = records.resumed(record, config)
        if apart:
            told = ", ".join(map(str, apart))
            print(f"note: the run was started with {told}: results may differ")
    atomic.sweep(folder.path)
    # Replace a finished run only once the new one can start: a typo must not cost a result.
    replaces = not resumed and reading.read(folder.path).last_status == "done"
    look = live.Live(folder, config.report)
    try:
        if not replaces:
            folder.begin(None if resumed else record)
        with announced():
            return _execute(config, folder, record, resumed, look, trial)
    except BrokenPipeError:  # as with `styleexp ... | head`; not the folder's fault
        folder.write_status("interrupted", reason="the output pipe was closed")
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        raise endings.failed_writing(folder, error) from error
    except KeyboardInterrupt:
        if folder.begun:
            folder.write_status("interrupted", reason="stopped by the user")
            with suppress(OSError):
                print(f"\nstopped; rerun with: {_resuming(folder)}", file=sys.stderr)
        raise
    except Exception as error:
        if not endings.is_out_of_memory(error):
            endings.fail(folder, str(error))
            raise
        message = endings.out_of_memory(config, error)
        endings.fail(folder, message)
        raise UserError(message) from error
    finally:
        look.end()


def _resuming(folder: records.RunFolder) -> str:
    """The command that continues the run."""
    return shlex.join(["styleexp", f"resume={folder.path.absolute()}"])


# ----------------------------------------------------------------------------------------- the run


def _execute(
    config: Config,
    folder: records.RunFolder,
    record: dict[str, Any],
    resumed: bool,
    look: live.Live,
    trial: Trial | None,
) -> int:
    """Prepare, optimise, write and measure; return the exit code."""
    from styleexp.config import build
    from styleexp.plugins.loggers import Loggers

    started = time.perf_counter()
    _check(config)
    method, scene = build.prepare(config)
    if not folder.begun:
        folder.begin(record)
    doing("")
    look.prepared(scene.subject)
    for note in (*scene.subject.notes, *scene.notes):
        print(f"note: {note}")
    assets = _unchanged_assets(config, record)
    state = method.start(scene)
    if resumed and state is not None:
        _restore(folder, state, config.optim.steps)
    record |= _determined(scene, config, assets)
    folder.write_json("run.json", record)

    measure = _measuring(config)
    step = state.step if state else 0
    with Loggers(config, folder.path, record, step) as loggers:
        if state is not None:
            code = _optimise(
                method, scene, state, config, folder, loggers, look, trial, measure, started
            )
            if code is not None:
                return code
        result = method.finish(scene, state)
        look.result(result)
        step = state.step if state else 0
        written, measured = _write_results(result, config, folder, measure)
        seconds = time.perf_counter() - started
        if config.report:  # last, because it shows the other files
            from styleexp.experiments.reports import page

            doing("writing the run's page")
            look.replaced()
            written.insert(0, page.write_ended(folder.path, result, seconds))
        loggers.finish(result, folder.path, measured, step)
        folder.check()
        folder.write_status("done", step=step, seconds=round(seconds, 1))
        if not config.keep_checkpoint:  # not before the status: until then they are needed
            folder.forget()
    print(f"done in {seconds:.0f} s")
    progress.print_paths(written)
    return 0


def _check(config: Config) -> None:
    """Set up the process, and raise `UserError` now for what would fail only after the run."""
    from styleexp import plugins
    from styleexp.config.checks import check
    from styleexp.inputs import assets

    check(config)
    process.prepare(config.threads, config.optim.seed)
    if config.preview.name == "pyrender":
        from styleexp.runs.previews import check_available

        check_available(config.preview.platform)
    for name in config.logger:
        plugins.usable("logger", name)
    judge = _judge_name(config)
    if judge in assets.names("weights"):
        assets.find(judge, "weights")


def _unchanged_assets(config: Config, record: dict[str, Any]) -> dict[str, Any]:
    """The record's assets, which still are what the files hold. Raises `UserError` otherwise."""
    now = origins.describe(config)
    before: dict[str, Any] = record.get("assets") or now
    for kind, asset in now.items():
        if before.get(kind, asset).get("sha256") != asset["sha256"]:
            raise UserError(
                f"the {kind} '{asset['path']}' was changed while it was being read: start the "
                "run again."
            )
    return before


def _restore(folder: records.RunFolder, state: State, total: int) -> None:
    """Load the latest checkpoint into ``state``, and drop the lines of later steps."""
    if note := folder.load_checkpoint(state):
        print(f"note: {note}")
    print(f"resuming at step {state.step} of {total}")
    if lost := folder.begin_metrics(state.step):
        print(f"note: metrics.jsonl is damaged: {lost} lines are lost.")


def _determined(scene: Scene, config: Config, assets: dict[str, Any]) -> dict[str, Any]:
    """What the run itself determines, for its record."""
    import torch

    from styleexp.method.scene import PaperScene

    subject = scene.subject
    found = {
        "device": str(subject.surface.vertices.device),
        "threads": torch.get_num_threads(),
        "chosen": {"sigma": subject.sigma, "bound": subject.bound, "relief": subject.relief},
        "assets": assets,
        "notes": [*subject.notes, *scene.notes],
        "judge": _judge_name(config),
    }
    if gpu := process.gpu(subject.surface.vertices.device):
        found["gpu"] = gpu
    if gpus.VISIBLE in os.environ:
        found["visible_gpus"] = os.environ[gpus.VISIBLE]
    if isinstance(scene, PaperScene):
        found["encoder_precision"] = scene.encoder.precision
    return found


# ------------------------------------------------------------------------------------ optimisation


def _optimise(
    method: Method[Any],
    scene: Scene,
    state: State,
    config: Config,
    folder: records.RunFolder,
    loggers: Loggers,
    look: live.Live,
    trial: Trial | None,
    measure: Measure,
    started: float,
) -> int | None:
    """Run the remaining steps; return the exit code if they end early: stopped by the user, or a
    hopeless trial."""
    optim = config.optim
    blank = 0
    with endings.interruptible() as interrupted:
        steps = _explained(method.optimise(scene, state), folder)
        for step in progress.shown(steps, state.step, optim.steps):
            folder.append_metrics(step)
            loggers.step(step)
            look.step(step, optim.steps, lambda: method.finish(scene, state))
            blank += getattr(step, "blank_views", 0)
            # Before this step's checkpoint: a trial that goes on from it has been judged.
            if trial and trial.due(state.step, optim.steps):
                doing("measuring the trial")
                result = method.finish(scene, state)
                reason = trial.verdict(state.step, measure(result))
                doing("")
                if reason is not None:
                    look.result(result)
                    seconds = round(time.perf_counter() - started, 1)
                    folder.write_status("pruned", step=state.step, reason=reason, seconds=seconds)
                    folder.save_checkpoint(state)
                    loggers.ended = "interrupted"
                    print(f"pruned: {reason}")
                    return 0
            if state.step % optim.checkpoint_every == 0 or interrupted:
                folder.save_checkpoint(state)
            if interrupted and state.step < optim.steps:
                folder.write_status("interrupted", step=state.step)
                loggers.ended = "interrupted"
                print(f"\nstopped at step {state.step}; continue with: {_resuming(folder)}")
                return INTERRUPTED
    if folder.checkpoint_step() != state.step:
        folder.save_checkpoint(state)
    if blank:
        what = "were skipped" if scene.skips_blank_views else "counted as background"
        print(
            f"note: {blank} views did not show the mesh and {what} (blank_views in metrics.jsonl)"
        )
    return None


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


# ------------------------------------------------------------------------------------------ result


def _write_results(
    result: Result, config: Config, folder: records.RunFolder, measure: Measure
) -> tuple[list[Path], dict[str, float]]:
    """Write, draw and measure the result; return the files to name to the user, and the metrics."""
    from styleexp import plugins
    from styleexp.experiments.ratings import verdict
    from styleexp.runs import exports, previews

    meshes = exports.write(result, config, folder.path)
    doing("drawing the preview and the turntable")
    size, frames = config.preview.resolution, config.preview.turntable_frames
    folder.write("preview.png", lambda path: previews.write_preview(result, size, path))
    folder.write("turntable.gif", lambda path: previews.write_turntable(result, frames, size, path))
    names = ["preview.png", "turntable.gif", *meshes]
    if result.directions is not None:
        folder.write("direction.png", lambda path: previews.write_directions(result, size, path))
        names.insert(2, "direction.png")
    written = [folder.path / name for name in names]
    doing("measuring the result")
    measured = measure(result)
    doing("")
    folder.write_json("metrics.json", measured)
    shown = [name for name in SHOWN_METRICS if name in measured]
    print("  ".join(f"{name} {measured[name]:.3g}" for name in shown))
    if (told := verdict(measured)) is not None:
        print(told)
    if config.preview.name == "pyrender":
        renderer = plugins.build("renderer", config.renderer)
        written += previews.write_check(result, renderer, config, folder.write)
    return written, measured


def _measuring(config: Config) -> Measure:
    """A function that measures a result against its own source, whose faces a baseline may have
    subdivided. What it measures of the style serves the run's next result, too."""
    loaded: list[Judge | None] = []
    banks: Banks = {}

    def measure(result: Result) -> dict[str, float]:
        from styleexp.experiments import metrics

        device = result.subject.surface.vertices.device
        if not loaded:
            name, windows = _judge_name(config), config.metrics.windows
            loaded.append(metrics.load_judge(name, windows, device))
        source, style = result.subject.source, result.subject.style
        vertices, faces = result.vertices, source.faces
        return metrics.measure(
            config, source, style, vertices, faces, loaded[0], banks, subject=result.subject
        )

    return measure


def _judge_name(config: Config) -> str | None:
    """The encoder that measures the result; None if it isn't measured with one."""
    return judge_name(config.metrics.judge, config.encoder.name)
