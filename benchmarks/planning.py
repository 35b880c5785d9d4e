"""How long it takes to plan many jobs: ``python -m benchmarks.planning [JOBS]``.

Prints the CPU seconds of `styleexp.experiments.sweeps.plan.jobs` for a plan of pairs, sigmas and
seeds, and for one of presets (``+contender``) and seeds. Runs nothing.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

from styleexp.experiments.sweeps import plan
from styleexp.experiments.sweeps.plan import Entry, Plan


def main(jobs: int) -> None:
    """Plan both, and print what it took."""
    sources, styles = ["torus", "sphere", "critter"], ["bubble", "rail", "stripe", "scales"]
    values = [f"source={','.join(sources)}", f"style={','.join(styles)}", "field.sigma=1,2,4,8"]
    seeds = list(range(-(-jobs // 48)))
    by_value = Entry(name="values", overrides=["method=robust", *values], seeds=seeds)
    seeds = list(range(-(-jobs // 44)))
    by_preset = Entry("methods", name="presets", seeds=seeds)
    for entry in (by_value, by_preset):
        with tempfile.TemporaryDirectory() as folder:
            begun = time.process_time()
            planned = plan.jobs(Plan([entry], profile="smoke"), Path(folder))
            took = time.process_time() - begun
        count = sum(map(len, planned.values()))
        print(f"{entry.name}: {count} jobs in {took:.1f} s CPU, {1000 * took / count:.1f} ms each")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 2000)
