"""Plans: which experiments, with which seeds and sizes, in which order."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from styleexp.sweeps.jobs import product


def experiment_jobs(overrides: Sequence[str]) -> list[list[str]]:
    """The jobs that ``styleexp -m`` makes of these overrides, as lists of overrides."""
    import hydra
    from hydra.core.global_hydra import GlobalHydra
    from hydra.types import RunMode

    from styleexp import compose

    compose.register()
    with hydra.initialize_config_module("styleexp.conf", version_base="1.3"):
        composed: Any = GlobalHydra.instance().hydra
        config = composed.compose_config(
            "config", list(overrides), run_mode=RunMode.MULTIRUN, from_shell=False
        )
        return product(config.hydra.sweeper.params, overrides)
