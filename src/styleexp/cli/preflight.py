"""Checks that run before a run's folder is created."""

from __future__ import annotations

from typing import Any

from hydra.experimental.callback import Callback


class Preflight(Callback):
    """Reject invalid values and missing files before anything is written or torch is imported."""

    def on_run_start(self, config: Any, **kwargs: Any) -> None:
        """Called by Hydra for a single run. Hydra swallows any exception except `SystemExit`."""
        from omegaconf import OmegaConf

        from styleexp.cli.main import stop
        from styleexp.config import checks, compose, sources
        from styleexp.system.errors import UserError

        try:
            ours = [key for key in config if key != "hydra"]  # its values aren't resolvable yet
            typed = compose.typed(OmegaConf.masked_copy(config, ours))
            checks.check(typed)
            sources.check(typed)
        except UserError as error:
            stop(error)
