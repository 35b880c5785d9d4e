"""Parts by name, built in and from other packages: their specs, and building them.

`spec` is what a plugin declares, `catalogue` lists the built-in parts, `discovery` finds plugins
and builds parts. What a plugin's spec needs is here: `Spec`, `option`, and the options that those
of its kind derive from. Importing this package is cheap: it imports no part.
"""

from styleexp.encoders.options import EncoderConfig
from styleexp.method.options import FieldConfig, LossConfig, StyleConfig
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
from styleexp.system.options import option

__all__ = [
    "KINDS",
    "OWN",
    "VARIABLE",
    "Choice",
    "EncoderConfig",
    "FieldConfig",
    "Kind",
    "LossConfig",
    "Spec",
    "StyleConfig",
    "build",
    "everything",
    "find",
    "known",
    "load_encoder",
    "names",
    "option",
    "usable",
    "used",
    "warn_of_rivals",
]
