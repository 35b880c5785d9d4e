"""Find and build parts by name, built in or from plugins, and explain failures.

A plugin is a `Spec` that another package declares in its entry points::

    [project.entry-points."styleexp.renderers"]
    my_renderer = "my_package.spec:MY_RENDERER"

or, for a quick experiment, that the environment variable ``STYLEEXP_PLUGINS`` names::

    STYLEEXP_PLUGINS="renderer=my_module:MY_RENDERER, field=my_module:MY_FIELD"

Specs are loaded once, on first use. One that fails to load raises an error only when chosen. If
several plugins have the same name, none is used; built-in names can't be overridden.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from styleexp import __version__
from styleexp.encoders.options import EncoderConfig
from styleexp.inputs import assets
from styleexp.method.options import FieldConfig, LossConfig, StyleConfig
from styleexp.plugins import catalogue, code
from styleexp.plugins.spec import Spec
from styleexp.system.errors import UserError, unknown_name
from styleexp.system.options import check

if TYPE_CHECKING:
    import torch

VARIABLE = "STYLEEXP_PLUGINS"
OWN = "styleexp"
"""Origin of built-in parts."""


@dataclass(frozen=True)
class Kind:
    """A kind of part that has plugins."""

    group: str
    """Entry-point group."""
    built_in: Mapping[str, Spec]
    base: type | None = None
    """Required base of the options dataclass, if its keys are also read outside the part."""


KINDS = {
    "renderer": Kind("styleexp.renderers", catalogue.RENDERERS),
    "encoder": Kind("styleexp.encoders", catalogue.ENCODERS, EncoderConfig),
    "style": Kind("styleexp.styles", catalogue.STYLES, StyleConfig),
    "field": Kind("styleexp.fields", catalogue.FIELDS, FieldConfig),
    "loss": Kind("styleexp.losses", catalogue.LOSSES, LossConfig),
    "baseline": Kind("styleexp.baselines", catalogue.BASELINES),
    "logger": Kind("styleexp.loggers", catalogue.LOGGERS),
}


@dataclass(frozen=True)
class Choice:
    """One name of one kind: its origin, and why it can't be used, if so."""

    kind: str
    """A key of `KINDS`, or any other text if the plugin declares an unknown kind."""
    name: str
    origin: str
    """``styleexp``, or the distribution or environment variable with its entry."""
    version: str | None = None
    distribution: str | None = None
    loaded: Spec | None = None
    fault: str | None = None
    """Why the spec is missing or refused."""
    error: BaseException | None = field(default=None, compare=False, repr=False)
    ceded: bool = False
    """Refused because a built-in part or an asset has the same name."""
    module: str | None = None
    """The module that a plugin's spec was loaded from."""

    @property
    def spec(self) -> Spec:
        """The spec. Raises `UserError` if it is missing or refused."""
        if self.loaded is None or self.fault:
            raise UserError(f"the {self.kind} '{self.name}' can't be used: {self.fault}.") from (
                self.error
            )
        return self.loaded

    @property
    def sha256(self) -> str | None:
        """Hash of a plugin's code, see `code.of_modules`: of the module of its entry, and of that
        which defines its factory. None if it has no file."""
        modules = {self.module, getattr(self.spec.factory, "__module__", None)}
        return code.of_modules(
            frozenset(name for name in modules if name and name.split(".")[0] != OWN)
        )

    @property
    def reason(self) -> str | None:
        """Why it can't be used here, including missing packages; None if it can."""
        if self.fault or self.loaded is None:
            return self.fault
        missing = [name for name in self.loaded.requires if not _importable(name)]
        if not missing:
            return None
        reason = f"needs {' and '.join(missing)}"
        if self.loaded.extra and self.distribution:
            reason += f": pip install '{self.distribution}[{self.loaded.extra}]'"
        return reason


def everything() -> tuple[Choice, ...]:
    """All parts of all kinds, built-in ones first, including unusable ones."""
    return _everything(os.environ.get(VARIABLE, ""))


def names(kind: str) -> list[str]:
    """Names of a kind with a valid spec."""
    return [c.name for c in everything() if c.kind == kind and not c.fault]


def known(kind: str, name: str | None) -> bool:
    """Whether a part of that name exists, usable or not."""
    return any((c.kind, c.name, c.ceded) == (kind, name, False) for c in everything())


def find(kind: str, name: str) -> Choice:
    """The part of that name. Raises `UserError` if it is unknown, failed to load or is refused."""
    for choice in everything():
        if (choice.kind, choice.name, choice.ceded) == (kind, name, False):
            choice.spec  # noqa: B018  raises
            return choice
    raise unknown_name(kind, name, names(kind))


def warn_of_rivals(kind: str, name: str | None) -> None:
    """Warn if a plugin was refused the chosen name, and say what has it."""
    for choice in everything():
        if choice.ceded and (choice.kind, choice.name) == (kind, name):
            warnings.warn(f"{kind}={name}: {choice.fault}.", stacklevel=2)


def used(config: Any) -> list[dict[str, str | None]]:
    """The plugins that a configuration uses, for a run's record: ``kind``, ``name``, ``origin``,
    ``distribution`` and ``version`` (None for those without a package), ``file`` of the spec's
    module, and the ``sha256`` of its code (None if it has no file), see `Choice.sha256`."""

    judge = getattr(getattr(config, "metrics", None), "judge", None)

    def named(kind: str) -> Iterable[str | None]:
        part = getattr(config, kind, None)
        if isinstance(part, Mapping):
            return part
        return (getattr(part, "name", None), judge if kind == "encoder" else None)

    def told(path: Path | None) -> str | None:
        return str(path) if path else None

    return [
        {
            "kind": c.kind,
            "name": c.name,
            "origin": c.origin,
            "distribution": c.distribution,
            "version": c.version,
            "file": told(code.file_of(c.module or "")),
            "sha256": c.sha256,
        }
        for c in everything()
        if c.origin != OWN and not c.fault and c.name in named(c.kind)
    ]


def usable(kind: str, name: str) -> Choice:
    """The part of that name. Raises `UserError` if it can't be used here, e.g. for a missing
    package."""
    choice = find(kind, name)
    if choice.reason:
        raise UserError(f"the {kind} '{name}' can't be used: {choice.reason}.")
    return choice


def build(kind: str, options: Any, **given: Any) -> Any:
    """Build the part named ``options.name``; ``given`` are the arguments of its kind (see `Spec`).

    Raises `UserError` for an unusable name, and for any exception of a plugin's factory.
    """
    name = getattr(options, "name", None)
    if name is None:
        raise UserError(f"no {kind} was chosen: give {kind}=NAME, one of {', '.join(names(kind))}.")
    choice = usable(kind, name)
    try:
        return choice.spec.factory(options, **given)
    except UserError:
        raise
    except Exception as error:
        if choice.origin == OWN:
            raise
        raise UserError(
            f"the {kind} '{name}' of {choice.origin} failed: {_one_line(error)} (debug=true shows "
            "the traceback)."
        ) from error


def load_encoder(
    name: str, *, device: str | torch.device = "cpu", seed: int = 0, **options: Any
) -> Any:
    """Load an encoder; the first use of a pretrained one downloads its weights.

    Args:
        name: a built-in encoder, or a plugin's. There is no silent fallback.
        device: torch device.
        seed: for random encoders only; the global random state is not touched.
        options: fields of its options, such as ``precision="fp32"``; see `EncoderConfig`.

    Raises:
        UserError: unknown name or value; weights that can be neither found nor downloaded.
    """
    chosen = find("encoder", name).spec.config(name=name, **options)
    check({"encoder": chosen})
    return build("encoder", chosen, device=device, seed=seed)


# -------------------------------------------------------------------------------------- discovery


@cache
def _everything(variable: str) -> tuple[Choice, ...]:
    found = [
        Choice(kind, spec.name, OWN, __version__, OWN, spec)
        for kind, about in KINDS.items()
        for spec in about.built_in.values()
    ]
    owners = {(c.kind, c.name): OWN for c in found}
    for kind in ("mesh", "image"):
        for name in assets.names(kind):
            owners.setdefault(("style", name), f"the {kind} of that name (styleexp-assets)")
    plugins = [*_installed(), *_named_by(variable)]
    for plugin in plugins:
        key = plugin.kind, plugin.name
        origins = [each.origin for each in plugins if (each.kind, each.name) == key]
        if key in owners:
            fault = f"{owners[key]} has that name already, so {plugin.origin} can't use it"
            plugin = replace(plugin, fault=fault, error=None, ceded=True)
        elif len(origins) > 1:
            fault = f"{' and '.join(origins)} have the same name: keep only one of them"
            plugin = replace(plugin, fault=fault, error=None)
        found.append(plugin)
    return tuple(found)


def _installed() -> Iterator[Choice]:
    """Plugins of installed distributions. If one is on the path twice, the first counts."""
    seen = set()
    for distribution in importlib.metadata.distributions():
        try:
            text = distribution.read_text("entry_points.txt") or ""
        except Exception:  # may be any distribution, with any fault
            continue
        if "[styleexp." not in text:
            continue
        name = version = None
        try:
            name, version = distribution.name, distribution.version
            if name in seen:
                continue
            seen.add(name)
            points = [p for p in distribution.entry_points if p.group.startswith("styleexp.")]
        except Exception as error:
            fault = f"its entry points can't be read: {_one_line(error)}"
            yield Choice("?", name or "?", name or "?", version, fault=fault, error=error)
            continue
        for point in points:
            origin = f"{name} ({point.value})"
            kinds = [kind for kind, about in KINDS.items() if about.group == point.group]
            if kinds:
                known = Choice(
                    kinds[0], point.name, origin, version, name, module=_module(point.value)
                )
                yield _load(known, point.name, point.load)
            else:
                fault = str(unknown_name("group", point.group, (k.group for k in KINDS.values())))
                yield Choice(
                    point.group, point.name, origin, version, name, fault=fault.rstrip(".")
                )


def _named_by(variable: str) -> Iterator[Choice]:
    """Plugins named by `VARIABLE`. The user set it on purpose, so failures are reported at once."""
    if variable and os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # as ``python -m`` does; scripts don't have it
    for item in re.split(r"[,\s]+", variable.strip()) if variable.strip() else ():
        kind, _, value = item.partition("=")
        module, _, attribute = value.partition(":")
        origin = f"{VARIABLE} ({item})"
        if kind not in KINDS or not module or not attribute:
            fault = f"'{item}' is not KIND=MODULE:SPEC with KIND one of {', '.join(KINDS)}"
            choice = Choice(kind if kind in KINDS else "?", item, origin, fault=fault)
        else:
            known = Choice(kind, origin, origin, module=module)
            choice = _load(known, None, partial(_attribute, module, attribute))
        if choice.fault:
            warnings.warn(f"{VARIABLE}: {choice.fault}.", stacklevel=2)
        yield choice


def _module(value: str) -> str:
    """The module of an entry point, ``module:attribute [extras]``."""
    return re.split(r"[:\s\[]", value.strip())[0]


def _attribute(module: str, path: str) -> object:
    found: object = importlib.import_module(module)
    for part in path.split("."):
        found = getattr(found, part)
    return found


def _load(choice: Choice, name: str | None, load: Callable[[], object]) -> Choice:
    """Load and check a choice's spec; with ``name`` None, use the spec's own name."""
    try:
        with redirect_stdout(sys.stderr):  # keep its output out of --json
            spec = load()
            fault = _fault(choice.kind, name, spec)
    except (Exception, SystemExit) as error:
        fault = f"{choice.origin} can't be loaded: {_one_line(error)}"
        return replace(choice, fault=fault, error=error)
    if fault:
        return replace(choice, fault=f"{choice.origin} {fault}")
    assert isinstance(spec, Spec)
    return replace(choice, name=spec.name, loaded=spec)


def _fault(kind: str, name: str | None, spec: object) -> str | None:
    """What is wrong with a plugin's spec; None if it is valid."""
    if not isinstance(spec, Spec):
        return f"is of type {type(spec).__name__}, not styleexp.plugins.spec.Spec"
    if not re.fullmatch(r"\w[\w-]*", spec.name):
        return f"has the name '{spec.name}': use letters, digits, _ and - only"
    if name is not None and spec.name != name:
        return f"is named '{spec.name}', but its entry point is '{name}'"
    config, base = spec.config, KINDS[kind].base
    if not (isinstance(config, type) and is_dataclass(config)):
        return "has a config that is not a dataclass"
    if base is not None and not issubclass(config, base):
        return f"has the config {config.__name__}, which does not derive from {base.__name__}"
    if "name" not in {each.name for each in fields(config)}:
        return f"has the config {config.__name__}, which lacks the field 'name'"
    from omegaconf import OmegaConf

    OmegaConf.structured(spec.config(name=spec.name))  # raises where Hydra would
    return None


def _importable(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except (ImportError, ValueError):
        return False


def _one_line(error: BaseException) -> str:
    """The error on one line."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return f"{type(error).__name__}: {': '.join(lines)}" if lines else type(error).__name__
