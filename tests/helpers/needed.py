"""What a machine may lack: a skip here, a failure in CI."""

import os

import pytest


def available(make):
    """What ``make`` returns. What it lacks, a `UserError`, is a skip, and in CI a failure."""
    from styleexp.system.errors import UserError

    try:
        return make()
    except UserError as missing:
        if os.environ.get("CI", "") not in ("", "0", "false"):
            pytest.fail(str(missing))
        pytest.skip(str(missing))
