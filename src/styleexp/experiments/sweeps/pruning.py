"""Stop a search's hopeless trials early: see ``conf/search``.

Hydra's sweeper keeps its study in its own memory and learns of a trial at its end, so a trial asks
the folders of the earlier ones. These stay when a search is killed, and any process can read them.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from styleexp.experiments.sweeps import objective
from styleexp.runs import reading, untrusted
from styleexp.runs.records import RunFolder
from styleexp.system.errors import UserError

AT, AFTER = "STYLEEXP_PRUNE_AT", "STYLEEXP_PRUNE_AFTER"
"""Environment variables with the shares of a run's steps after which it is judged, and with the
number of finished trials that it takes to judge; ``conf/search`` sets them for each job."""


@dataclass(frozen=True)
class Trial:
    """A trial of a search that judges itself by the trials of earlier batches. Those have ended, so
    that the verdict doesn't depend on how fast the trials of its own batch are."""

    folder: Path
    batch: int
    """Number of trials that the search starts together."""
    shares: tuple[float, ...]
    after: int

    def due(self, step: int, total: int) -> bool:
        """Whether to judge after this step of ``total``."""
        return step < total and step in (max(1, round(share * total)) for share in self.shares)

    def verdict(self, step: int, measured: Mapping[str, float]) -> str | None:
        """Note what was measured after a step; the reason if the trial is hopeless.

        The rule is Optuna's ``MedianPruner``: a trial is pruned if its best score so far is below
        the median of the finished trials' scores after the same step. The search is told its score,
        or that of the worst finished trial if that is less: Optuna, too, ranks a pruned trial below
        every finished one.
        """
        scores = {**_scores(objective.noted(self.folder)), step: objective.score(measured)}
        finished = [
            (objective.objective(folder), _scores(notes))
            for folder in self._earlier()
            if reading.read(folder).status == "done"
            and "told" not in (notes := objective.noted(folder))
        ]
        there = [theirs[step] for _, theirs in finished if step in theirs]
        best = max(scores.values())
        hopeless = len(finished) >= self.after and bool(there) and best < median(there)
        noted: dict[str, Any] = {"scores": scores}
        if hopeless:
            noted["told"] = min(scores[step], *(value for value, _ in finished))
        RunFolder(self.folder).write_json(objective.TRIAL, noted)
        if not hopeless:
            return None
        return (
            f"after step {step} its score was {best:.4g}, the median of {len(there)} finished "
            f"trials {median(there):.4g}"
        )

    def _earlier(self) -> list[Path]:
        """Folders of the trials of earlier batches, which Hydra names by number."""
        first = int(self.folder.name) // self.batch * self.batch
        return [self.folder.with_name(str(number)) for number in range(first)]


def trial(folder: Path, batch: int) -> Trial | None:
    """The trial in that folder, of a search that starts ``batch`` trials together; None if it
    doesn't prune. Raises `UserError` for settings that can't be used."""
    found = settings(os.environ)
    if found is None:
        return None
    if not folder.name.isdecimal():
        raise UserError(
            f"a search can't prune trials in folders named as '{folder.name}': drop "
            f"hydra.sweep.subdir, or give hydra.job.env_set.{AT}= to prune none."
        )
    return Trial(folder, batch, *found)


def settings(variables: Mapping[str, str]) -> tuple[tuple[float, ...], int] | None:
    """The shares of the steps, and the number of trials, that these variables give; None if no
    trial is to be pruned. Raises `UserError` for values that can't be used."""
    given, after = variables.get(AT, ""), variables.get(AFTER, "1")
    if not given.strip():
        return None
    try:
        shares = tuple(float(each) for each in given.split())
        least = int(after)
    except ValueError:
        shares, least = (0.0,), 0
    if not all(0 < share < 1 for share in shares) or least < 1:
        raise UserError(
            f"hydra.job.env_set.{AT}='{given}' with {AFTER}='{after}' is not possible: give shares "
            "of the steps between 0 and 1, as '0.33 0.67', and a number of trials from 1."
        )
    return shares, least


def _scores(notes: Mapping[str, Any]) -> dict[int, float]:
    """A trial's scores by step; without those that are damaged."""
    scores = notes.get("scores")
    found = {
        int(step): untrusted.number(value)
        for step, value in (scores.items() if isinstance(scores, dict) else ())
        if str(step).isdecimal()
    }
    return {step: value for step, value in found.items() if value is not None}
