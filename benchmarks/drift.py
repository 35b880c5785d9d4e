"""Why does a learned run drift? Measures the loss's pull at a few steps and draws it.

python benchmarks/drift.py OUT.png source=spot style=bubble profile=full -- method=paper -- \\
    method=paper_amended

Overrides before the first `--` are common; each `--` begins a run. Numbers go to OUT.json.

At each of STEPS, over DRAWS independent draws of the views:

- signal: |mean gradient|^2 over the mean |gradient|^2 of one draw, the gradient being of the loss
  by the field's parameters, which is what Adam follows. 1 is all signal; 1 / DRAWS is what pure
  noise gives.
- pull: the gradient by the mean displacement, its mean over its root mean square. 1 swells the mesh
  in every draw, -1 shrinks it in every draw; within 1 / sqrt(DRAWS) of 0 it is chance.
- of each layer's distance, what outline, interior and background cells make up: the Gram matrix is
  a sum over cells, so its difference D is D_outline + D_interior + D_background, and the shares
  <D_part, D> / |D|^2 sum to 1. The outline's cells see both the mesh and what is behind it.
"""

from __future__ import annotations

import json
import sys
import textwrap
from pathlib import Path
from typing import Any

import matplotlib
import torch

matplotlib.use("Agg")
from matplotlib import pyplot

from styleexp.config import build
from styleexp.config.compose import compose
from styleexp.method.base import State
from styleexp.method.losses import gram_matrix, layer_masks, mean_gram
from styleexp.method.paper import displace
from styleexp.method.scene import PaperScene

STEPS = (1, 25, 50, 100)
DRAWS = 8
LATER = 10_000_000
"""Steps from here on number the draws of views, so that none is a training step's."""
PARTS = ("outline", "interior", "background")
RIM = 2
"""Cells around an outline that count as of it: they see it through the convolutions."""


def measured(scene: PaperScene, state: State) -> dict[str, Any]:
    """The numbers of the file's head for a state of a run."""
    subject, loss = scene.subject, scene.loss
    surface, settings = subject.surface, subject.settings
    parameters = list(state.field.parameters())
    gradients, pulls = [], []
    for draw in range(DRAWS):
        d = displace(scene, state, scene.precision)
        d.retain_grad()
        moved = surface.vertices + d[:, None] * surface.normals
        if settings.optim.renormalize:
            moved = moved / moved.detach().norm(dim=1).max()
        whole, local = scene.viewer(moved, LATER + draw)
        goals = scene.target(LATER + draw)
        total = settings.loss.lambda_global * loss.distance(
            loss.describe(whole), goals[0], scene.scales[0]
        )
        total = total + settings.loss.lambda_local * loss.distance(
            loss.describe(local), goals[1], scene.scales[1]
        )
        state.optimizer.zero_grad()
        total.backward()
        assert d.grad is not None
        pulls.append(-d.grad.double().sum())
        gradients.append(torch.cat([p.grad.flatten().double() for p in parameters]))
    state.optimizer.zero_grad()
    g, pull = torch.stack(gradients), torch.stack(pulls)
    return {
        "step": state.step,
        "rms": float(d.detach().square().mean().sqrt()),
        "mean_displacement": float(d.detach().mean()),
        "signal": float(g.mean(0).square().sum() / g.square().sum(1).mean()),
        "pull": float(pull.mean() / pull.square().mean().sqrt()),
        "parts": parts(scene, moved.detach()),
    }


@torch.no_grad()
def parts(scene: PaperScene, moved: torch.Tensor) -> dict[str, dict[str, float]]:
    """Of each layer's distance over the global views, the shares of `PARTS`; nothing where the loss
    sees the foreground alone, or where the style isn't rendered at the same views."""
    loss, target = scene.loss, scene.target
    if loss.masked or not hasattr(target, "viewer"):
        return {}
    found: list[dict[str, dict[str, torch.Tensor]]] = []
    for viewer, vertices in ((scene.viewer, moved), (target.viewer, target.vertices)):
        seen, _ = viewer(vertices, LATER)
        features = loss.encoder(seen.image.permute(0, 3, 1, 2), loss.layers)
        shapes = [(f.shape[2], f.shape[3]) for f in features.values()]
        inside = layer_masks(seen.coverage, shapes, RIM)
        outside = layer_masks(1 - seen.coverage, shapes, RIM)
        grams = {}
        for (name, f), within, beyond in zip(features.items(), inside, outside, strict=True):
            cells = f[:, 0].numel()
            kept = {"outline": ~(within | beyond), "interior": within, "background": beyond}
            # Sums over some cells, divided by the number of all.
            grams[name] = {
                part: mean_gram(gram_matrix(f.float(), mask, "none"), None, cells)
                for part, mask in kept.items()
            }
        found.append(grams)
    shares = {}
    for name, weight in zip(loss.layers, loss.weights, strict=True):
        d = {part: found[0][name][part] - found[1][name][part] for part in PARTS}
        whole = torch.stack(list(d.values())).sum(0)
        square = whole.square().sum()
        shares[name] = {part: float((d[part] * whole).sum() / square) for part in PARTS}
        shares[name]["distance"] = weight * float(square)
    return shares


def run(overrides: list[str]) -> list[dict[str, Any]]:
    """The numbers at each of `STEPS` of a run."""
    config = compose(overrides)
    config.optim.steps = max(config.optim.steps, STEPS[-1])
    learned, scene = build.prepare(config)
    state = learned.start(scene)
    rows = []
    for step in learned.optimise(scene, state):
        if step.step in STEPS:
            rows.append(measured(scene, state))
            print(json.dumps({k: v for k, v in rows[-1].items() if k != "parts"}), flush=True)
        if step.step == STEPS[-1]:
            break
    return rows


def draw(runs: list[tuple[str, list[dict[str, Any]]]], path: Path) -> None:
    """A row for each run: displacement, signal and pull over steps, parts by layer."""
    figure, axes = pyplot.subplots(
        len(runs), 3, figsize=(13, 3.4 * len(runs)), layout="constrained", squeeze=False
    )
    for (title, rows), (left, middle, right) in zip(runs, axes, strict=True):
        steps = [row["step"] for row in rows]
        left.plot(steps, [row["rms"] for row in rows], "o-", label="root mean square")
        left.plot(steps, [row["mean_displacement"] for row in rows], "s-", label="mean")
        left.set(xlabel="step", ylabel="displacement, radii", ylim=(-0.105, 0.105))
        left.set_title(textwrap.fill(title, 58), fontsize=8)
        left.axhline(0, color="grey", lw=0.5)
        left.legend(fontsize=8)
        middle.plot(steps, [row["signal"] for row in rows], "o-", label="signal")
        middle.plot(steps, [row["pull"] for row in rows], "s-", label="pull on the mean")
        middle.axhline(1 / DRAWS, color="grey", ls=":", label="signal of pure noise")
        middle.set(title="gradient", xlabel="step", ylim=(-1.05, 1.05))
        middle.legend(fontsize=8)
        last = rows[-1]["parts"]
        if not last:
            right.text(0.5, 0.5, "no outline or background in the loss", ha="center")
            right.set_axis_off()
            continue
        for k, part in enumerate(PARTS):
            places = [n + 0.27 * (k - 1) for n in range(len(last))]
            right.bar(places, [each[part] for each in last.values()], 0.25, label=part)
        right.set_xticks(range(len(last)), list(last), fontsize=8)
        right.axhline(0, color="grey", lw=0.5)
        right.set(title=f"share of each layer's distance, step {rows[-1]['step']}")
        right.legend(fontsize=8)
    figure.savefig(path, dpi=90)


def main(arguments: list[str]) -> None:
    """Measure and draw each run: common overrides, then each run's own after a ``--``."""
    out, *overrides = arguments
    sets: list[list[str]] = [[]]
    for override in overrides:
        if override == "--":
            sets.append([])
        else:
            sets[-1].append(override)
    common, *own = sets
    runs = [(" ".join(each), run([*common, *each])) for each in own or [[]]]
    Path(out).with_suffix(".json").write_text(json.dumps(dict(runs), indent=1))
    draw(runs, Path(out))


if __name__ == "__main__":
    main(sys.argv[1:])
