"""Options of the built-in loggers. Imports nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass


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
