"""One run's folder as a flat row. Needs only the standard library."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from styleexp.runs import identity
from styleexp.runs.schema import too_new
from styleexp.system import locks

if TYPE_CHECKING:
    from styleexp.experiments.sweeps.jobs import Job

FINAL_SHARE = 10
"""Inverse fraction of the steps that the final loss averages: the last tenth."""


def read(folder: Path) -> dict[str, Any]:
    """A run as a flat row: ``status``, ``seconds``, ``reason``, ``loss``, ``metric.*``,
    ``config.*``, ``version.*``, ``device``, ``asset.*`` (sha256, or the name if there is no file).

    ``status`` is the run's own (see ``RunFolder.write_status``), ``missing`` if there is none,
    ``died`` if it says running but there is no process, ``newer`` if a later version of styleexp
    wrote it. Never raises: unreadable files are skipped, and ``reason`` says so.
    """
    faults: list[str] = []
    told = _json(folder / "status.json", faults)
    record = _json(folder / "run.json", faults)
    metrics = _json(folder / "metrics.json", faults)
    row: dict[str, Any] = {
        "status": told.get("status", "unreadable" if faults else "missing"),
        "seconds": told.get("seconds"),
        "device": record.get("device"),
        "loss": _final_loss(folder / "metrics.jsonl"),
    }
    if newer := too_new(record) or too_new(told):
        return {**row, "status": "newer", "reason": newer}
    if row["status"] == "running" and not locks.held(folder):
        row["status"] = "died"
    row["reason"] = "; ".join([*filter(None, [told.get("reason")]), *faults]) or None
    row |= {f"metric.{name}": value for name, value in metrics.items() if _plain(value)}
    row |= {f"config.{key}": value for key, value in _flat(record.get("config") or {})}
    row |= {f"version.{name}": v for name, v in (record.get("versions") or {}).items()}
    for role, asset in (record.get("assets") or {}).items():
        row[f"asset.{role}"] = asset.get("sha256") or asset.get("name")
    return row


def of_job(job: Job) -> dict[str, Any]:
    """The row of a job's run, if its folder contains it.

    ``status`` is ``other`` if the folder contains another run, whose numbers are omitted, and
    ``unreadable`` if an ended run has no record that identifies it.
    """
    record = _json(job.folder / "run.json", [])
    row = read(job.folder)
    bare = {**dict.fromkeys(("status", "seconds", "device", "loss")), "reason": row["reason"]}
    if row["status"] == "newer":
        return row
    if not record:
        known = row["status"] if row["status"] != "done" else "unreadable"
        told = row["reason"] or "it has no run.json" if known == "unreadable" else row["reason"]
        return {**bare, "status": known, "reason": told}
    if told := identity.not_of(job.key, job.overrides, record):
        return {**bare, "status": "other", "reason": told}
    return row


def status(folder: Path) -> str | None:
    """A run's status as written; None if missing or unreadable."""
    return _json(folder / "status.json", []).get("status")


def steps(folder: Path) -> int:
    """Number of steps in a run's metrics."""
    try:
        return (folder / "metrics.jsonl").read_bytes().count(b"\n")
    except OSError:
        return 0


def _json(path: Path, faults: list[str]) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        faults.append(f"{path.name} can't be read ({error})")
        return {}
    if not isinstance(content, dict):
        faults.append(f"{path.name} can't be read (it holds no object)")
        return {}
    return content


def _flat(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield dotted keys and values; lists as JSON, so that each column has one type."""
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield prefix + key, json.dumps(value) if isinstance(value, list) else value


def _plain(value: Any) -> bool:
    return isinstance(value, int | float | str) or value is None


def _final_loss(path: Path) -> float | None:
    """Mean loss of the last tenth of the steps, without truncated lines."""
    losses = []
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError):
        return None
    last = lines[-max(1, len(lines) // FINAL_SHARE) :]
    for line in last:
        try:
            losses.append(float(json.loads(line)["loss"]))
        except (ValueError, KeyError, TypeError):
            continue
    return sum(losses) / len(losses) if losses else None
