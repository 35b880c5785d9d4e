"""The built-in loggers, by name. Imports none of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from styleexp.plugins.spec import Spec

if TYPE_CHECKING:
    from styleexp.runs.loggers import Logger


@dataclass
class TensorBoardConfig:
    """Event files in the run's subfolder ``tensorboard``; view with ``tensorboard --logdir
    outputs``."""

    name: str = "tensorboard"
    mesh: bool = True
    """Log source and result as interactive meshes: about 0.8 MB for 20 000 faces."""


@dataclass
class MLflowConfig:
    """A run of an MLflow experiment."""

    name: str = "mlflow"
    uri: str = "sqlite:///outputs/mlflow.db"
    """URI of the tracking store. ``sqlite:///FILE`` is a local file, created if needed, with
    artifacts in the folder ``mlflow-files`` next to it. Any other URI is passed to MLflow, such as
    a server's ``http://…``."""
    experiment: str = "styleexp"


def _tensorboard(
    config: TensorBoardConfig, *, folder: Path, record: Mapping[str, Any], step: int
) -> Logger:
    from styleexp.runs.loggers.tensorboard import TensorBoard

    return TensorBoard(config, folder, record, step)


def _mlflow(config: MLflowConfig, *, folder: Path, record: Mapping[str, Any], step: int) -> Logger:
    from styleexp.runs.loggers.mlflow import MLflow

    return MLflow(config, folder, record, step)


LOGGERS = {
    "tensorboard": Spec(
        "tensorboard",
        "scalars, pictures and meshes as TensorBoard event files",
        TensorBoardConfig,
        _tensorboard,
        requires=("tensorboard",),
        extra="tensorboard",
    ),
    "mlflow": Spec(
        "mlflow",
        "parameters, metrics and files in MLflow, by default in a local SQLite file",
        MLflowConfig,
        _mlflow,
        requires=("mlflow", "sqlalchemy", "alembic"),
        extra="mlflow",
    ),
}
