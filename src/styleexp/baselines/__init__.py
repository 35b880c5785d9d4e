"""The methods beside the learned one: synthesis, the default, and those that the paper compares
with (Sec. 4.2.3), run by the same command into the same run folder.

A baseline is what `styleexp.stylize` is, the four functions of a `Method`: the command line and
``styleexp.stylize(...)`` call nothing else of either. ``config.baseline`` names it, ``conf/method``
has a preset for each. Two baselines need no code here: ``method=vertex`` is a field, and
``method=text2mesh`` an encoder and a loss, of the same loop.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Protocol, cast

if TYPE_CHECKING:
    from styleexp.config import Config
    from styleexp.stylize import Result


class Method(Protocol):
    """How a source mesh gets its style. ``config.optim.steps`` steps, or none."""

    def prepare(self, config: Config) -> Any:
        """Load what the run needs: a `scene.Subject`, which `scene.load` makes."""
        ...

    def start(self, scene: Any) -> Any:
        """The state before the first step, a `stylize.State`: a checkpoint holds all its tensors.

        None for a method without steps, and therefore without checkpoints.
        """
        ...

    def optimise(self, scene: Any, state: Any) -> Iterator[Any]:
        """Take the steps from ``state.step`` on, yielding a dataclass after each.

        Its fields are a line of ``metrics.jsonl``; ``step``, ``loss`` and ``seconds`` are shown.
        Random numbers come from `views.step_generator`, so that a resumed run draws the same.
        """
        ...

    def finish(self, scene: Any, state: Any) -> Result:
        """The generated mesh; where ``scene.mask`` is 0, the source. Where it has other faces than
        the source, the result's ``scene`` has a source that has them too, in the same frame."""
        ...


def method(config: Config) -> Method:
    """The baseline that ``config`` names, or the learned method."""
    from styleexp import plugins  # which lists the baselines, so it can't be imported above

    if config.baseline is None:
        return cast(Method, importlib.import_module("styleexp.stylize"))
    return plugins.build("baseline", config.baseline)
