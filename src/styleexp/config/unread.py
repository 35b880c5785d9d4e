"""Overrides that have no effect, because the chosen method doesn't read them.

A baseline's `Spec` lists the keys it reads. The learned methods read every key.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import fields
from importlib import resources
from typing import TYPE_CHECKING, Any

from styleexp import plugins
from styleexp.config.schema import Config

if TYPE_CHECKING:
    from styleexp.plugins.spec import Spec

EVERY_RUN = (
    "source", "style", "baseline", "optim.seed", "preview", "metrics", "logger", "report",
    "formats", "simplify", "keep_checkpoint", "strength", "device", "threads", "debug",
)  # fmt: skip
"""Keys that every method reads."""
FOR_RENDERS = ("style.image_contrast", "style.image_match_mean")
"""Keys of ``style`` that are only read to compare an image with renders."""
PARTS = ("renderer", "encoder", "field", "loss")
"""Keys that also select a part."""


def note(configs: Iterable[Config], given: Sequence[str]) -> str | None:
    """One sentence on the given overrides that have no effect in any of these runs; None if there
    are none."""
    specs = {}
    idle = list(given)
    for config in configs:
        spec = _baseline(config)
        if spec is None or spec.reads is None:
            return None
        specs[spec.name] = spec
        read = (*EVERY_RUN, *spec.reads, *(["renderer"] * (config.preview.name == "pyrender")))
        idle = [each for each in idle if _is_unread(each, read)]
    if not specs or not idle:
        return None
    text = f"{', '.join(idle)} {'has' if len(idle) == 1 else 'have'} no effect on the result"
    text += f" with method={' or '.join(specs)}"
    if any(_covers(key, "optim.steps") for spec in specs.values() for key in spec.reads or ()):
        return f"{text}."
    return f"{text}, which neither renders nor learns: add method=robust to learn."


def _baseline(config: Config) -> Spec | None:
    name = getattr(config.baseline, "name", None)
    return None if name is None else plugins.find("baseline", name).spec


def _is_unread(override: str, read: Sequence[str]) -> bool:
    """Whether an override sets keys of the configuration, but none that is ``read``."""
    found = re.match(r"[+~]*([\w./-]+)(?:@[^=]*)?(?:=(.*))?", override, re.DOTALL)
    keys = _keys(found[1], found[2] or "") if found else []
    return bool(keys) and not any(
        _covers(known, key) or _covers(key, known)
        for key in keys
        if key not in FOR_RENDERS
        for known in read
    )


def _covers(key: str, other: str) -> bool:
    return f"{other}.".startswith(f"{key}.")


def _keys(key: str, value: str) -> list[str]:
    """Keys that an override sets; empty if it selects whole presets, as ``method`` does."""
    if key in PARTS:
        return [f"{key}.name"]
    if key.split(".")[0] in {each.name for each in fields(Config)}:
        return [key]
    presets = [_keys_of_preset(key, each.strip()) for each in value.split(",")]
    return [each for keys in presets for each in keys] if all(presets) else []


def _keys_of_preset(group: str, name: str) -> list[str]:
    """Keys that a file of ``conf`` sets, such as ``profile/fast.yaml``; empty if it selects other
    files, or sweeps."""
    from omegaconf import OmegaConf

    from styleexp.system.options import flatten

    if not (re.fullmatch(r"\w+", group) and re.fullmatch(r"\w+", name)):
        return []
    path = resources.files("styleexp.conf").joinpath(group, f"{name}.yaml")
    if not path.is_file():
        return []
    text = path.read_text(encoding="utf-8")
    content: Any = OmegaConf.to_container(OmegaConf.create(text))
    if "defaults" in content or "hydra" in content:
        return []
    package = re.match(r"# @package (\w+)", text)
    prefix = "" if package is None or package[1] == "_global_" else f"{package[1]}."
    return list(flatten(content, prefix))
