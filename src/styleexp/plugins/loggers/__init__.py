"""Loggers: send a run's numbers to other tools. ``metrics.jsonl`` is always written.

``logger=tensorboard``, ``logger=mlflow``, ``'logger=[tensorboard,mlflow]'``. A logger can't change
a run, so it doesn't affect job keys, and one that fails is dropped with a warning.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from styleexp.config.schema import Config
    from styleexp.method.base import Result, Step


class Logger(Protocol):
    """Logger of one run, created when the run starts or resumes."""

    def log(self, values: Mapping[str, float], step: int) -> None:
        """Log the numbers of a step, named as in ``metrics.jsonl``."""
        ...

    def finish(self, result: Result, folder: Path) -> None:
        """Log the finished run; its pictures, mesh and page are in ``folder``."""
        ...

    def close(self, status: str) -> None:
        """End the log. ``status`` is "done", "interrupted" or "failed". Always called exactly
        once."""
        ...


class Loggers:
    """All loggers of a run, as a context manager. A logger that raises is dropped with a
    warning."""

    def __init__(self, config: Config, folder: Path, record: Mapping[str, Any], step: int):
        """``step`` is the step that the run continues from; later steps are logged again.

        Raises `UserError` if a logger can't start; nothing has been computed yet.
        """
        from styleexp import plugins

        self.ended = "failed"
        """The run's status when the context ends: "done", "interrupted" or "failed"."""
        self._loggers: dict[str, Logger] = {}
        for name, options in config.logger.items():
            built = plugins.build("logger", options, folder=folder, record=record, step=step)
            self._loggers[name] = built

    def step(self, step: Step) -> None:
        """Log a step's measurements."""
        values = {key: value for key, value in asdict(step).items() if key != "step"}
        self._each(lambda logger: logger.log(values, step.step))

    def finish(self, result: Result, folder: Path, metrics: Mapping[str, float], step: int) -> None:
        """Log the result; ``metrics`` are those of ``metrics.json``, logged as ``final/…``."""
        final = {f"final/{k}": float(v) for k, v in metrics.items() if isinstance(v, int | float)}
        self._each(lambda logger: logger.log(final, step))
        self._each(lambda logger: logger.finish(result, folder))
        self.ended = "done"

    def __enter__(self) -> Loggers:
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        if kind is not None:
            self.ended = "interrupted" if kind is KeyboardInterrupt else "failed"
        self._each(lambda logger: logger.close(self.ended))

    def _each(self, tell: Callable[[Logger], None]) -> None:
        for name, logger in list(self._loggers.items()):
            try:
                tell(logger)
            except Exception as error:
                del self._loggers[name]
                reason = " ".join(str(error).split()) or type(error).__name__
                warnings.warn(
                    f"the logger '{name}' failed ({reason}); the run continues, and metrics.jsonl "
                    "is complete.",
                    stacklevel=2,
                )
