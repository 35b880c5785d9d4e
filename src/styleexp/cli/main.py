"""``styleexp``: compose the configuration, run, and say in one sentence what went wrong."""

from __future__ import annotations

import difflib
import os
import re
import sys
import traceback
import warnings
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from omegaconf import DictConfig

DEBUG = "debug=true"
MODES = ("-m", "--multirun", "-r", "--run")
UNKNOWN_CHOICE = r"Could not find '([\w/]+)/([^'/]+)'"
"""Hydra's words for a name that it has no option for."""
HYDRA_PLUGINS = {"hydra/launcher": "sweep", "hydra/sweeper": "search"}
"""Choices that Hydra's plugins bring, and the extra that installs those."""


def main() -> None:
    """Entry point of the ``styleexp`` command."""
    from styleexp.errors import UserError

    warnings.showwarning = _show_warning  # type: ignore[assignment]
    # Hydra's parser refuses overrides on both sides of a flag: `+experiment=x -m profile=fast`.
    flags = [a for a in sys.argv[1:] if a in MODES]
    sys.argv[1:] = flags + [a for a in sys.argv[1:] if a not in MODES]
    try:
        resume = [a for a in sys.argv[1:] if a.startswith("resume=")]
        if resume:
            _resume(resume[0].removeprefix("resume="))
        else:
            _hydra()
    except UserError as error:
        if DEBUG in sys.argv:
            raise
        _stop(str(error))
    except KeyboardInterrupt:
        sys.exit(130)


def _hydra() -> None:
    import hydra
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    from styleexp import compose
    from styleexp.errors import UserError
    from styleexp.records import first_line
    from styleexp.sweeps import report

    compose.register()
    _list_groups_once()

    # Hydra prints and exits by itself unless told to raise; we want one sentence and exit code 2.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    main = hydra.main(version_base="1.3", config_path=compose.CONFIG_PATH, config_name="config")
    try:
        main(_job)()
    except (HydraException, OmegaConfBaseException) as error:
        _explain_plugin(error)
        if DEBUG in sys.argv:
            raise
        _stop(explain(error))
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
    """What Hydra calls for every job, maybe in another process.

    A job of a sweep never raises for its own failure, so that the others go on; its folder tells.
    Those of a search do, as it counts them, and return what it minimises.
    """
    from contextlib import chdir
    from pathlib import Path

    from hydra.core.hydra_config import HydraConfig
    from omegaconf import OmegaConf

    from styleexp import compose
    from styleexp.cli.run import run
    from styleexp.errors import UserError
    from styleexp.sweeps import launchers, objective

    runtime = HydraConfig.get()
    in_search = objective.LEAST_IOU in os.environ
    numbered = not OmegaConf.is_missing(runtime.job, "num")
    in_sweep = numbered and not in_search
    compose.register()  # a launcher's process has not done so
    code = 0
    try:
        typed = compose.typed(config)
        typed.threads = typed.threads or launchers.threads_each(runtime)
        folder = Path(runtime.runtime.output_dir)
        with chdir(runtime.runtime.cwd):  # hydra.job.chdir leaves what was typed as it was meant
            code = run(typed, folder, list(runtime.overrides.task), again=not numbered)
    except UserError as error:
        if config.debug or in_search:
            raise
        if not in_sweep:
            _stop(str(error))  # raised, Hydra would add a line of its own
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
    """Let Hydra copy all configs once, not once for each of the 140 lists in the help: 1.5 s."""
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


def _explain_plugin(error: BaseException) -> None:
    """Raise the `UserError` of a plugin that was chosen and can't be used, if that's the matter."""
    from styleexp import plugins

    choice = re.search(UNKNOWN_CHOICE, str(error))
    if choice and plugins.known(choice[1], choice[2]):
        plugins.find(choice[1], choice[2])


def explain(error: BaseException) -> str:
    """Hydra's complaint as one or two sentences, with the nearest known name."""
    text = str(error)
    while error.__cause__ is not None:  # Hydra wraps OmegaConf's, which says more
        error = error.__cause__
        text += f"\n{error}"
    choice = re.search(UNKNOWN_CHOICE, text)
    if choice:
        from styleexp.errors import unknown_name

        if choice[1] in HYDRA_PLUGINS:
            extra = "ray" if choice[2] == "ray" else HYDRA_PLUGINS[choice[1]]
            return (
                f"Hydra's plugin '{choice[2]}' is not installed: pip install 'styleexp[{extra}]'."
            )
        return str(unknown_name(choice[1], choice[2], _options(choice[1])))
    key = re.search(r"Key '(\w+)' (?:is )?not in", text)
    if key:
        from styleexp.config import Config

        known = _keys(Config)
        near = difflib.get_close_matches(key[1], [k.split(".")[-1] for k in known], n=1)
        full = [k for k in known if near and k.split(".")[-1] == near[0]]
        hint = f"did you mean {' or '.join(full)}? " if full else ""
        return f"there is no key '{key[1]}': {hint}'styleexp --help' lists the keys."
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    told = [x for x in lines if not x.startswith(("full_key", "object_type", "reference_type"))]
    return ": ".join(dict.fromkeys(told)) or type(error).__name__


def _options(group: str) -> list[str]:
    from hydra._internal.config_loader_impl import ConfigLoaderImpl
    from hydra._internal.utils import create_config_search_path

    from styleexp import compose

    loader = ConfigLoaderImpl(create_config_search_path(compose.CONFIG_PATH))
    return loader.get_group_options(group)


def _keys(schema: type, prefix: str = "") -> list[str]:
    import dataclasses
    import typing

    found = []
    for name, kind in typing.get_type_hints(schema).items():
        found.append(prefix + name)
        if dataclasses.is_dataclass(kind):
            found += _keys(typing.cast(type, kind), f"{prefix}{name}.")
    return found


def _resume(folder: str) -> None:
    from pathlib import Path

    from styleexp.cli.run import resume
    from styleexp.errors import UserError

    others = [a for a in sys.argv[1:] if not a.startswith("resume=")]
    if others:
        raise UserError(
            f"resume= goes on with the configuration of its folder and takes no other argument: "
            f"drop {' '.join(others)}."
        )
    sys.exit(resume(Path(folder)))


def _show_warning(message: Warning | str, *details: object) -> None:
    print(f"warning: {message}", file=sys.stderr)


def _stop(message: str) -> NoReturn:
    print(f"styleexp: {message}", file=sys.stderr)
    sys.exit(2)
