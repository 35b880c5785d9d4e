"""End of a sweep: table, figure and exit code."""

from __future__ import annotations

import csv
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from hydra.experimental.callback import Callback

from styleexp.experiments.sweeps import claim
from styleexp.experiments.sweeps.settings import readable, varying
from styleexp.runs import reading
from styleexp.runs.jobs import Job, planned
from styleexp.runs.records import RunFolder
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from omegaconf import DictConfig

T = TypeVar("T")
begun: Path | None = None
"""The folder of the sweep that this process started, if any."""


class OnSweep(Callback):
    """Hydra callback: record the jobs at the start of a sweep, report at its end."""

    def on_run_start(self, config: DictConfig, **rest: Any) -> None:
        """Claim the run's folder before Hydra writes into it."""
        _claimed(claim.run, config)

    def on_multirun_start(self, config: DictConfig, **rest: Any) -> None:
        """Claim the sweep's folder and record its jobs, if known in advance."""
        global begun
        begun = _claimed(claim.sweep, config)

    def on_multirun_end(self, config: DictConfig, **rest: Any) -> None:
        """Write and print the results."""
        finish(Path(config.hydra.sweep.dir))


def _claimed(claim_: Callable[[DictConfig], T], config: DictConfig) -> T | None:
    """Call ``claim_`` and exit on a user error, because Hydra swallows all exceptions of callbacks
    except `SystemExit`. Hydra itself reports a folder that can't be created."""
    try:
        return claim_(config)
    except UserError as error:
        print(f"styleexp: {error}", file=sys.stderr)
        sys.exit(2)
    except OSError:
        return None


def exit_code(folder: Path) -> int:
    """0 if every job of the sweep is done, or pruned by its search, else 2; based on the jobs' own
    status."""
    states = {reading.of_job(job).status for job in planned(folder)}
    return 0 if states and states <= {"done", "pruned"} else 2


def finish(folder: Path, name: str | None = None) -> None:
    """Write table and figure of Hydra's sweep in ``folder`` and, unless its runs have no pages, its
    page."""
    from styleexp.experiments.reports import sweep_page

    jobs = planned(folder)
    report(jobs, folder, name or str(folder))
    if any(reading.of_job(job).config.get("report") for job in jobs):
        _print(str(sweep_page.write(folder, run_pages=False)))


def report(jobs: Sequence[Job], folder: Path, title: str) -> None:
    """Write ``table.csv`` and ``figure.png`` into ``folder`` and print the table.

    The figure is redrawn only if the table has changed.
    """
    from styleexp.experiments.sweeps.figure import MOST, write_figure

    rows = table(jobs)
    before = _content(folder / "table.csv")
    write_table(rows, folder)
    if before != _content(folder / "table.csv") or not (folder / "figure.png").exists():
        write_figure(jobs, RunFolder(folder))
    show(rows, title)
    _print(f"{folder / 'figure.png'}, {folder / 'table.csv'}")
    if len(jobs) > MOST:
        _print(f"figure.png shows the first {MOST} of {len(jobs)} jobs; the table shows all.")


def _content(path: Path) -> bytes | None:
    return path.read_bytes() if path.exists() else None


def table(jobs: Sequence[Job]) -> list[dict[str, Any]]:
    """One row per job: ``job``, the overrides that distinguish it (keys prefixed with ``=``),
    ``status``, ``seconds``, ``loss``, every metric by its name, and ``reason``."""
    rows = []
    for job, overrides in zip(jobs, varying([job.overrides for job in jobs]), strict=True):
        run = reading.of_job(job)
        row: dict[str, Any] = {"job": job.name}
        row |= {f"={key}": value for key, value in overrides.items()}
        row |= {"status": run.status, "seconds": run.seconds, "loss": run.loss}
        row |= run.measured
        row["reason"] = run.remark
        rows.append(row)
    return rows


def write_table(rows: Sequence[dict[str, Any]], folder: Path) -> None:
    """Write ``table.csv``: one line per job, and a column for every key of any job."""
    keys = [*dict.fromkeys(key for row in rows for key in row if key != "reason"), "reason"]

    def write(path: Path) -> None:
        with open(path, "w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(key.lstrip("=") for key in keys)
            writer.writerows([row.get(key) for key in keys] for row in rows)

    RunFolder(folder).write("table.csv", write)


def show(rows: Sequence[dict[str, Any]], title: str) -> None:
    """Print the table to the terminal."""
    from rich.table import Table

    shown = Table(title=title)
    for column in ("job", "overrides", "status", "style distance", "loss", "time"):
        shown.add_column(column, overflow="fold")
    for row in rows:
        overrides = {key[1:]: value for key, value in row.items() if key.startswith("=")}
        status = str(row["status"])
        seconds = row["seconds"]
        shown.add_row(
            str(row["job"]),
            readable(overrides),
            status if status in ("done", "pruned") else f"[red]{status}[/red]",
            _number(row.get("style_distance")),
            _number(row["loss"]),
            f"{seconds:.0f} s" if isinstance(seconds, int | float) else "",
        )
    _print(shown)
    for row in rows:
        if row["reason"]:
            _print(f"{row['job']}: {row['status']}: {row['reason']}")
    if rows and not any("style_distance" in row for row in rows):
        _print("style distance: not measured (metrics.judge=none, or no finished run)")


def _number(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, int | float) else ""


def _print(what: Any) -> None:
    from rich.console import Console

    console = Console()
    if not console.is_terminal:
        console = Console(width=120)  # a log has no width; don't wrap column names
    console.print(what, soft_wrap=isinstance(what, str), markup=not isinstance(what, str))
