"""Conformance checks: what must hold for a part of each kind, built in or from a plugin.

Each check states in its docstring what must hold, and raises ``AssertionError`` if it doesn't or
`NotApplicable` if the part doesn't claim it. ``check_KIND`` runs all of its kind, returns the
outcomes and raises with a list of the failed ones::

    check_renderer(MyRenderer())
    check_encoder(my_encoder, ["conv1_1", "conv2_1"])
    check_loss(MyLoss(options, load_encoder("vgg19_random")))
    check_field(functools.partial(build, options))
    check_style(my_mesh_or_picture)
    check_method(lambda: MyMethod(options))
"""

from styleexp.testing.checks import NotApplicable
from styleexp.testing.encoders import check_encoder
from styleexp.testing.fields import check_field
from styleexp.testing.losses import check_loss
from styleexp.testing.methods import check_method
from styleexp.testing.renderers import CHECKS, check_renderer, conformance_table
from styleexp.testing.styles import check_style

__all__ = [
    "CHECKS",
    "NotApplicable",
    "check_encoder",
    "check_field",
    "check_loss",
    "check_method",
    "check_renderer",
    "check_style",
    "conformance_table",
]
