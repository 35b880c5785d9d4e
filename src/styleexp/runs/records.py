"""Write a run's folder: status, record, metrics and checkpoints.

Every file is written atomically, except ``metrics.jsonl``, which grows by one line per step.
"""

from __future__ import annotations

import copy
import importlib.metadata
import json
import os
import platform
import shutil
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from styleexp import plugins
from styleexp.plugins import code
from styleexp.runs import identity, provenance, reading
from styleexp.runs.schema import SCHEMA
from styleexp.system import atomic, digests

if TYPE_CHECKING:
    from styleexp.method.base import State, Step
    from styleexp.runs.provenance import Difference

FILES = (
    "status.json",
    "metrics.jsonl",
    "checkpoint.safetensors",
    "checkpoint.previous.safetensors",
    "checkpoint.damaged.safetensors",
    "result.ply",
    "result.obj",
    "result.glb",
    "result.stl",
    "result.3mf",
    "preview.png",
    "turntable.gif",
    "direction.png",
    "check.png",
    "check.gif",
    "check.json",
    "metrics.json",
    "trial.json",
    "report.html",
    "mlflow.json",
    "run.json",
)
"""Files that a run may leave in its folder. The record, which marks a run's folder, is last."""

PACKAGES = (
    "styleexp",
    "torch",
    "numpy",
    "trimesh",
    "hydra-core",
    "omegaconf",
    "safetensors",
    "scipy",
    "gpytoolbox",
    "pillow",
    "mitsuba",
)
"""Packages whose versions are recorded."""

VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment variables that a result's last bits depend on: with other numbers of threads, numpy's
products are summed in another order. (``threads`` is about torch.)"""


@dataclass
class RunFolder:
    """Reads and writes one run's files."""

    path: Path
    begun: bool = False
    """Whether the folder's content belongs to this process's run."""

    @property
    def checkpoint(self) -> Path:
        """The latest checkpoint."""
        return self.path / "checkpoint.safetensors"

    @property
    def metrics(self) -> Path:
        """One JSON line per step."""
        return self.path / "metrics.jsonl"

    def write_status(self, status: str, **more: Any) -> None:
        """Write ``status.json``: "running", "done", "interrupted", "pruned" or
        "failed", with the reason."""
        self.write_json("status.json", {"schema": SCHEMA, "status": status, "time": now(), **more})

    def write_json(self, name: str, content: Mapping[str, Any]) -> None:
        """Write a JSON file atomically."""
        self.write(name, atomic.text(json.dumps(content, indent=2, default=str) + "\n"))

    def write(self, name: str, writer: Callable[[Path], Any]) -> Path:
        """Let ``writer`` write a file, atomically."""
        return atomic.write(self.path / name, writer)

    def unfinished(self, record: Mapping[str, Any]) -> dict[str, Any] | None:
        """The record of this folder's run, if it is the same run as ``record`` and not done.

        Raises `UserError` for a run of a later version, which must not be overwritten.
        """
        run = reading.readable(self.path, "run in")
        if run.last_status in (None, "done") or identity.of(run.record) != record["key"]:
            return None
        return run.record

    def begin(self, record: Mapping[str, Any] | None) -> None:
        """Mark the folder as running: a new run with this record, or (None) the previous one."""
        if record is not None:
            self.clear()
        self.write_status("running")
        if record is not None:
            self.write_json("run.json", record)
        self.begun = True

    def clear(self) -> None:
        """Remove an earlier run's files, so that they aren't mistaken for the next run's."""
        if (self.path / "run.json").exists():
            for name in FILES:
                (self.path / name).unlink(missing_ok=True)
            shutil.rmtree(self.path / "tensorboard", ignore_errors=True)

    def forget(self) -> None:
        """Remove the checkpoints, to restart the run."""
        for path in (self.checkpoint, self.path / "checkpoint.previous.safetensors"):
            with suppress(OSError):
                path.unlink()

    def check(self) -> None:
        """Raise ``FileNotFoundError`` if the run's files were removed while it was running."""
        for name in ("run.json", "result.ply"):
            (self.path / name).stat()

    def append_metrics(self, step: Step) -> None:
        """Append a step's line. Raises ``FileNotFoundError`` if earlier lines were removed."""
        create = os.O_CREAT if step.step == 1 else 0
        descriptor = os.open(self.metrics, os.O_WRONLY | os.O_APPEND | create, 0o666)
        with open(descriptor, "a", encoding="utf-8") as lines:
            lines.write(json.dumps(asdict(step)) + "\n")

    def begin_metrics(self, step: int) -> int:
        """Keep the lines of steps up to ``step``; a resumed run writes the others again.

        Returns the number of missing lines.
        """
        if not step:
            self.metrics.unlink(missing_ok=True)
            return 0
        kept: dict[int, bytes] = {}
        old = self.metrics.read_bytes() if self.metrics.exists() else b""
        for line in old.split(b"\n"):
            try:
                found = json.loads(line)["step"]
            except (ValueError, KeyError, TypeError):
                continue  # a line cut off by the interruption
            if isinstance(found, int) and 0 < found <= step:
                kept[found] = line + b"\n"
        self.write("metrics.jsonl", atomic.data(b"".join(kept[n] for n in sorted(kept))))
        return step - len(kept)

    def save_checkpoint(self, state: State) -> None:
        """Save field, optimiser and step in one safetensors file, and keep the previous one."""
        from safetensors.torch import save

        tensors = {f"field.{k}": v.contiguous() for k, v in state.field.state_dict().items()}
        for index, slots in state.optimizer.state_dict()["state"].items():
            tensors |= {f"adam.{index}.{k}": v.contiguous() for k, v in slots.items()}
        step = str(state.step)
        metadata = {"schema": str(SCHEMA), "step": step, "digest": digests.of(tensors, step)}
        content = save(tensors, metadata=metadata)
        self._sync_metrics()
        if self.checkpoint.exists():
            os.replace(self.checkpoint, self.path / "checkpoint.previous.safetensors")
        self.write("checkpoint.safetensors", atomic.data(content))

    def _sync_metrics(self) -> None:
        """Sync the metrics, so that a checkpoint on disk implies that the lines of its steps are
        too."""
        with suppress(FileNotFoundError), open(self.metrics, "rb") as lines:
            os.fsync(lines.fileno())

    def checkpoint_step(self) -> int | None:
        """Step of the latest checkpoint; None if there is no readable one."""
        from safetensors import safe_open

        try:
            with safe_open(self.checkpoint, framework="pt") as opened:
                return int(opened.metadata()["step"])
        except Exception:  # safetensors raises several kinds
            return None

    def load_checkpoint(self, state: State) -> str | None:
        """Load the latest intact checkpoint into ``state``; return a message for the user.

        A damaged checkpoint is set aside and the previous one is used. Without any, ``state`` stays
        at step 0.
        """
        begun, damaged = copy.deepcopy(state.field.state_dict()), []
        for path in (self.checkpoint, self.path / "checkpoint.previous.safetensors"):
            if not path.exists():
                continue
            try:
                _restore(path, state)
                break
            except Exception as damage:  # safetensors raises several kinds
                state.field.load_state_dict(begun)
                damaged.append(f"{path} is damaged ({first_line(damage)})")
                if path == self.checkpoint:  # the next save must not overwrite the good one
                    os.replace(path, self.path / "checkpoint.damaged.safetensors")
        if not damaged:
            return None
        used = "using the previous checkpoint" if state.step else "restarting the run"
        return f"{', and '.join(damaged)}; {used}."


def first_line(error: BaseException) -> str:
    """An exception's message on one line."""
    return (str(error).strip().splitlines() or [""])[0] or type(error).__name__


def _restore(path: Path, state: State) -> None:
    from safetensors import safe_open

    with safe_open(path, framework="pt") as opened:
        metadata = opened.metadata()
        step = int(metadata["step"])
        tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    # Checkpoints of early versions have no digest.
    if metadata.get("digest", "") not in ("", digests.of(tensors, metadata["step"])):
        raise ValueError("its content does not match its digest")
    device = next(state.field.parameters()).device
    weights = {k[6:]: v.to(device) for k, v in tensors.items() if k.startswith("field.")}
    slots: dict[int, dict[str, Any]] = {}
    for name, tensor in tensors.items():
        if name.startswith("adam."):
            _, index, key = name.split(".")
            slots.setdefault(int(index), {})[key] = tensor
    groups = state.optimizer.state_dict()["param_groups"]
    state.field.load_state_dict(weights)
    state.optimizer.load_state_dict({"state": slots, "param_groups": groups})
    state.step = step


def describe(config: Any, overrides: list[str], command: list[str]) -> dict[str, Any]:
    """Everything needed to reproduce a run, except for what the run itself determines."""
    return {
        "schema": SCHEMA,
        "key": identity.job_key(config),
        "started": now(),
        "command": command,
        "overrides": overrides,
        "config": asdict(config),
        **environment(config),
    }


def environment(config: Any) -> dict[str, Any]:
    """What a run is made with, for its record: ``versions`` of packages, ``code`` of this package
    (`plugins.code.own`), ``plugins`` (`plugins.used`), and the ``platform`` with `VARIABLES`."""
    variables = {name: os.environ.get(name, "not set") for name in VARIABLES}
    return {
        "versions": {"python": platform.python_version(), **_versions()},
        "code": code.own(),
        "plugins": plugins.used(config),
        "platform": {"system": platform.platform(), "machine": platform.machine(), **variables},
    }


def _versions() -> dict[str, str | None]:
    found: dict[str, str | None] = {}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = None
    return found


def resumed(record: Mapping[str, Any], config: Any) -> tuple[dict[str, Any], list[Difference]]:
    """The record of a run that goes on, and what it is now made with that it wasn't before.

    Each time is kept under ``resumed``, with what differs from the run's beginning.
    """
    apart = provenance.differences(record, environment(config))
    if not apart:
        return dict(record), apart
    told = {"time": now(), "differs": {each.name: [each.then, each.now] for each in apart}}
    return {**record, "resumed": [*(record.get("resumed") or ()), told]}, apart


def now() -> str:
    """Current time, UTC, ISO 8601."""
    return datetime.now(UTC).isoformat(timespec="seconds")
