"""``logger=mlflow``."""

from __future__ import annotations

import json
import logging
import os
import shlex
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from filelock import FileLock

from styleexp.system import atomic
from styleexp.system.errors import UserError

# Read when MLflow is imported; disables usage tracking.
os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")

from mlflow import MlflowClient
from mlflow.entities import Metric, Param, RunTag
from mlflow.exceptions import MlflowException
from sqlalchemy.exc import SQLAlchemyError

if TYPE_CHECKING:
    from styleexp.method.base import Result
    from styleexp.plugins.loggers.options import MLflowConfig

SQLITE = "sqlite:///"
KEPT = "mlflow.json"
"""File in the run's folder that holds the MLflow run ID."""
FILES = ("run.json", "metrics.json", "preview.png", "result.glb", "report.html")
"""Files that are logged as artifacts, if they exist."""
BATCH = 25
"""Steps per batch; one transaction per step would take as long as a small step."""
STATUS = {"done": "FINISHED", "interrupted": "KILLED", "failed": "FAILED"}


class MLflow:
    """An MLflow run, which a resumed run continues."""

    def __init__(self, config: MLflowConfig, folder: Path, record: Mapping[str, Any], step: int):
        for noisy in ("alembic", "mlflow"):  # hide the store's set-up messages
            logging.getLogger(noisy).setLevel(logging.WARNING)
        kept = folder / KEPT
        before = json.loads(kept.read_text("utf-8")) if step and kept.is_file() else None
        uri = before["uri"] if before else _absolute(config.uri)
        try:
            with _alone(uri) as files:
                self._client = MlflowClient(uri)
                self._run = before["run_id"] if before else self._begin(config, folder, files)
            if before:
                self._client.update_run(self._run, status="RUNNING")
            else:
                self._describe(folder, record)
        except (MlflowException, SQLAlchemyError, OSError) as error:
            reason = " ".join(str(error).split())[:200]
            raise UserError(
                f"the MLflow store '{uri}' can't be used ({reason}): choose another one with "
                "logger.mlflow.uri=URI."
            ) from error
        atomic.write(kept, atomic.text(json.dumps({"uri": uri, "run_id": self._run}) + "\n"))
        self._told = self._last_step() if before else 0
        self._waiting: list[Metric] = []
        self._steps = 0

    def _begin(self, config: MLflowConfig, folder: Path, files: str | None) -> str:
        found = self._client.get_experiment_by_name(config.experiment)
        if found:
            experiment = found.experiment_id
        else:
            experiment = self._client.create_experiment(config.experiment, files)
        name = f"{folder.absolute().parent.name}/{folder.name}"
        return str(self._client.create_run(experiment, run_name=name).info.run_id)

    def _describe(self, folder: Path, record: Mapping[str, Any]) -> None:
        params = [Param(key, str(value)[:6000]) for key, value in _flat(record["config"])]
        for start in range(0, len(params), 100):  # as many as MLflow takes at once
            self._client.log_batch(self._run, params=params[start : start + 100])
        tags = {
            "folder": folder.absolute(),
            "command": shlex.join(record["command"])[:5000],
            "version": record["versions"]["styleexp"],
        }
        made = [RunTag(f"styleexp.{key}", str(value)) for key, value in tags.items()]
        self._client.log_batch(self._run, tags=made)

    def _last_step(self) -> int:
        """Last logged step. MLflow can't delete steps, so known ones aren't logged again."""
        history = self._client.get_metric_history(self._run, "loss")
        return max((each.step for each in history), default=0)

    def log(self, values: Mapping[str, float], step: int) -> None:
        """Log one metric per number."""
        if "loss" in values and step <= self._told:
            return
        now = int(time.time() * 1000)
        self._waiting += [Metric(key, value, now, step) for key, value in values.items()]
        self._steps += 1
        if self._steps % BATCH == 0:
            self._flush()

    def _flush(self) -> None:
        for start in range(0, len(self._waiting), 1000):  # as many as MLflow takes at once
            self._client.log_batch(self._run, metrics=self._waiting[start : start + 1000])
        self._waiting = []

    def finish(self, result: Result, folder: Path) -> None:
        """Log the result and its pictures as artifacts."""
        for name in FILES:
            if (folder / name).is_file():
                self._client.log_artifact(self._run, str(folder / name))

    def close(self, status: str) -> None:
        """Set the run's status."""
        self._flush()
        self._client.set_terminated(self._run, STATUS[status])


def _absolute(uri: str) -> str:
    """Make a local file's URI absolute, so that the run can be resumed from any folder."""
    if not uri.startswith(SQLITE):
        return uri
    return f"{SQLITE}{Path(uri.removeprefix(SQLITE)).absolute()}"


@contextmanager
def _alone(uri: str) -> Iterator[str | None]:
    """Yield the artifact location of a local store, while holding its lock: jobs of a sweep start
    together, and only one of them may create the tables."""
    if not uri.startswith(SQLITE):
        yield None
        return
    file = Path(uri.removeprefix(SQLITE))
    file.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(file.with_name(f".{file.name}.lock")):
        yield (file.parent / "mlflow-files").as_uri()


def _flat(config: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in config.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
