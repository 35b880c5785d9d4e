"""Parts by name, built in and from other packages: their specs, and building them.

`spec` is what a plugin declares, `catalogue` lists the built-in parts, `discovery` finds plugins
and builds parts. Importing this package is cheap: it imports no part.
"""

from styleexp.plugins.discovery import (
    KINDS,
    OWN,
    VARIABLE,
    Choice,
    Kind,
    build,
    everything,
    find,
    known,
    load_encoder,
    names,
    usable,
    used,
    warn_of_rivals,
)
from styleexp.plugins.spec import Spec

__all__ = [
    "KINDS",
    "OWN",
    "VARIABLE",
    "Choice",
    "Kind",
    "Spec",
    "build",
    "everything",
    "find",
    "known",
    "load_encoder",
    "names",
    "usable",
    "used",
    "warn_of_rivals",
]
