"""Draw docs/benchmarks.md's figure from rows of `styleexp-bench render --json`.

python benchmarks/figures.py ROWS.json... OUT.png
"""

import json
import sys

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot

PARTS = ("visibility", "shading", "outlines", "normals", "projection", "other")

rows = []
for name in sys.argv[1:-1]:
    with open(name) as file:
        found = json.load(file)
    rows += found.get("rows", [found])

axes_of = ("faces", "resolution", "views")
varied = [key for key in axes_of if len({row[key] for row in rows}) > 1]
figure, axes = pyplot.subplots(
    1, len(varied), figsize=(5.2 * len(varied), 4), layout="constrained", squeeze=False
)
usual = {"faces": 20480, "resolution": 250, "views": 5}
for axis, key in zip(axes[0], varied, strict=True):
    others = [k for k in axes_of if k != key]
    at_usual = [row for row in rows if all(row[k] == usual[k] for k in others)]
    line = sorted({row[key]: row for row in at_usual}.values(), key=lambda row: row[key])
    xs = [row[key] for row in line]
    axis.plot(xs, [row["ours_cpu_ms"] for row in line], "ko-", label="whole")
    for part in PARTS:
        spent = [row["parts_cpu_ms"] for row in line]
        both = [each.get(part, 0) + each.get(f"{part} backward", 0) for each in spent]
        axis.plot(xs, both, ".-", label=part)
    axis.set(xscale="log", yscale="log", xlabel=key, ylabel="CPU ms, one thread")
    axis.grid(alpha=0.3)
axes[0][0].legend(fontsize=8)
figure.savefig(sys.argv[-1], dpi=100)
