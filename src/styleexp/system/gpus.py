"""One job a GPU: a job's process takes one of the machine's GPUs before torch looks at them.

Ray (``num_gpus``) and SLURM (``gres``) hand out GPUs by ``CUDA_VISIBLE_DEVICES``; joblib's and
Submitit's local processes would all use the first.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

VISIBLE = "CUDA_VISIBLE_DEVICES"
GIVEN = "STYLEEXP_GIVEN_GPUS"
"""Holds what `VISIBLE` was when the command began, for Submitit's local processes: Submitit empties
it for them, which would hide the GPUs."""
ALL = "all"
DRIVER = Path("/proc/driver/nvidia/gpus")
"""Holds a folder for each of the machine's GPUs, where NVIDIA's driver is."""


def remember() -> None:
    """Keep `VISIBLE` for processes that are started later."""
    os.environ[GIVEN] = os.environ.get(VISIBLE, ALL)


def visible() -> list[str]:
    """The GPUs that this process may use, as `VISIBLE` names them, in order.

    torch isn't asked: from then on, the variable would have no effect.
    """
    given = os.environ.get(VISIBLE)
    if not given and os.environ.get("SUBMITIT_EXECUTOR") == "local":
        given = os.environ.get(GIVEN, ALL)
    if given is not None and given != ALL:
        return [name.strip() for name in given.split(",") if name.strip()]
    try:
        return [str(number) for number, _ in enumerate(DRIVER.iterdir())]
    except OSError:
        return []


def take_one() -> str | None:
    """Make one GPU visible to this process, which keeps it until it ends: one that no other job's
    process on this machine has, or, if there are more jobs than GPUs, one of those in turn. None
    without a GPU."""
    from styleexp.system import locks

    names = visible()
    if not names:
        return None
    taken = names[os.getpid() % len(names)]
    if len(names) > 1:
        for name in names:
            with suppress(locks.Busy):
                locks.take(_slots() / name.replace(os.sep, "_"))
                taken = name
                break
    os.environ[VISIBLE] = taken
    return taken


def _slots() -> Path:
    import tempfile

    user = os.getuid() if hasattr(os, "getuid") else "user"
    return Path(tempfile.gettempdir()) / f"styleexp-gpus-{user}"
