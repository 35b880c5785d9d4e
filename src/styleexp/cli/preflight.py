"""What is checked of a run before its folder is made."""

from __future__ import annotations

from typing import Any

from hydra.experimental.callback import Callback


class Preflight(Callback):
    """Refuse values without a meaning and files that aren't there before anything is written, and
    before torch is loaded."""

    def on_run_start(self, config: Any, **kwargs: Any) -> None:
        """Called by Hydra for a single run; what it raises but `SystemExit` Hydra would swallow."""
        from omegaconf import OmegaConf

        from styleexp import compose, sources
        from styleexp import config as schema
        from styleexp.cli.main import stop
        from styleexp.errors import UserError

        try:
            ours = [key for key in config if key != "hydra"]  # whose values a run doesn't have yet
            typed = compose.typed(OmegaConf.masked_copy(config, ours))
            schema.check(typed)
            sources.check(typed)
        except UserError as error:
            stop(error)
