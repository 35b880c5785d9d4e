"""Results made worse on purpose, for the set of rated results (docs/metrics.md).

    styleexp-sweep sweeps/rated.yaml                   # results by every method
    python -m benchmarks.rated outputs/rated           # adds outputs/rated/altered/KIND/PAIR
    styleexp-report study outputs/rated --sheets sheets --seed 19

Each altered result starts from that of ``method=synthesis``, and lies in a copy of its run's
folder, so that all else (sheets, metrics) treats it as a run. Each of the kinds below is applied to
a quarter of the pairs. ``wrong_style`` is the same source's result with another style of the sweep.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

from styleexp.config import build
from styleexp.config.compose import compose
from styleexp.experiments import execute
from styleexp.experiments.metrics.board import read_result
from styleexp.experiments.metrics.truth import noise
from styleexp.inputs import meshes
from styleexp.method.relief import smoother
from styleexp.runs import finding, origins
from styleexp.runs.reading import Run

SHARE = 4
"""Each kind is applied to one in ``SHARE`` pairs."""


@dataclass(frozen=True)
class Laid:
    """A result taken apart, in radii of the normalised source."""

    base: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    height: np.ndarray
    frequency: float
    """Of the style's relief, in cycles per radius."""
    rng: np.random.Generator

    def raised(self, height: np.ndarray) -> np.ndarray:
        """The base moved along its normals."""
        return self.base + height[:, None] * self.normals

    def noise(self, frequency: float) -> np.ndarray:
        """A random field of RMS 1."""
        return noise(self.base, frequency, self.rng)


def mush(laid: Laid) -> np.ndarray:
    """The relief blurred over 0.6 of its wavelength, as high as before."""
    blurred = smoother(laid.base, laid.faces, 0.6 / laid.frequency)(laid.height)
    return laid.raised(blurred * laid.height.std() / blurred.std())


def noisy(laid: Laid) -> np.ndarray:
    """Undulations of twice its frequency added."""
    return laid.raised(laid.height + 0.8 * laid.height.std() * laid.noise(2 * laid.frequency))


def grainy(laid: Laid) -> np.ndarray:
    """Each vertex moved at random."""
    grain = laid.rng.normal(size=len(laid.height))
    return laid.raised(laid.height + 0.35 * laid.height.std() * grain)


def patchy(laid: Laid) -> np.ndarray:
    """The relief on half of the surface only."""
    return laid.raised(laid.height / (1 + np.exp(-12 * laid.noise(0.6))))


def torn(laid: Laid) -> np.ndarray:
    """Three extremities crumpled."""
    moved = laid.raised(laid.height)
    far = np.linalg.norm(laid.base - laid.base.mean(axis=0), axis=1)
    for _ in range(3):
        tip = laid.base[far.argmax()]
        near = np.linalg.norm(laid.base - tip, axis=1)
        far[near < 0.5] = 0
        share = np.clip(1 - near / 0.3, 0, 1)[:, None] ** 0.5
        jitter = np.stack([laid.noise(6.0) for _ in range(3)], axis=1)
        moved += 0.06 * share * jitter
    return moved


def spiked(laid: Laid) -> np.ndarray:
    """One vertex in 300 far above the rest."""
    height = laid.height.copy()
    chosen = laid.rng.choice(len(height), len(height) // 300, replace=False)
    height[chosen] += 6 * laid.height.std() * laid.rng.choice([-1, 1], len(chosen))
    return laid.raised(height)


def melted(laid: Laid) -> np.ndarray:
    """The relief on a smoothed source, thin parts shrunken."""
    base = smoother(laid.base, laid.faces, 0.35)(laid.base)
    return base + laid.height[:, None] * meshes.vertex_normals(base, laid.faces)


KINDS: dict[str, Callable[[Laid], np.ndarray]] = {
    "half_height": lambda laid: laid.raised(0.5 * laid.height),
    "mush": mush,
    "noisy": noisy,
    "patchy": patchy,
    "torn": torn,
    "quarter_height": lambda laid: laid.raised(0.25 * laid.height),
    "grainy": grainy,
    "double_height": lambda laid: laid.raised(2 * laid.height),
    "only_noise": lambda laid: laid.raised(laid.height.std() * laid.noise(laid.frequency)),
    "spiked": spiked,
    "swollen": lambda laid: laid.raised(laid.height + 0.07),
    "melted": melted,
    "untouched": lambda laid: laid.base,
    "inverted": lambda laid: laid.raised(-laid.height),
    "lower_half": lambda laid: laid.raised(laid.height * (laid.base[:, 1] < 0)),
}


def taken_apart(run: Run) -> tuple[Laid, meshes.Normalisation]:
    """A finished run of a method that moves vertices along the source's normals."""
    subject = build.subject_of(origins.restored(run.record, run.folder, "alter"), separate=True)
    result, found = read_result(run.folder / "result.ply", subject.source)
    base, faces = subject.frame.apply(subject.source.vertices), subject.source.faces
    if not np.array_equal(found, faces):
        raise SystemExit(f"{run.folder}: its faces aren't those of the refined source")
    normals = meshes.vertex_normals(base, faces)
    height = ((subject.frame.apply(result) - base) * normals).sum(axis=1)
    rng = np.random.default_rng(zlib.crc32(run.folder.name.encode()))
    return Laid(base, faces, normals, height, subject.sigma, rng), subject.frame


def altered(run: Run, target: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Write a copy of a run's record with other vertices, in the source's units."""
    target.mkdir(parents=True)
    for name in ("run.json", "status.json"):
        shutil.copy(run.folder / name, target)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    (target / "result.ply").write_bytes(mesh.export(file_type="ply"))


def bumpy_cube() -> trimesh.Trimesh:
    """A cube with five by five bumps on each side."""
    cube = trimesh.creation.box((1.2, 1.2, 1.2))
    vertices, faces = cube.vertices, cube.faces
    for _ in range(6):
        vertices, faces = trimesh.remesh.subdivide(vertices, faces)
    place = np.abs(vertices).argmax(axis=1)
    waves = np.sin(vertices * (5 * np.pi / 1.2) + np.pi / 2) ** 2
    waves[np.arange(len(place)), place] = 1.0
    side = np.zeros_like(vertices)
    side[np.arange(len(place)), place] = np.sign(vertices[np.arange(len(place)), place])
    return trimesh.Trimesh(vertices + 0.08 * waves.prod(axis=1)[:, None] * side, faces)


def learn_cube(folder: Path) -> None:
    """The cube on a cow, learned: sharp edges and no relief that bends."""
    style = folder / "cube" / "cube.ply"
    out = folder / "cube" / "spot_cube"
    if out.exists():
        return
    out.mkdir(parents=True)
    style.write_bytes(bumpy_cube().export(file_type="ply"))
    overrides = ["source=spot", f"style={style}", "method=robust", "profile=fast", "report=false"]
    execute.run(compose(overrides), out, overrides)


def main() -> int:
    """Alter the results below a folder."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="of sweeps/rated.yaml")
    folder = parser.parse_args().folder
    out = folder / "altered"
    learn_cube(folder)
    runs = [run for run in finding.find(folder / "synthesis") if run.status == "done"]
    for number, run in enumerate(runs):
        pair = f"{run.part('source')}_{run.part('style')}"
        kinds = [k for at, k in enumerate(KINDS) if (at + number) % SHARE == 0]
        kinds = [kind for kind in kinds if not (out / kind / pair).exists()]
        if kinds:
            laid, frame = taken_apart(run)
        for kind in kinds:
            moved = frame.invert(KINDS[kind](laid))
            altered(run, out / kind / pair, moved, laid.faces)
            print(out / kind / pair, flush=True)
        for other in runs:
            target = out / "wrong_style" / pair
            same = other is not run and other.part("source") == run.part("source")
            if same and not target.exists():
                target.mkdir(parents=True)
                for name in ("run.json", "status.json"):
                    shutil.copy(run.folder / name, target)
                shutil.copy(other.folder / "result.ply", target)
    return 0


if __name__ == "__main__":
    sys.exit(main())
