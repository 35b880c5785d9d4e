"""One run, from its configuration to its folder."""

from __future__ import annotations

import os
import signal
import sys
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from styleexp import records
from styleexp.errors import UserError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from styleexp.config import Config
    from styleexp.scene import Scene
    from styleexp.stylize import State, Step


def run(config: Config, folder: Path, overrides: list[str]) -> int:
    """Stylise and write everything into ``folder``; returns the exit code."""
    record = records.describe(config, overrides, ["styleexp", *overrides])
    return _guarded(config, records.RunFolder(folder), record, resumed=False)


def resume(folder: Path) -> int:
    """Go on with an interrupted run from its checkpoint."""
    from omegaconf import OmegaConf

    from styleexp import compose

    record = records.read_record(folder)
    compose.register()
    config = compose.typed(OmegaConf.create(record["config"]))
    return _guarded(config, records.RunFolder(folder), record, resumed=True)


def _guarded(
    config: Config, folder: records.RunFolder, record: dict[str, Any], resumed: bool
) -> int:
    """Run, and leave a status whatever happens."""
    try:
        folder.write_status("running")
        if not resumed:
            folder.write_json("run.json", record)
        return _run(config, folder, record, resumed)
    except BrokenPipeError:  # as with `styleexp ... | head`: the folder is not at fault
        folder.write_status("interrupted", reason="the output was closed by its reader")
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        _fail(folder, str(error))
        raise UserError(
            f"writing to '{folder.path}' failed ({error.strerror or error}): free some space or "
            "choose another folder with hydra.run.dir=FOLDER."
        ) from error
    except KeyboardInterrupt:
        folder.write_status("interrupted", reason="stopped by the user")
        raise
    except Exception as error:
        _fail(folder, str(error))
        raise


def _fail(folder: records.RunFolder, reason: str) -> None:
    try:
        folder.write_status("failed", reason=reason)
    except OSError:
        print(f"styleexp: the failure could not be recorded in {folder.path}.", file=sys.stderr)


def _run(config: Config, folder: records.RunFolder, record: dict[str, Any], resumed: bool) -> int:
    import torch

    from styleexp import sources
    from styleexp.config import check
    from styleexp.scene import prepare
    from styleexp.stylize import optimise, start

    if config.threads:
        torch.set_num_threads(config.threads)
    started = time.perf_counter()
    check(config)
    if config.preview.name == "pyrender":
        from styleexp.previews import check_available

        check_available(config.preview.platform)
    scene = prepare(config)
    for note in scene.notes:
        print(f"note: {note}")
    state = start(scene)
    if resumed:
        told = folder.load_checkpoint(state)
        if told:
            print(f"note: {told}")
        print(f"resuming at step {state.step} of {config.optim.steps}")
        folder.truncate_metrics(state.step)
    record |= {
        "device": str(scene.surface.vertices.device),
        "encoder_precision": scene.loss.encoder.precision,
        "threads": torch.get_num_threads(),
        "chosen": {"sigma": scene.sigma, "bound": scene.bound, "relief": scene.relief},
        "assets": sources.describe(config),
        "notes": list(scene.notes),
    }
    folder.write_json("run.json", record)

    with _interruptible() as interrupted:
        for step in _progress(optimise(scene, state), state, config.optim.steps):
            folder.append_metrics(step)
            if state.step % config.optim.checkpoint_every == 0 or interrupted:
                folder.save_checkpoint(state)
            if interrupted and state.step < config.optim.steps:
                folder.write_status("interrupted", step=state.step)
                print(f"\nstopped at step {state.step}; go on with: styleexp resume={folder.path}")
                return 130

    folder.save_checkpoint(state)
    written = _write_results(scene, state, folder, started)
    seconds = time.perf_counter() - started
    folder.write_status("done", step=state.step, seconds=round(seconds, 1))
    print(f"done in {seconds:.0f} s")
    _print_paths(written)
    return 0


def _write_results(
    scene: Scene, state: State, folder: records.RunFolder, started: float
) -> list[Path]:
    from styleexp import previews
    from styleexp.stylize import finish

    result = finish(scene, state)
    for name in ("result.ply", "result.obj", "result.glb"):
        result.save(folder.path / name)
    folder.write("preview.png", lambda path: previews.write_preview(result, path))
    folder.write("turntable.gif", lambda path: previews.write_turntable(result, path))
    names = ("preview.png", "turntable.gif", "result.glb", "result.ply", "result.obj")
    written = [folder.path / name for name in names]
    if scene.config.preview.name == "pyrender":
        written += previews.write_check(result, folder.write)
    if scene.config.report:  # last, as it shows what the others are about
        from styleexp.reports import page

        written.insert(0, page.write_ended(folder.path, result, time.perf_counter() - started))
    return written


@contextmanager
def _interruptible() -> Iterator[list[int]]:
    """A list that a first Ctrl-C (or SIGTERM) fills; a second one stops at once."""
    caught: list[int] = []

    def note(number: int, frame: Any) -> None:
        if caught:
            raise KeyboardInterrupt
        caught.append(number)

    before = {s: signal.signal(s, note) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield caught
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _progress(steps: Iterator[Step], state: State, total: int) -> Iterator[Step]:
    """Show each step: a bar on a terminal, a plain line now and then elsewhere."""
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
