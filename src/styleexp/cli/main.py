"""``styleexp``: compose the configuration, run, and report errors in one sentence."""

from __future__ import annotations

import os
import sys
import traceback
import warnings
from typing import TYPE_CHECKING, Any, NoReturn

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from styleexp.system.errors import UserError

DEBUG = "debug=true"
USAGE = """\
usage: styleexp SOURCE STYLE [KEY=VALUE ...]

Put the local geometry of STYLE, a mesh or a picture, onto the mesh SOURCE. Both are files or names.

  styleexp critter bubble                 analytic shapes, always available
  styleexp my.obj her.ply                 files
  styleexp my.obj bark.jpg strength=0.5   a picture as style, at half the height
  styleexp my.obj her.ply method=robust   learned from renders, as in the paper: slower
  styleexp resume=FOLDER                  continue a stopped run
  styleexp reproduce FOLDER               make a finished run again, and compare
"""
MORE = """
styleexp --help names the keys used most.
"""
HELP = """
Keys used most:

  strength=0.5              height of the relief; negative values turn bumps into dents
  style.scale=2             size of the pattern
  style.rotation=30         in degrees
  style.direction=up        what the pattern's up follows: up, flow, x, y, z, attribute:NAME
  style.mask=not:slope:60   where: slope:, height:, near:, color:, texture:, attribute:
  style.invert=true         of a picture, dark is high
  source.refine=none        keep the source's faces; or their number, or auto
  simplify=50000            at most so many faces in the result
  formats=[stl,3mf]         further files
  optim.seed=1              another variation
  method=robust             how; also paper, vertex, displacement_map, ...
  profile=smoke             of learned methods: smoke, fast, standard, full
  hydra.run.dir=FOLDER      where the results go

  styleexp --help-all [KEY=VALUE ...]    all keys, with their values for these choices
  styleexp +experiment=layer_ablation -m    an experiment of the paper

Other commands, each with --help: styleexp-studio (a page to try things on),
styleexp-assets (names, downloads), styleexp-bake (maps), styleexp-report and
styleexp-metrics (of finished runs), styleexp-sweep (many runs), styleexp-plugins,
styleexp-bench. Tracebacks: debug=true.
"""


def main() -> None:
    """Entry point of the ``styleexp`` command."""
    from styleexp.system import gpus
    from styleexp.system.errors import UserError

    gpus.remember()

    warnings.showwarning = _show_warning  # type: ignore[assignment]
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # print any file name, even to an ASCII terminal
            stream.reconfigure(errors="backslashreplace")
    try:
        _command(sys.argv[1:])
        sys.stdout.flush()
    except UserError as error:
        stop(error)
    except BrokenPipeError:  # as with `styleexp --help | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except KeyboardInterrupt:
        sys.exit(130)


def _command(given: list[str]) -> None:
    from styleexp.system.errors import UserError

    try:
        os.getcwd()
    except FileNotFoundError:
        raise UserError("the current folder no longer exists: change to another.") from None
    if not given:
        print(USAGE + MORE, end="", file=sys.stderr)
        sys.exit(2)
    if given in (["--help"], ["-h"]):
        print(USAGE + HELP, end="")
        return
    given = ["--help" if word == "--help-all" else word for word in given]
    if "--version" in given:
        from styleexp import __version__

        print(f"styleexp {__version__}")
        return
    if given[0] == "reproduce":
        from styleexp.cli import reproduce

        sys.exit(reproduce.main(given[1:]))
    resume = [a for a in given if a.startswith("resume=")]
    if len(resume) > 1:
        raise UserError("resume= continues a single run: give it once.")
    if resume:
        _resume(resume[0].removeprefix("resume="), [a for a in given if a not in resume])
    else:
        from styleexp.cli import arguments

        # Hydra's parser rejects overrides on both sides of a flag: `+experiment=x -m profile=fast`.
        sys.argv[1:] = arguments.for_hydra(given)
        _hydra()


def _hydra() -> None:
    import hydra
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    from styleexp.config import compose
    from styleexp.config.explain import explain, explain_plugin
    from styleexp.experiments.sweeps import report
    from styleexp.runs.records import first_line
    from styleexp.system.errors import UserError

    compose.register()
    _list_groups_once()

    # Hydra prints and exits by itself unless told to raise; we want one sentence and exit code 2.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    main = hydra.main(version_base="1.3", config_path=compose.CONFIG_PATH, config_name="config")
    try:
        main(_job)()
    except (HydraException, OmegaConfBaseException) as error:
        explain_plugin(error)
        if DEBUG in sys.argv:
            raise
        _stop(explain(error))
    except BrokenPipeError:
        raise
    except OSError as error:
        if DEBUG in sys.argv:
            raise
        _stop(f"cannot write the run's folder: {error}; choose another with hydra.run.dir=FOLDER.")
    except Exception as error:
        if report.begun is None:
            raise
        if not isinstance(error, UserError) or DEBUG in sys.argv:
            traceback.print_exc()
        report.finish(report.begun)
        _stop(f"the sweep ended early: {first_line(error)}")
    if report.begun is not None:
        sys.exit(report.exit_code(report.begun))


def _job(config: DictConfig) -> float | None:
    """Job function for Hydra, possibly called in another process.

    A sweep's job never raises when it fails, so that the others continue; its folder records the
    failure. A search's job does raise, because the search counts failures, and returns the
    objective.
    """
    from contextlib import chdir
    from pathlib import Path

    from hydra.core.hydra_config import HydraConfig
    from omegaconf import OmegaConf

    from styleexp.config import compose, unread
    from styleexp.experiments.execute import run
    from styleexp.experiments.sweeps import launchers, objective, pruning, runner
    from styleexp.system.errors import UserError

    runtime = HydraConfig.get()
    in_search = objective.LEAST_CRAFT in os.environ
    numbered = not OmegaConf.is_missing(runtime.job, "num")
    in_sweep = numbered and not in_search
    compose.register()  # not done yet in a launcher's process
    code = 0
    try:
        typed = compose.typed(config)
        typed.threads = typed.threads or launchers.threads_each(runtime)
        if in_sweep:
            launchers.place(runtime, typed.device)
        folder = Path(runtime.runtime.output_dir)
        trial = None
        if in_search and numbered:
            trial = pruning.trial(folder, runtime.sweeper.n_jobs)
        # Keep Hydra's grammar: resolving would lose an escaped "${" in a file's name.
        given: Any = OmegaConf.to_container(runtime.overrides.task, resolve=False)
        if not numbered and (note := unread.note([typed], given)):  # for sweeps, see `sweeps.claim`
            print(f"note: {note}")
        if numbered:
            runner.end_with_runner()
        # Resolve typed paths despite hydra.job.chdir.
        with runner.AT_WORK, chdir(runtime.runtime.cwd):
            code = run(typed, folder, given, again=not numbered, trial=trial)
    except UserError as error:
        if config.debug or in_search:
            raise
        if not in_sweep:
            _stop(str(error))  # if raised, Hydra would add its own line
        print(f"styleexp: {error}", file=sys.stderr)
    except Exception:
        if not in_sweep:
            raise
        traceback.print_exc()
    if code == 130 and in_sweep:
        raise KeyboardInterrupt
    if code and not in_sweep:
        sys.exit(code)
    return objective.objective(folder) if in_search else None


def _list_groups_once() -> None:
    """Make Hydra copy all configs once, not for each of the 140 lists in the help (saves 1.5 s)."""
    from functools import cache

    from hydra._internal.config_loader_impl import ConfigLoaderImpl
    from hydra._internal.config_repository import IConfigRepository
    from hydra.core.object_type import ObjectType

    list_anew = ConfigLoaderImpl.get_group_options

    @cache
    def copied(loader: ConfigLoaderImpl) -> IConfigRepository:
        return loader._parse_overrides_and_create_caching_repo(None, [])[1]

    def get_group_options(
        self: ConfigLoaderImpl,
        group_name: str,
        results_filter: ObjectType | None = ObjectType.CONFIG,
        config_name: str | None = None,
        overrides: list[str] | None = None,
    ) -> list[str]:
        if config_name or overrides:
            return list_anew(self, group_name, results_filter, config_name, overrides)
        return copied(self).get_group_options(group_name, results_filter)

    ConfigLoaderImpl.get_group_options = get_group_options  # type: ignore[method-assign]


def _resume(folder: str, others: list[str]) -> None:
    from pathlib import Path

    from styleexp.experiments.execute import resume
    from styleexp.system.errors import UserError

    if others:
        raise UserError(
            "resume= uses the configuration of its folder and takes no other arguments: drop "
            f"{' '.join(others)}."
        )
    sys.exit(resume(Path(folder)))


def _show_warning(message: Warning | str, *details: object) -> None:
    print(f"warning: {message}", file=sys.stderr)


def stop(error: UserError) -> NoReturn:
    """Print the error (with ``debug=true``, the traceback) and exit with code 2."""
    if DEBUG in sys.argv:
        traceback.print_exception(error)
    _stop(str(error))


def _stop(message: str) -> NoReturn:
    print(f"styleexp: {message}", file=sys.stderr)
    sys.exit(2)
