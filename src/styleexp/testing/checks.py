"""What the checks of every kind of part share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

Part = TypeVar("Part")


class NotApplicable(Exception):
    """The part doesn't claim the checked property."""


def run(checks: Sequence[Callable[[Part], Any]], part: Part) -> dict[str, str]:
    """Run every check on a part; return the outcomes, ``passed`` or ``not applicable: ...``, by
    name.

    After all have run, raises ``AssertionError`` that lists the failed checks.
    """
    outcomes, failures = {}, []
    for check in checks:
        try:
            check(part)
            outcomes[check.__name__] = "passed"
        except NotApplicable as reason:
            outcomes[check.__name__] = f"not applicable: {reason}"
        except Exception as error:  # a part's own exceptions are failures too
            failures.append(f"{check.__name__}: {type(error).__name__}: {error}")
    if failures:
        raise AssertionError(
            f"{len(failures)} of {len(checks)} checks failed:\n" + "\n".join(failures)
        )
    return outcomes
