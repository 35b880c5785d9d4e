"""Bad and odd files, each with what has to come of it.

`CASES` is what tests/inputs/test_corpus.py tries and docs/robustness.md lists: a row for each file,
in tables by what is wrong with it. Nothing of it is stored: `writers` makes every file when it is
asked for. A case works, or works with a repair that the user is told, or is refused with one
sentence.
"""

from __future__ import annotations

from tests.helpers.corpus import damaged, formats, gltf, meshes, pictures
from tests.helpers.corpus.case import REFUSED, REPAIRED, WORKS, Case

__all__ = ["CASES", "REFUSED", "REPAIRED", "WORKS", "Case"]

_ROWS = (
    *damaged.TRUNCATED,
    *damaged.COUNTS,
    *meshes.COORDINATES,
    *meshes.TOPOLOGY,
    *formats.TEXT_AND_NAMES,
    *formats.MATERIALS,
    *gltf.FEATURES,
    *gltf.NUMBERS,
    *formats.PROPERTIES,
    *meshes.ROUNDING,
    *damaged.RENAMED,
    *pictures.STYLES,
)
CASES: dict[str, Case] = {case.name: case for case in _ROWS}
assert len(CASES) == len(_ROWS), "two cases of one name"
