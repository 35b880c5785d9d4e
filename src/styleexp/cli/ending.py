"""How every command ends when the terminal or the next program in a pipe wants no more."""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Callable, Sequence

Main = Callable[..., int]


def ends_well(main: Main) -> Main:
    """Decorate a command's ``main``: a reader that has gone, as with ``| head``, and Ctrl-C end it
    without a traceback, with 1 and 130."""

    @functools.wraps(main)
    def wrapped(arguments: Sequence[str] | None = None) -> int:
        try:
            code = main(arguments)
            sys.stdout.flush()
            return code
        except BrokenPipeError:
            # Python flushes once more as it exits.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 1
        except KeyboardInterrupt:
            return 130

    return wrapped
