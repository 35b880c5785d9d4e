"""Hydra's errors, in the words of the one who typed."""

from __future__ import annotations

import pytest
from hydra.errors import HydraException

from styleexp.config.compose import compose
from styleexp.config.explain import explain


@pytest.mark.parametrize(
    ("word", "told"),
    [
        ("style.scale=1,2", "style.scale has several values, 1,2: add -m to run each of them"),
        ("method=robust,paper", "method has several values, robust,paper: add -m"),
        ("experiment=board", "add it with a plus, +experiment=board."),
        ("out=here", "there is no key 'out': did you mean hydra.run.dir?"),
        ("steps=3", "there is no key 'steps': did you mean optim.steps?"),
        ("strength=high", "strength must be a number, not 'high'."),
    ],
)
def test_a_mistake_is_told_with_its_remedy_in_one_line(word, told):
    with pytest.raises(HydraException) as raised:
        compose([word])
    assert told in explain(raised.value)
    assert "\n" not in explain(raised.value)
