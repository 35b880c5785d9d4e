"""Hydra configuration of this package, for the command line and for Python callers.

The command line is a Hydra application and registers everything with Hydra (`register`). A Python
caller may itself be a Hydra application, so `compose` works on a separate store.
"""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf

from styleexp import plugins
from styleexp.config import allow_list, schema
from styleexp.config import overrides as words
from styleexp.inputs.assets import names as asset_names
from styleexp.inputs.shapes import SOURCES, STYLES
from styleexp.system.errors import UserError

CONFIG_PATH = "pkg://styleexp.conf"
PREVIEWS = ("builtin", "pyrender")
PARTS = ("renderer", "encoder", "style", "field", "loss", "baseline")
"""Configuration keys whose options depend on the part they name. ``logger`` holds several parts,
keyed by name."""


def register() -> None:
    """Register with Hydra: the schema, one option per registered name, and the allow-list of call
    targets. Safe to call again."""
    allow_list.guard()
    _fill(ConfigStore.instance())
    OmegaConf.register_new_resolver("run_name", _run_name, replace=True)


def _fill(store: ConfigStore) -> None:
    """Store the schema, and one option per registered name."""
    store.store(name="base_config", node=schema.Config)
    for name in PREVIEWS:
        store.store(group="preview", name=name, node={"name": name})
    meshes, pictures = asset_names("mesh"), asset_names("image")
    for name in {*SOURCES, *STYLES, *meshes}:
        store.store(group="source", name=name, node={"name": name})
    for name in {*meshes, *pictures}:
        store.store(group="style", name=name, node={"name": name})
    broken = []
    for choice in plugins.everything():
        if choice.fault:
            broken.append(f"{choice.kind}={choice.name}")
        elif choice.kind in PARTS:
            node = choice.spec.config(name=choice.name)
            store.store(group=choice.kind, name=choice.name, node=node)
        elif choice.kind == "logger":
            node = choice.spec.config(name=choice.name)
            package = f"logger.{choice.name}"
            store.store(group="logger", name=choice.name, node=node, package=package)
    store.store(
        group="hydra/help",
        name="styleexp",
        node={"app_name": "styleexp", "header": _header(broken), "template": HELP_TEMPLATE},
    )


def typed(config: DictConfig) -> schema.Config:
    """The composed configuration as plain dataclasses."""
    plain = words.literal(OmegaConf.to_container(config, resolve=True))
    assert isinstance(plain, dict)
    parts = {kind: _part(kind, plain.pop(kind, None)) for kind in PARTS}
    loggers = plain.pop("logger", None) or {}
    built: Any = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(schema.Config), plain))
    for kind, part in parts.items():
        setattr(built, kind, part)
    built.logger = {name: _part("logger", options) for name, options in loggers.items()}
    return built


UNNAMED: dict[str, dict[str, Any]] = {
    "field": {"start": "source", "unfold": False},
    "shading": {"lights": 1},
    "optim": {"unit_gradient": False},
}
"""Values for options that are missing in old records because they didn't exist yet."""
REMOVED: dict[str, dict[str, Any]] = {
    "encoder": {"pooling": "max"},
    "shading": {"light_spread": 0.0},
    "baseline": {"flatten": 0.0},
}
"""Options that old records have and this version doesn't, with the value that had no effect."""


def recorded(config: Any) -> schema.Config:
    """The configuration in a run's record, which is untrusted: only plain values are accepted.

    Raises `UserError` for an interpolation, which could read the environment, and for a
    configuration that this version doesn't support. File names that look like interpolations are
    allowed.
    """
    from omegaconf.errors import OmegaConfBaseException

    if "${" in json.dumps(_without_files(config), default=str):
        raise UserError(
            "the run's record holds an interpolation (${...}), but only plain values are allowed."
        )
    if isinstance(config, dict):
        for part, values in UNNAMED.items():
            if isinstance(config.get(part), dict):
                config = {**config, part: {**values, **config[part]}}
        for part, values in REMOVED.items():
            if isinstance(config.get(part), dict):
                kept = {k: v for k, v in config[part].items() if values.get(k, not v) != v}
                config = {**config, part: kept}
    try:
        return typed(OmegaConf.create(words.literal(config)))
    except (OmegaConfBaseException, AssertionError, AttributeError, TypeError, ValueError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise UserError(
            f"the run's record is not a valid configuration for this version ({reason}): use the "
            "version of styleexp that wrote it."
        ) from error


def _without_files(node: Any) -> Any:
    """Copy of a record without the values of keys that name files."""
    if isinstance(node, dict):
        return {k: _without_files(v) for k, v in node.items() if k not in words.FILES}
    return [_without_files(value) for value in node] if isinstance(node, list) else node


def _part(kind: str, plain: dict[str, Any] | None) -> Any:
    """One part's options, as an instance of its registered dataclass."""
    name = (plain or {}).get("name")
    plugins.warn_of_rivals(kind, name)
    options = plugins.KINDS[kind].base
    if name is not None and (kind != "style" or plugins.known(kind, name)):
        options = plugins.find(kind, name).spec.config
    if options is None:
        return None
    return OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(options), plain or {}))


def compose(overrides: Sequence[str]) -> schema.Config:
    """Compose the configuration for these command-line overrides.

    Restores Hydra's and OmegaConf's global state afterwards, so that the caller may be a Hydra
    application. Thread-safe.
    """
    from hydra._internal.config_loader_impl import ConfigLoaderImpl
    from hydra._internal.utils import create_config_search_path
    from hydra.types import RunMode
    from omegaconf import open_dict

    with _own_hydra() as store:
        _fill(store)
        loader = ConfigLoaderImpl(create_config_search_path(CONFIG_PATH))
        config = allow_list.load(
            lambda: loader.load_configuration(
                "config", words.understood(overrides), RunMode.RUN, from_shell=False
            )
        )
        with open_dict(config):
            config.pop("hydra")
        return typed(config)


_ONE_AT_A_TIME = threading.RLock()


@contextmanager
def _own_hydra() -> Iterator[ConfigStore]:
    """Swap out Hydra's global state, and restore it on exit.

    The new store holds only Hydra's own configurations, because the host application may define its
    own ``base_config`` or group ``encoder``.
    """
    import copy

    from hydra import version
    from hydra.core.plugins import Plugins
    from hydra.core.singleton import Singleton

    with _ONE_AT_A_TIME:
        Plugins.instance()  # before copying the store: plugins register in it too
        theirs = Singleton._instances
        repo = ConfigStore.instance().repo
        Singleton._instances = {
            kind: each
            for kind, each in theirs.items()
            if kind not in (ConfigStore, version.VersionBase)
        }
        try:
            version.setbase("1.3")
            store = ConfigStore.instance()
            store.repo.update((key, copy.deepcopy(repo[key])) for key in HYDRAS if key in repo)
            yield store
        finally:
            Singleton._instances = theirs


HYDRAS = ("hydra", "_dummy_empty_config_.yaml")
"""Top-level entries of Hydra and its plugins in the configuration store."""

NAME_LENGTH = 60
"""Maximum characters of a file's name in the name of a run's folder; file systems allow 255
bytes."""


def _run_name(source: Any, style: Any) -> str:
    from pathlib import PurePath

    def short(part: Any) -> str:
        stem = PurePath(part.path).stem if part.path else str(part.name)
        # Hydra parses the folder's name as a configuration value; shells parse it too.
        return re.sub(r"[\x00-\x1f\x7f$\\/]", "_", stem)[:NAME_LENGTH].strip() or "_"

    return f"{short(source)}-{short(style)}"


def _header(broken: Sequence[str]) -> str:
    if not broken:
        return HELP_HEADER
    names = re.sub(r"[^\w.:=, -]", "?", ", ".join(broken))  # the header is a template
    return f"{HELP_HEADER}\nThese plugins can't be used (see styleexp-plugins): {names}\n"


HELP_HEADER = """\
${hydra.help.app_name}: put the local geometry of a mesh or picture onto another mesh.
"""

HELP_TEMPLATE = """\
${hydra.help.header}
  styleexp critter bubble
  styleexp my.obj her.ply
  styleexp critter peeling.jpg strength=0.5
  styleexp my.obj her.ply method=robust profile=fast
  styleexp method=paper encoder=vgg19 field.sigma=5 source=critter style=stripe
  styleexp resume=outputs/spot-bubble/2026-01-31_12-00-00
  styleexp reproduce outputs/spot-bubble/2026-01-31_12-00-00

Choices (group=option):
$APP_CONFIG_GROUPS
Keys, with their values for these choices (key=value, e.g. style.scale=2):
$CONFIG
The run's folder: hydra.run.dir=FOLDER. Tracebacks: debug=true. Completion:
eval "$$(styleexp -sc install=bash)". Hydra's own flags: --hydra-help
"""
