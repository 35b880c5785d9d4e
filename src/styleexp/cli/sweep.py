"""``styleexp-sweep``: run a plan of experiments, show its status, collect its results."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from styleexp.cli.ending import ends_well
from styleexp.system import gpus
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from styleexp.experiments.sweeps.plan import Plan, Planned


@ends_well
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0 if all jobs are done, else 2, also after a user error."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    gpus.remember()
    commands = {"status": _status, "cancel": _cancel, "collect": _collect}
    try:
        if given and given[0] in commands:
            parser = argparse.ArgumentParser(prog=f"styleexp-sweep {given[0]}")
            parser.add_argument("folder", type=Path)
            if given[0] == "status":
                parser.add_argument("--watch", type=float, nargs="?", const=10.0, metavar="SECONDS",
                                    help="repeat the summary until all jobs have ended; default: "
                                    "every 10 seconds")  # fmt: skip
            options = parser.parse_args(given[1:])
            if not options.folder.is_dir():
                raise UserError(f"there is no folder '{options.folder}'.")
            return commands[given[0]](options)
        return _run(_parser().parse_intermixed_args(given))
    except UserError as error:
        print(f"styleexp-sweep: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("stopped; repeat the command to continue.", file=sys.stderr)
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="styleexp-sweep",
        description="Run or continue a plan of experiments: finished jobs are skipped, killed "
        "jobs are resumed. Any number of runners may share a folder.",
        epilog="styleexp-sweep status FOLDER shows the jobs, with --watch again and again; "
        "styleexp-sweep cancel FOLDER stops them; styleexp-sweep collect FOLDER writes runs.csv "
        "and runs.parquet.",
    )
    parser.add_argument("plan", type=Path, metavar="PLAN", help="a plan file, see sweeps/")
    parser.add_argument(
        "overrides", nargs="*", metavar="KEY=VALUE", help="overrides for every job, "
        "e.g. profile=standard; those that begin with hydra. configure the launcher, "
        "e.g. hydra.launcher.partition=gpu",
    )  # fmt: skip
    parser.add_argument("--folder", type=Path, help="default: outputs/ and the plan's name")
    parser.add_argument("--launcher", metavar="NAME", help="basic, joblib, submitit_local, "
                        "submitit_slurm or ray; default: the plan's")  # fmt: skip
    parser.add_argument("--jobs", type=int, metavar="N", help="run N jobs in parallel")
    parser.add_argument("--per-task", type=int, default=1, metavar="N", help="run N jobs one after "
                        "the other in each of the launcher's processes, which start "
                        "once")  # fmt: skip
    parser.add_argument("--retry", action="store_true", help="run failed jobs again")
    parser.add_argument("--check", action="store_true", help="fetch what is missing and say "
                        "what can't be fetched, how the jobs would be started and what they cost; "
                        "run nothing")  # fmt: skip
    parser.add_argument("--no-check", action="store_true", help="start although something is "
                        "missing: the jobs that need it fail")  # fmt: skip
    parser.add_argument("--dry-run", action="store_true", help="print the commands, run nothing")
    return parser


def _run(options: argparse.Namespace) -> int:
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    from styleexp.config.explain import explain
    from styleexp.experiments.sweeps import launchers, manifest, plan, runner

    read = plan.read(options.plan)
    folder = options.folder or Path("outputs") / options.plan.stem
    home = manifest.home(folder)
    if home is not None and home.absolute() != Path.cwd():
        if not home.is_dir():
            raise UserError(
                f"the plan in '{folder}' was started in '{home}', which its relative paths refer "
                "to, but that folder is missing: restore it, or choose another --folder."
            )
        print(f"note: relative paths refer to '{home}', where this plan was started.", flush=True)
        options.plan, folder = options.plan.absolute(), folder.absolute()
        os.chdir(home)
    own = [each for each in options.overrides if each.lstrip("+~").startswith("hydra.")]
    launcher = launchers.overrides(options.launcher or read.launcher, options.jobs) + own
    chosen = [each for each in options.overrides if each not in own]
    try:
        with launchers.composed(folder, launcher) as (_, config):
            hydra = config.hydra
            launchers.check_per_task(hydra, options.per_task)
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(explain(error)) from error
    try:
        by_entry = plan.jobs(read, folder, chosen)
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(f"{options.plan}: {explain(error)}") from error
    jobs = list({job.name: job for listed in by_entry.values() for job in listed}.values())
    if options.dry_run:
        _show_commands(read, by_entry, _profile(read, chosen))
        return 0
    if options.check:
        return _check(read, by_entry, folder, _profile(read, chosen), hydra, options.per_task)
    if launchers.name_of(hydra) != "basic" and not options.no_check:
        launchers.check(hydra)
        _refuse_missing(jobs)
    tasks = -(-len(_unfinished(jobs)) // options.per_task)
    for told in launchers.notes(hydra, tasks, options.per_task):
        print(f"note: {told}", flush=True)
    try:
        manifest.write(folder, jobs)
        if options.retry:
            runner.retry(jobs)
        print(f"{len(jobs)} jobs, {folder}", flush=True)
        runner.run(jobs, folder, launcher, options.per_task)
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(explain(error)) from error
    except BrokenPipeError:
        raise
    except OSError as error:
        raise UserError(f"writing to '{folder}' failed: {error}.") from error
    return _report(read, by_entry, folder)


def _report(read: Plan, by_entry: dict[str, list[Planned]], folder: Path) -> int:
    """Write tables and figures of every experiment; return the exit code."""
    from styleexp.experiments.sweeps.report import report
    from styleexp.runs import reading

    for entry in read.experiments:
        assert entry.name is not None
        title = f"{entry.name} ({entry.figure})" if entry.figure else entry.name
        (folder / entry.name).mkdir(exist_ok=True)
        report(by_entry[entry.name], folder / entry.name, title)
    states = [reading.of_job(job).status for jobs in by_entry.values() for job in jobs]
    return 0 if set(states) == {"done"} else 2


def _profile(read: Plan, overrides: Sequence[str]) -> str:
    given = [o.removeprefix("profile=") for o in overrides if o.startswith("profile=")]
    return given[-1] if given else read.profile


def _unfinished(jobs: Iterable[Planned]) -> list[Planned]:
    from styleexp.runs import reading

    return [job for job in jobs if reading.of_job(job).status != "done"]


def _refuse_missing(jobs: Sequence[Planned]) -> None:
    """Raise `UserError` if something is missing that unfinished jobs need."""
    from styleexp.experiments.sweeps import preflight

    left = _unfinished(jobs)
    if problems := preflight.missing(left):
        print(*preflight.told(problems, left), sep="\n", file=sys.stderr)
        count = len({job.name for stopped in problems.values() for job in stopped})
        raise UserError(
            f"{count} of {len(left)} jobs can't run; nothing was started: see above, or start "
            "the others with --no-check."
        )


def _check(
    read: Plan,
    by_entry: dict[str, list[Planned]],
    folder: Path,
    profile: str,
    hydra: Any,
    per_task: int,
) -> int:
    """Print what is missing, how jobs are started and what they cost; return the exit code."""
    from styleexp.experiments.sweeps import costs, launchers, preflight

    jobs = list({job.name: job for listed in by_entry.values() for job in listed}.values())
    left = _unfinished(jobs)
    print(f"{len(jobs)} jobs, {len(jobs) - len(left)} done, in {folder} (profile={profile})")
    found = costs.of_plan(read, by_entry, profile)
    width = max(map(len, found))
    for name, cost in found.items():
        print(f"  {name:<{width}}  {cost.words()}")
    if left:
        print(f"left in all: {costs.total(found)}")
        name, at_once = launchers.name_of(hydra), launchers.at_once(hydra)
        tasks = -(-len(left) // per_task)
        of_each = f" of up to {per_task} jobs" if per_task > 1 else ""
        print(f"launcher {name}: {tasks} tasks{of_each}, {at_once or 'all'} at a time")
        for line in launchers.described(hydra, tasks):
            print(line)
        for told in launchers.notes(hydra, tasks, per_task):
            print(f"note: {told}")
    problems = preflight.missing(left)
    try:
        launchers.check(hydra)
    except UserError as error:
        problems = {str(error): left} | problems
    if not problems:
        print("nothing is missing.")
        return 0
    print("missing or wrong:")
    print(*preflight.told(problems, left), sep="\n")
    return 2


def _show_commands(read: Plan, by_entry: dict[str, list[Planned]], profile: str) -> None:
    """Print the commands, with each experiment's figure and cost, and mark finished jobs."""
    from styleexp.experiments.sweeps import costs
    from styleexp.runs import reading

    found, seen = costs.of_plan(read, by_entry, profile), set()
    for entry in read.experiments:
        assert entry.name is not None
        figure = f", {entry.figure}" if entry.figure else ""
        print(f"# {entry.name}{figure}: {found[entry.name].words()}")
        for job in by_entry[entry.name]:
            status = reading.of_job(job).status
            note = "" if status == "missing" else f"  # {status}"
            note = "  # the same job as above" if job.name in seen else note
            seen.add(job.name)
            print(job.command() + note)
    print(f"# {len(seen)} jobs, left: {costs.total(found)} (profile={profile})")


def _status(options: argparse.Namespace) -> int:
    from styleexp.experiments.sweeps import state

    while True:
        found = state.of_folder(options.folder)
        print(*(found.summary() if options.watch else found.lines()), sep="\n", flush=True)
        if not options.watch or not found.left:
            return 0
        time.sleep(options.watch)
        print()


def _cancel(options: argparse.Namespace) -> int:
    from styleexp.experiments.sweeps import state

    for line in state.cancel(options.folder):
        print(line)
    return 0


def _collect(options: argparse.Namespace) -> int:
    from styleexp.experiments.reports.collect import collect, write

    runs = collect(options.folder)
    for path in write(runs, options.folder):
        print(path)
    print(", ".join(f"{count} {status}" for status, count in runs["status"].value_counts().items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
