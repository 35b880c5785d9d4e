"""What a run shows on the terminal while it optimises and when it has ended."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from styleexp.method.base import Step

LINES = 10
"""Number of lines printed during a run whose output is not a terminal."""


def shown(steps: Iterable[Step], done: int, total: int) -> Iterator[Step]:
    """Yield the steps and show each: in a bar on a terminal, else in an occasional line.

    ``done`` is the number of steps before the first one here, ``total`` that of the whole run.
    """
    from rich.console import Console

    show = _in_a_bar if Console().is_terminal else _in_lines
    return show(steps, done, total)


def print_paths(paths: Iterable[Path]) -> None:
    """Print one file per line, as a link where the terminal has links."""
    from rich.console import Console
    from rich.text import Text

    class Plain(Console):
        """rich would send all later output nowhere, without a word if it is in a thread."""

        def on_broken_pipe(self) -> None:
            raise

    console = Plain(soft_wrap=True)
    for path in paths:
        absolute = path.resolve()
        console.print(Text("  ").append(str(path), style=f"link {absolute.as_uri()}"))


def _in_lines(steps: Iterable[Step], done: int, total: int) -> Iterator[Step]:
    begun = time.perf_counter()
    every = max(1, total // LINES)
    for step in steps:
        if step.step == 1 or step.step % every == 0 or step.step == total:
            rate = (step.step - done) / (time.perf_counter() - begun)
            print(
                f"step {step.step}/{total}  loss {step.loss:.4g}  {rate:.2f} steps/s  "
                f"{(total - step.step) / rate:.0f} s left",
                flush=True,
            )
        yield step


def _in_a_bar(steps: Iterable[Step], done: int, total: int) -> Iterator[Step]:
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
        task = bar.add_task("", total=total, completed=done, loss=float("nan"), rate=0.0)
        for step in steps:
            bar.update(task, completed=step.step, loss=step.loss, rate=1 / max(step.seconds, 1e-9))
            yield step
