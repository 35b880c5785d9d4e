"""Check the working tree for slowdowns against a commit: ``make bench-guard BASE=<commit>``

The same tasks are timed in both trees, in separate interleaved processes, by CPU time with one
thread. The ratio of the minimum times counts, because other processes can only increase a time.
Prints a table; exits with 1 if a ratio exceeds the limit, and with 2 for a user error.

Tasks that one of the trees lacks are listed and skipped.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parent.parent
STORED = Path(__file__).with_name("baseline")
"""File with the default commit to compare with."""

FROM = """
import sys
sys.path.insert(0, {tree!r} + "/src")
for name, module in list(sys.modules.items()):  # an editable install knows the folders beside src
    if name.startswith("__editable___styleexp"):
        module.MAPPING |= {{
            "styleexp": {tree!r} + "/src/styleexp",
            "styleexp.conf": {tree!r} + "/conf",
            "styleexp.notebooks": {tree!r} + "/reports",
        }}
"""

COMMON = """
import math, time, torch
torch.set_num_threads(1)

def least(run, repeats):
    run()
    times = []
    for _ in range(repeats):
        begun = time.process_time()
        run()
        times.append(time.process_time() - begun)
    print(min(times))
"""

RENDER = """
from styleexp.inputs import shapes
from styleexp.method.views import orbit
from styleexp.renderers.base import Shading
from styleexp.renderers.soft_raster import SoftRaster
mesh = shapes.make("bubble", {faces} // 2 + 2)
points = torch.from_numpy(mesh.vertices).float()
points = (points / points.norm(dim=1).max()).requires_grad_()
faces, renderer = torch.from_numpy(mesh.faces).long(), SoftRaster()
cameras = orbit(torch.zeros(5), torch.arange(5) * (2 * math.pi / 5), 2.2, 60.0)

def run():
    shading = Shading(normals="smooth", outlines=True)
    out = renderer.render(points, faces, cameras, shading, (250, 250))
    (out.image.square().sum() + out.coverage.sum()).backward()

least(run, 5)
"""

ENCODER = """
from styleexp.method.losses import GramLoss
from styleexp.method.options import LossConfig
from styleexp.method.viewer import Images
from styleexp.plugins import load_encoder
loss = GramLoss(LossConfig(), load_encoder("vgg19_random"))
seen = Images(torch.rand(2, 250, 250, 3, requires_grad=True), torch.ones(2, 250, 250))

def run():
    sum(gram.square().sum() for gram in loss.describe(seen)).backward()

least(run, 5)
"""

FIELD = """
from styleexp.method.fields import FourierMLP
from styleexp.method.options import FieldConfig
field = FourierMLP(FieldConfig(), torch.Generator().manual_seed(0), 3.0, 0.1)
points = torch.rand(20000, 3)
least(lambda: field(points, precision=torch.bfloat16).sum().backward(), 5)
"""

STEP = """
from styleexp.config import build
from styleexp.config.compose import compose
config = compose(["source=torus", "style=bubble", "encoder=vgg19_random", "profile=fast",
                  "method=robust", "loss.bank_views=2", "threads=1"])
method, scene = build.prepare(config)
steps = method.optimise(scene, method.start(scene))
least(lambda: next(steps), 4)
"""

BEFORE = {
    "render": RENDER.replace("styleexp.inputs import", "styleexp import").replace(
        "styleexp.method.views", "styleexp.views"
    ),
    "encoder": """
from styleexp.config import LossConfig
from styleexp.encoders import load_encoder
from styleexp.losses import StyleLoss
from styleexp.viewer import Images
loss = StyleLoss(LossConfig(), load_encoder("vgg19_random"))
seen = Images(torch.rand(2, 250, 250, 3, requires_grad=True), torch.ones(2, 250, 250))

def run():
    sum(gram.square().sum() for gram in loss.grams(seen)).backward()

least(run, 5)
""",
    "field": """
from styleexp.config import FieldConfig
from styleexp.fields import DisplacementField
field = DisplacementField(FieldConfig(), torch.Generator().manual_seed(0), 3.0, 0.1)
points = torch.rand(20000, 3)
least(lambda: field(field.encode(points), torch.bfloat16).sum().backward(), 5)
""",
    "step": """
from styleexp import baselines
from styleexp.compose import compose
config = compose(["source=torus", "style=bubble", "encoder=vgg19_random", "profile=fast",
                  "method=robust", "loss.bank_views=2", "threads=1"])
method = baselines.method(config)
scene = method.prepare(config)
steps = method.optimise(scene, method.start(scene))
least(lambda: next(steps), 4)
""",
}
"""The same tasks in a tree from before the modules were grouped into packages."""


def either(now: str, before: str) -> str:
    """A task in a tree of today, or of before."""
    tried = f"exec({now!r} if grouped else {before!r})"
    grouped = "import importlib.util\ngrouped = importlib.util.find_spec('styleexp.method')\n"
    return COMMON + grouped + tried


HELP = """
import contextlib, io, sys, time
sys.argv = ["styleexp", "--help"]
from styleexp.cli.main import main
with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
    main()
print(time.process_time())
"""

IMPORT = """
import time
import styleexp
print(time.process_time())
"""

WORK = {
    "import styleexp": IMPORT,
    "styleexp --help": HELP,
    "encoder and Grams": either(ENCODER, BEFORE["encoder"]),
    "field, 20k vertices": either(FIELD, BEFORE["field"]),
    "a whole step": either(STEP, BEFORE["step"]),
} | {
    f"render, {faces} faces": either(
        RENDER.replace("{faces}", faces), BEFORE["render"].replace("{faces}", faces)
    )
    for faces in ("20000", "80000")
}


def main() -> int:
    """Compare, print, and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("base", nargs="?", default=STORED.read_text().strip(), help="commit")
    parser.add_argument("--limit", type=float, default=1.15, help="ratio that fails (1.15)")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--only", help="a part of a piece's name")
    options = parser.parse_args()
    work = {name: code for name, code in WORK.items() if (options.only or "") in name}
    if not work or options.rounds < 1:
        print(f"guard: --only is part of one of {', '.join(WORK)}; --rounds 1 or more")
        return 2
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # the worktree goes in any case
    with tempfile.TemporaryDirectory() as folder:
        base = Path(folder) / "base"
        added = _git("worktree", "add", "--detach", "--quiet", str(base), options.base)
        if added.returncode:
            print(f"guard: '{options.base}' can't be checked out: {added.stderr.strip()}")
            return 2
        try:
            return compare(base, work, options)
        finally:
            _git("worktree", "remove", "--force", str(base))


def compare(base: Path, work: dict[str, str], options: argparse.Namespace) -> int:
    """Time both trees in turns; return 1 if any task is slower than the limit allows."""
    print(f"CPU ms at one thread, least of {options.rounds} processes each")
    print(f"{'':22s} {options.base[:10]:>10s} {'here':>10s} {'ratio':>7s}")
    failed = []
    for name, code in work.items():
        times: dict[Path, list[float]] = {base: [], ROOT: []}
        for _ in range(options.rounds):
            for tree, seconds in times.items():
                seconds += timed(tree, code)
        if not all(times.values()):
            print(f"{name:22s} {'skipped: one of the trees lacks it':>30s}")
            continue
        before, now = (1e3 * min(seconds) for seconds in times.values())
        slower = now / before > options.limit
        failed += [name] * slower
        print(f"{name:22s} {before:10.1f} {now:10.1f} {now / before:7.2f}{' <' * slower}")
    if failed:
        print(f"more than {options.limit} x as slow as {options.base[:10]}: {', '.join(failed)}")
    return 1 if failed else 0


def timed(tree: Path, code: str) -> list[float]:
    """Seconds of a task in a tree; None if it can't run there."""
    given = os.environ | {
        "OMP_NUM_THREADS": "1",
        "OMP_WAIT_POLICY": "PASSIVE",
        "STYLEEXP_CACHE": str(tree / "build" / "guard-cache"),
    }
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", FROM.format(tree=str(tree)) + code],
        capture_output=True,
        text=True,
        env=given,
        cwd=tree,
    )
    return [float(done.stdout.split()[-1])] if done.returncode == 0 else []


def _git(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, text=True)


if __name__ == "__main__":
    sys.exit(main())
