"""Methods other than the learned one: synthesis, the default, and the paper's baselines (Sec.
4.2.3). All run with the same command and write the same run folder.

A baseline implements the four functions of `Method`, like the module `method.gram`; callers use
nothing else. ``config.baseline`` names it, and ``conf/method`` has a preset for each. Two baselines
need no code here and use the usual loop: ``method=vertex`` is a field, and ``method=text2mesh`` an
encoder and a loss.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Protocol, cast

if TYPE_CHECKING:
    from styleexp.config.schema import Config
    from styleexp.method.gram import Result


class Method(Protocol):
    """A stylisation method, with ``config.optim.steps`` steps or none."""

    def prepare(self, config: Config) -> Any:
        """Load the run's inputs as a `scene.Subject`; see `scene.load`."""
        ...

    def start(self, scene: Any) -> Any:
        """State before the first step, a `stylize.State`, whose tensors are checkpointed.

        None for a method without steps, which has no checkpoints.
        """
        ...

    def optimise(self, scene: Any, state: Any) -> Iterator[Any]:
        """Run the steps from ``state.step`` on, yielding a dataclass after each.

        Its fields form a line of ``metrics.jsonl``; ``step``, ``loss`` and ``seconds`` are
        displayed. Draw random numbers from `views.step_generator`, so that resumed runs are
        reproducible.
        """
        ...

    def finish(self, scene: Any, state: Any) -> Result:
        """Return the generated mesh, which equals the source where ``scene.mask`` is 0. If its
        faces differ from the source's, the result's ``scene`` has a source with these faces, in the
        same frame."""
        ...


def method(config: Config) -> Method:
    """Return the baseline named in ``config``, or the learned method."""
    from styleexp import plugins  # circular: plugins lists the baselines

    if config.baseline is None:
        return cast(Method, importlib.import_module("styleexp.method.gram"))
    return plugins.build("baseline", config.baseline)
