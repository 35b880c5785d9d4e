"""How often the host waits for a GPU, and how many kernels it launches: python -m benchmarks.waits

Counted on the simulated device of `tests.helpers.simulated_cuda`, so without a GPU, for
`profile=full`. Prints the tables of docs/benchmarks.md as Markdown; with ``--lines`` also every
line that waits or launches, which is where to begin to make it less. ``--tree FOLDER`` counts
another checkout of this repository.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

PARTS = {
    "views": ("views.py", "viewer.py"),
    "visibility": ("raster.py", "boxes.py", "culling.py"),
    "shading": ("shading.py", "geometry.py", "deferred.py", "base.py"),
    "outlines": ("contour.py", "composing.py"),
    "encoder": ("vgg.py",),
    "Gram matrices and loss": ("losses.py",),
    "field": ("fields.py",),
    "the loop and Adam": ("paper.py", "stepping.py", "scene.py", "targets.py"),
    "autograd": ("(autograd)",),
}
"""Files whose lines make up each part of a step; of a backward pass in C++ no line is known."""
OTHER = "other"

SETTINGS = {
    "`robust`": ["method=robust", "style=bubble"],
    "`robust`, outlines": ["method=robust", "style=bubble", "shading.outlines=true"],
    "`robust`, a picture": ["method=robust", "style=grass"],
    "`paper`": ["method=paper", "style=bubble"],
    "`paper`, outlines": ["method=paper", "style=bubble", "shading.outlines=true"],
}
COMMON = ["source=critter", "encoder=vgg19_random", "profile=full", "device=cuda"]


@dataclass
class Counts:
    """Waits and kernels by the line they come from."""

    waits: Counter[str] = field(default_factory=Counter)
    kernels: Counter[str] = field(default_factory=Counter)

    @classmethod
    def taken(cls, gpu: Any) -> Counts:
        """What the simulated device has counted since it was last asked."""
        waits = Counter(f"{wait.where} {wait.operator}" for wait in gpu.waits)
        found = cls(waits, gpu.kernels)
        gpu.reset()
        return found

    def by_part(self) -> dict[str, tuple[int, int]]:
        """(waits, kernels) of each part."""
        part_of = {name: part for part, names in PARTS.items() for name in names}
        found = dict.fromkeys((*PARTS, OTHER), (0, 0))
        for number, counts in enumerate((self.waits, self.kernels)):
            for line, count in counts.items():
                part = part_of.get(line.partition(":")[0].split()[0], OTHER)
                pair = list(found[part])
                pair[number] += count
                found[part] = (pair[0], pair[1])
        return found


def counted(words: list[str], steps: int = 2) -> tuple[Counts, Counts]:
    """Counts of the preparation and of the step with the most kernels, the first left out, for
    overrides as of ``styleexp``. The device must be simulated."""
    from styleexp.config import build
    from styleexp.config.compose import compose
    from styleexp.system import process
    from tests.helpers import simulated_cuda

    config = compose(words)
    process.prepare(config.threads, config.optim.seed)
    with simulated_cuda.simulate(watch="styleexp/") as gpu:
        method, scene = build.prepare(config)
        state = method.start(scene)
        prepared = Counts.taken(gpu)
        found = []
        if state is not None:
            loop = method.optimise(scene, state)
            for _ in range(steps):
                next(loop)
                found.append(Counts.taken(gpu))
    most = max(found[1:], key=lambda each: each.kernels.total()) if found else Counts()
    return prepared, most


def main() -> None:
    """Count, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--lines", action="store_true", help="every line that waits or launches")
    parser.add_argument("--tree", help="count the package of this checkout instead")
    parser.add_argument("--only", type=int, help="the setting of this number, from 0")
    parser.add_argument("overrides", nargs="*", help="added to every setting")
    options = parser.parse_args()
    if options.tree:
        exec(FROM.format(tree=options.tree))
    from tests.helpers import simulated_cuda  # before torch's first backward pass

    assert simulated_cuda
    columns: dict[str, tuple[Counts, Counts]] = {}
    with tempfile.TemporaryDirectory() as cache:
        os.environ["STYLEEXP_CACHE"] = cache  # so that Gram matrices are measured, not read
        for number, (name, words) in enumerate(SETTINGS.items()):
            if options.only in (None, number):
                columns[name] = counted([*COMMON, *words, *options.overrides])
                print(".", end="", file=sys.stderr, flush=True)
    print(table(columns))
    if options.lines:
        for name, pair in columns.items():
            for when, counts in zip(("preparation", "a step"), pair, strict=True):
                print(f"\n{name}, {when}: waits")
                print(*(f"{n:6} {line}" for line, n in counts.waits.most_common()), sep="\n")
                print(f"\n{name}, {when}: kernels")
                print(*(f"{n:6} {line}" for line, n in counts.kernels.most_common()), sep="\n")


def table(columns: dict[str, tuple[Counts, Counts]]) -> str:
    """Waits and kernels, by part of a step, as Markdown."""
    rows = [["waits / kernels", *columns], ["---"] * (1 + len(columns))]
    rows.append(
        [
            "preparation",
            *(f"{p.waits.total()} / {p.kernels.total():,}" for p, _ in columns.values()),
        ]
    )
    parts = {name: step.by_part() for name, (_, step) in columns.items()}
    for part in (*PARTS, OTHER):
        cells = [parts[name][part] for name in columns]
        if any(any(cell) for cell in cells):
            rows.append([part, *(f"{waits} / {kernels:,}" for waits, kernels in cells)])
    totals = [f"**{s.waits.total()} / {s.kernels.total():,}**" for _, s in columns.values()]
    rows.append(["**a step**", *totals])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


if __name__ == "__main__":
    from benchmarks.guard import FROM

    main()
