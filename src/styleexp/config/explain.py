"""Translate Hydra and OmegaConf errors into one-sentence messages."""

from __future__ import annotations

import difflib
import re

UNKNOWN_CHOICE = r"Could not find '([\w/]+)/([^'/]+)'"
"""Hydra's message for an unknown option name."""
UNFIT = re.compile(
    r"Error merging override ([^\n]*)\nValue '[^\n]*' "
    r"(?:of type '\w+' could not be converted to|is not a valid) (Float|Integer|bool)"
)
"""OmegaConf's message for a value of another type."""
WANTED = {"Float": "a number", "Integer": "a whole number", "bool": "true or false"}
SEVERAL = re.compile(r"Ambiguous value for argument '([^'=]+)=([^\n]*)'")
"""Hydra's message for several values without ``-m``."""
UNADDED = re.compile(
    r"Could not override '([^'=]+)'[^\n]*\n*(?:Did you mean[^\n]*\n*)?"
    r"To append to your default list use \+([^\n]*)"
)
"""Hydra's message for a group that is chosen with ``+``."""
FOLDER = ("out", "output", "outdir", "out_dir", "output_dir", "dir", "folder", "run_dir")
"""What people take the run's folder for."""
HYDRA_PLUGINS = {"hydra/launcher": "sweep", "hydra/sweeper": "search"}
"""Config groups provided by Hydra plugins, and the extra that installs them."""


def explain_plugin(error: BaseException) -> None:
    """Raise the `UserError` of a chosen plugin that can't be used, if that caused ``error``."""
    from styleexp import plugins

    choice = re.search(UNKNOWN_CHOICE, str(error))
    if choice and plugins.known(choice[1], choice[2]):
        plugins.find(choice[1], choice[2])


def explain(error: BaseException) -> str:
    """Hydra's error as one or two sentences, with the closest known name."""
    text = str(error)
    while error.__cause__ is not None:  # Hydra wraps OmegaConf's, which says more
        error = error.__cause__
        text += f"\n{error}"
    choice = re.search(UNKNOWN_CHOICE, text)
    if choice:
        from styleexp.system.errors import unknown_name

        if choice[1] in HYDRA_PLUGINS:
            extra = "ray" if choice[2] == "ray" else HYDRA_PLUGINS[choice[1]]
            return (
                f"Hydra's plugin '{choice[2]}' is not installed: pip install 'styleexp[{extra}]'."
            )
        return str(unknown_name(choice[1], choice[2], _options(choice[1])))
    if several := SEVERAL.search(text):
        key, values = several.groups()
        return (
            f"{key} has several values, {values}: add -m to run each of them, or give one (a list "
            f"is {key}=[{values}])."
        )
    if unadded := UNADDED.search(text):
        return f"{unadded[1]} is not part of every run: add it with a plus, +{unadded[2].strip()}."
    unknown = re.search(r"Key '(\w+)' (?:is )?not in", text)
    if unknown:
        from styleexp.config.schema import Config

        known = _keys(Config)
        if full := re.search(r"full_key: (\w+)\.", text):  # others of its section are nearer
            section = full[1]
            own = [k for k in [*known, *_keys_of_parts(section)] if k.startswith(f"{section}.")]
            known = own or known
        near = difflib.get_close_matches(unknown[1], [k.split(".")[-1] for k in known], n=1)
        meant = [k for k in known if near and k.split(".")[-1] == near[0]]
        if unknown[1] in FOLDER:
            meant = ["hydra.run.dir"]
        hint = f"did you mean {' or '.join(dict.fromkeys(meant))}? " if meant else ""
        if full and not meant:
            of_it = ", ".join(sorted(dict.fromkeys(k.removeprefix(f"{section}.") for k in known)))
            return f"{section} has no key '{unknown[1]}', only {of_it}."
        return f"there is no key '{unknown[1]}': {hint}'styleexp --help-all' lists the keys."
    if unfit := UNFIT.search(text):
        key, _, value = unfit[1].strip().partition("=")
        return f"{key} must be {WANTED[unfit[2]]}, not '{value}'."
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    kept = [x for x in lines if not x.startswith(("full_key", "object_type", "reference_type"))]
    return ": ".join(dict.fromkeys(kept)) or type(error).__name__


def _options(group: str) -> list[str]:
    from hydra._internal.config_loader_impl import ConfigLoaderImpl
    from hydra._internal.utils import create_config_search_path

    from styleexp.config import compose

    loader = ConfigLoaderImpl(create_config_search_path(compose.CONFIG_PATH))
    return loader.get_group_options(group)


def _keys_of_parts(kind: str) -> list[str]:
    """Keys of the options of every usable part of a kind."""
    from styleexp import plugins

    specs = [c.loaded for c in plugins.everything() if c.kind == kind and not c.fault]
    return [f"{kind}.{key}" for spec in specs if spec is not None for key in _keys(spec.config)]


def _keys(schema: type, prefix: str = "") -> list[str]:
    import dataclasses
    import typing

    found = []
    for name, kind in typing.get_type_hints(schema).items():
        found.append(prefix + name)
        if dataclasses.is_dataclass(kind):
            found += _keys(typing.cast(type, kind), f"{prefix}{name}.")
    return found
