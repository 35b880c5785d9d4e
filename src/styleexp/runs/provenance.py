"""What a run was made with, and what of it differs from another run, or from this process.

Records are compared as far as both tell: those of earlier versions lack some of it. Needs only the
standard library.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

DIGITS = 12
"""Number of hex digits shown of a hash."""


class Difference(NamedTuple):
    """One thing that isn't as it was."""

    name: str
    then: str
    now: str

    def __str__(self) -> str:
        return f"{self.name} {self.then} (now {self.now})"


def differences(then: Mapping[str, Any], now: Mapping[str, Any]) -> list[Difference]:
    """What differs between two records, of what `made_with` tells of both."""
    before, after = made_with(then), made_with(now)
    return [
        Difference(name, before[name], after[name])
        for name in before
        if name in after and before[name] != after[name]
    ]


def made_with(record: Mapping[str, Any]) -> dict[str, str]:
    """A record's versions of packages, the commit and code of this package, each plugin with its
    version and code, encoders' weights, device, threads and machine, by their names, for people."""
    found = {
        name: str(version or "not installed")
        for name, version in (record.get("versions") or {}).items()
    }
    found |= _code(record.get("code") or {})
    for each in record.get("plugins") or ():
        told = [each.get("distribution"), each.get("version"), _short(each.get("sha256"))]
        kept = [text for text in told if text]
        found[f"plugin {each.get('kind')}={each.get('name')}"] = " ".join(kept) or "unknown code"
    for name, file in (record.get("weights") or {}).items():
        found[f"weights {name}"] = _short(file.get("sha256")) or "unknown"
    for name, key in (("device", "device"), ("precision", "encoder_precision")):
        if record.get(key):
            found[name] = str(record[key])
    if isinstance(gpu := record.get("gpu"), dict) and "name" in gpu:
        found["GPU"] = str(gpu["name"])
    if record.get("threads"):
        found["threads"] = str(record["threads"])
    return found | {name: str(value) for name, value in (record.get("platform") or {}).items()}


def resumptions(record: Mapping[str, Any]) -> list[str]:
    """One sentence for each time that a run went on with something else than it began with."""
    told = []
    for each in record.get("resumed") or ():
        apart = (f"{name} {then} (then {now})" for name, (then, now) in each["differs"].items())
        told.append(f"Resumed at {each['time']} with other parts than it began with: "
                    f"{', '.join(apart)}.")  # fmt: skip
    return told


def _code(code: Mapping[str, Any]) -> dict[str, str]:
    found = {}
    if code.get("commit"):
        state = {"True": " with changes", "False": ""}
        told = state.get(str(code.get("dirty")), ", changes unknown")
        found["commit"] = _short(code["commit"]) + told
    if code.get("sha256"):
        found["code of styleexp"] = _short(code["sha256"])
    return found


def _short(digest: Any) -> str:
    return str(digest or "")[:DIGITS]
