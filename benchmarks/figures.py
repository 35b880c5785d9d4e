"""Draw the figures of docs/benchmarks.md from the JSON of `styleexp-bench`.

python benchmarks/figures.py ROWS.json... OUT.png

Rows of `styleexp-bench render --json` become a render's cost against faces, pixels and views; those
of `styleexp-bench step --json`, each with other layers, a step's cost against its layers.
"""

import json
import sys

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot

RENDER_PARTS = ("visibility", "shading", "outlines", "normals", "projection", "other")
STEP_PARTS = ("encoder", "Gram matrices", "loss", "render", "field")


def with_backward(parts: dict[str, float], name: str) -> float:
    """Time of a part, forward plus backward."""
    return parts.get(name, 0) + parts.get(f"{name} backward", 0)


def draw_renders(rows: list[dict]) -> None:
    """One panel per varying parameter (faces, resolution, views), with the others at their
    defaults."""
    axes_of = ("faces", "resolution", "views")
    varied = [key for key in axes_of if len({row[key] for row in rows}) > 1]
    _, axes = pyplot.subplots(
        1, len(varied), figsize=(5.2 * len(varied), 4), layout="constrained", squeeze=False
    )
    usual = {"faces": 20480, "resolution": 250, "views": 5}
    for axis, key in zip(axes[0], varied, strict=True):
        others = [k for k in axes_of if k != key]
        at_usual = [row for row in rows if all(row[k] == usual[k] for k in others)]
        line = sorted({row[key]: row for row in at_usual}.values(), key=lambda row: row[key])
        xs = [row[key] for row in line]
        axis.plot(xs, [row["ours_cpu_ms"] for row in line], "ko-", label="whole")
        for part in RENDER_PARTS:
            axis.plot(
                xs, [with_backward(row["parts_cpu_ms"], part) for row in line], ".-", label=part
            )
        axis.set(xscale="log", yscale="log", xlabel=key, ylabel="CPU ms, one thread")
        axis.grid(alpha=0.3)
    axes[0][0].legend(fontsize=8)


def draw_layers(rows: list[dict]) -> None:
    """One stacked bar of parts per row, cheapest first."""
    rows = sorted(rows, key=lambda row: row["step_cpu_ms"])
    _, axis = pyplot.subplots(figsize=(7.2, 0.9 + 0.42 * len(rows)), layout="constrained")
    names = [", ".join(layer.removeprefix("conv") for layer in row["layers"]) for row in rows]
    left = [0.0] * len(rows)
    for part in (*STEP_PARTS, "other"):
        spent = [with_backward(row["parts_cpu_ms"], part) for row in rows]
        if part == "other":
            spent = [row["step_cpu_ms"] - known for row, known in zip(rows, left, strict=True)]
        axis.barh(names, spent, left=left, label=part)
        left = [a + b for a, b in zip(left, spent, strict=True)]
    axis.set(xlabel="CPU ms of a step, one thread", ylabel="layers")
    axis.legend(fontsize=8, ncols=3)


def main(names: list[str], out: str) -> None:
    """Read all rows and draw the matching figure."""
    rows = []
    for name in names:
        with open(name) as file:
            found = json.load(file)
        rows += found.get("rows", [found])
    draw = draw_layers if "step_cpu_ms" in rows[0] else draw_renders
    draw(rows)
    pyplot.savefig(out, dpi=100)


if __name__ == "__main__":
    main(sys.argv[1:-1], sys.argv[-1])
