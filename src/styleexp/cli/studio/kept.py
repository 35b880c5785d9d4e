"""What the studio keeps between two settings, so that a change makes anew only what it changes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from styleexp.api import configured
from styleexp.config import build, sources
from styleexp.config.checks import check
from styleexp.config.compose import compose
from styleexp.inputs import meshes
from styleexp.inputs.style import Style
from styleexp.method import masks
from styleexp.method.subject import placed
from styleexp.method.synthesis import method as synthesis

if TYPE_CHECKING:
    from torch import Tensor

    from styleexp.cli.studio.settings import Settings
    from styleexp.config.schema import Config
    from styleexp.method.subject import Subject


class Kept:
    """What is kept between two settings, each thing for the newest that it was made for."""

    def __init__(self) -> None:
        self._kept: dict[str, tuple[Any, Any]] = {}
        # A third of a second each time; sources and styles are named afterwards.
        self._composed = lru_cache(64)(compose)

    def _config(self, settings: Settings, overrides: Sequence[str]) -> Config:
        def composed(words: Sequence[str]) -> Config:
            return deepcopy(self._composed(tuple(words)))

        return configured(settings.source, settings.style, overrides, composed)[0]

    def clear(self) -> None:
        """Drop everything, because a file was replaced under the same name."""
        self._kept.clear()

    def _get(self, name: str, key: Any, make: Callable[[], Any]) -> Any:
        kept = self._kept.get(name)
        if kept is None or kept[0] != key:
            self._kept[name] = kept = (key, make())
        return kept[1]

    def source(self, settings: Settings, more: tuple[str, ...] = ()) -> tuple[meshes.Mesh, Style]:
        """The source and the style as read. ``more`` are the overrides of what is made next."""

        def named() -> Any:
            config = self._config(settings, [*settings.overrides, *more])
            sources.check(config)
            return config

        config = self._get("named", (settings.source, settings.style), named)
        return (
            self._get("source", settings.source, lambda: sources.load_source(config.source)),
            self._get("style", settings.style, lambda: sources.load_style(config.style)),
        )

    @contextmanager
    def given(
        self, settings: Settings, more: tuple[str, ...] = ()
    ) -> Iterator[tuple[Callable[..., Any], Any]]:
        """Within it, source and style aren't read again. Yields a function from further overrides
        to a configuration, and these two."""
        mesh, style = self.source(settings, more)
        given = style.mesh if style.mesh is not None else style.picture
        assert given is not None

        def config(more: tuple[str, ...] = ()) -> Any:
            return self._config(settings, [*settings.overrides, *more])

        with sources.given(source=mesh, style=given):
            yield config, (mesh, style)

    def subject(self, settings: Settings, more: tuple[str, ...], config: Any, load: Any) -> Subject:
        """The subject, measured anew only if source, style or scale differ."""
        wanted = config(more)
        check(wanted)
        masks.check(wanted.style, load[0])

        def make() -> Subject:
            plain = replace(settings, mask="", strength=1.0, direction="auto", rotation=0.0)
            return build.subject_of(self._config(settings, [*plain.overrides, *more]), True)

        key = (settings.source, settings.style, settings.scale, settings.invert, settings.seed)
        subject: Subject = self._get(f"subject {more}", key, make)
        mask, share = placed(wanted.style, subject.source, subject.areas)
        notes = (*subject.notes, *share)
        return replace(subject, settings=wanted, mask=mask, notes=notes)

    def begun(self, settings: Settings, more: tuple[str, ...], subject: Subject) -> synthesis.Begun:
        """The pattern and the source to walk on."""
        key = (settings.source, settings.style, settings.scale, settings.invert, settings.seed)
        found: synthesis.Begun = self._get(f"begun {more}", key, lambda: synthesis.begin(subject))
        return found

    def _heights_key(self, settings: Settings) -> Any:
        return replace(settings, strength=1.0, mask="", falloff=0.0, steps=100)

    def heights_for(self, settings: Settings, more: tuple[str, ...]) -> Tensor | None:
        """The synthesised heights, if only strength or mask have changed."""
        kept = self._kept.get(f"heights {more}")
        return kept[1] if kept and kept[0] == self._heights_key(settings) else None

    def keep_heights(self, settings: Settings, more: tuple[str, ...], height: Tensor) -> None:
        """Keep them for the next settings."""
        self._kept[f"heights {more}"] = (self._heights_key(settings), height)
