"""Compose many configurations that differ in few overrides, as a plan's jobs do.

Hydra takes a tenth of a second to compose one. An override such as ``optim.seed=3`` sets a single
value and affects nothing else, so jobs that differ in such overrides alone are composed once and
their values are set in copies. The same holds for ``source=NAME`` and ``style=NAME``, which set
``source.name`` and ``style.name``. Everything else is left to Hydra.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from styleexp import plugins
from styleexp.config import compose
from styleexp.config import overrides as words
from styleexp.method.options import StyleConfig

if TYPE_CHECKING:
    from hydra.core.override_parser.types import Override
    from omegaconf import DictConfig

    from styleexp.config.schema import Config


class NotSingle(Exception):
    """An override does more than to set a single value."""


class Composer:
    """Composes configurations one after the other. Needs an initialised Hydra
    (`compose.register`)."""

    def __init__(self) -> None:
        from hydra.core.global_hydra import GlobalHydra

        self._loader: Any = GlobalHydra.instance().config_loader()
        self._parsed: dict[str, Override] = {}
        self._shared: dict[tuple[str, ...], Config | None] = {}
        self._groups: dict[str, bool] = {}
        self._values: dict[tuple[type, str, str], Any] = {}

    def compose(self, overrides: Sequence[str]) -> Config:
        """The configuration for these overrides, as `compose.typed` returns it.

        Parts that several configurations have in common are the same objects: don't change them.
        Raises Hydra's exceptions and `UserError` if composing fails.
        """
        try:
            return self._quickly(overrides)
        except NotSingle:
            return compose.typed(_by_hydra(overrides))

    def _quickly(self, overrides: Sequence[str]) -> Config:
        """Set the single values in a copy of what the other overrides compose to. Raises
        `NotSingle`."""
        named, single, others = [], [], []
        for text in overrides:
            override = self._parse(text)
            key = override.key_or_group
            if not self._is_group(override):
                if not override.is_hydra_override():
                    _check_single(override)
                    single.append((key.split("."), text))
                    continue
            elif _sets_its_name(override):
                named.append(([key, "name"], text))
                continue
            others.append(text)
        kinds = [kind for (kind, _), _ in named]
        if len(set(kinds)) < len(kinds):
            raise NotSingle  # Hydra reports it
        config = self._base(tuple(others))
        for path, text in (*named, *single):  # Hydra applies values after groups
            config = self._with(config, path, text)
        for kind in ("source", "style"):
            plugins.warn_of_rivals(kind, getattr(config, kind).name)
        return config

    def _parse(self, text: str) -> Override:
        if text not in self._parsed:
            from hydra.core.override_parser.overrides_parser import OverridesParser

            parser = OverridesParser.create(config_loader=self._loader)
            (self._parsed[text],) = parser.parse_overrides([text])
        return self._parsed[text]

    def _is_group(self, override: Override) -> bool:
        """Whether Hydra takes the override for a choice of a file, not for a value."""
        key = override.key_or_group
        if key not in self._groups:
            self._groups[key] = self._loader.repository.group_exists(key)
        return self._groups[key] and not isinstance(override.value(), dict)

    def _base(self, overrides: tuple[str, ...]) -> Config:
        if overrides not in self._shared:
            composed = _by_hydra(overrides)
            has_references = "${" in str(_plain(composed))
            self._shared[overrides] = None if has_references else compose.typed(composed)
        base = self._shared[overrides]
        if base is None or type(base.style) is not StyleConfig:
            raise NotSingle
        return base

    def _with(self, node: Any, path: list[str], text: str) -> Any:
        """Copy of a dataclass in which the override ``text`` set the value at ``path``."""
        name, *rest = path
        if not dataclasses.is_dataclass(node) or name not in vars(node):
            raise NotSingle
        before = getattr(node, name)
        if not rest and (dataclasses.is_dataclass(before) or isinstance(before, dict)):
            raise NotSingle
        changed = copy.copy(node)
        value = self._with(before, rest, text) if rest else self._value(type(node), name, text)
        setattr(changed, name, value)
        return changed

    def _value(self, options: type, name: str, text: str) -> Any:
        """An override's value, converted to the type of the option ``name``."""
        from omegaconf import OmegaConf
        from omegaconf.errors import OmegaConfBaseException

        at = (options, name, text)
        if at not in self._values:
            given = {name: words.literal(self._parse(text).value())}
            try:
                made = OmegaConf.merge(OmegaConf.structured(options), given)
                self._values[at] = getattr(OmegaConf.to_object(made), name)
            except OmegaConfBaseException:
                raise NotSingle from None  # Hydra's message has the full key
        return self._values[at]


def _by_hydra(overrides: Sequence[str]) -> DictConfig:
    import hydra

    return hydra.compose("config", list(overrides))


def _plain(config: DictConfig) -> Any:
    from omegaconf import OmegaConf

    return OmegaConf.to_container(config, resolve=False)


def _check_single(override: Override) -> None:
    """Raise `NotSingle` unless the override sets one existing value, whatever the others are. A
    part's ``name`` decides which options it has; an interpolation reads other values."""
    from hydra.core.override_parser.types import OverrideType

    text, key = str(override.input_line), override.key_or_group
    of_a_part = key.split(".")[0] in compose.PARTS and key.endswith(".name")
    if (
        override.type is not OverrideType.CHANGE
        or override.package is not None
        or override.is_sweep_override()
        or isinstance(override.value(), dict)
        or of_a_part
        or "$" in text
    ):
        raise NotSingle


def _sets_its_name(override: Override) -> bool:
    """Whether the option of ``source`` or ``style`` sets nothing but its name."""
    from hydra.core.override_parser.types import OverrideType

    kind, name = override.key_or_group, override.value()
    if kind not in ("source", "style") or override.type is not OverrideType.CHANGE:
        return False
    return override.package is None and isinstance(name, str) and _names_only(kind, name)


def _names_only(kind: str, name: str) -> bool:
    """Whether an option of the group ``source`` or ``style`` sets nothing but ``name``."""
    from hydra.core.config_store import ConfigStore
    from omegaconf import OmegaConf

    stored = ConfigStore.instance().repo.get(kind, {}).get(f"{name}.yaml")
    if stored is None:
        return False
    return set(stored.node) == {"name"} or OmegaConf.get_type(stored.node) is StyleConfig
