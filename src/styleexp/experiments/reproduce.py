"""Make a run again from its own record, in a new folder, and compare the results."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from styleexp.experiments import execute
from styleexp.experiments.sweeps import claim
from styleexp.inputs import measured
from styleexp.runs import identity, origins, provenance, reading, records, results
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np
    import torch

    from styleexp.config.schema import Config
    from styleexp.runs.reading import Run

SAME, DIFFERENT = 0, 1
"""Exit codes: everything is equal; the run was made again and something isn't."""
HOME = Path("outputs/reproduced")
"""Where new folders are made by default."""


class Compared(NamedTuple):
    """How far two results are equal."""

    vertices: str | None
    """What differs of the vertices; None if they have the same bits and faces."""
    metrics: list[tuple[str, Any, Any]]
    """Each metric's name with its first and second value; None where it is missing."""

    @property
    def equal(self) -> bool:
        """Whether all is equal."""
        return self.vertices is None and all(_same(old, new) for _, old, new in self.metrics)


def reproduce(folder: Path, out: Path | None = None) -> int:
    """Make the run in ``folder`` again in ``out`` (default: a new folder below `HOME`), and print
    what differs from then and what came out equal.

    The run's own folder is only read. Returns `SAME`, `DIFFERENT`, or the code of a run that was
    stopped. Raises `UserError` if there is no such result, if an input or a plugin isn't what it
    was, and if ``out`` is in use.
    """
    run = reading.recorded(folder, "reproduce")
    if run.status == "running":
        raise UserError(f"cannot reproduce '{folder}': it is still running; wait until it is done.")
    if not (folder / results.NAME).is_file():
        raise UserError(
            f"cannot reproduce '{folder}': it has no {results.NAME} to compare with; a stopped run "
            "goes on with styleexp resume=FOLDER."
        )
    if out is not None and out.resolve().is_relative_to(folder.resolve()):
        raise UserError(f"'{out}' is in the run's own folder: give another folder with --out.")
    if out is not None and (out.exists() or out.is_symlink()) and not _is_empty(out):
        raise UserError(f"'{out}' exists and isn't empty: give another folder with --out.")
    config = origins.restored(run.record, folder, "reproduce", print)
    _check_plugins(config, run)
    as_recorded(config, run.record)
    tell_differences(run, _here(config, run))
    here = folder.absolute()
    pair = "" if here.parent.name == HOME.parent.name else here.parent.name
    new = out or claim.fresh(HOME / pair / here.name)
    command = ["styleexp", "reproduce", str(folder)]
    with measured.anew():
        code = execute.run(config, new, run.overrides, command=command)
    if code:
        return code
    return tell_results(run, reading.read(new), config)


def as_recorded(config: Config, record: dict[str, Any]) -> None:
    """Set what a run chose by itself, and what its bits may depend on, as it chose it; leave out
    loggers, whose stores are not the run's folder."""
    config.logger = {}
    threads = record.get("threads")
    if isinstance(threads, int) and threads > 0:
        config.threads = threads
    precision = record.get("encoder_precision")
    if getattr(config.encoder, "precision", None) == "auto" and isinstance(precision, str):
        config.encoder.precision = precision
    device = record.get("device")
    if config.device == "auto" and isinstance(device, str) and _is_there(device):
        config.device = device


def compare(old: Run, new: Run, config: Config) -> Compared:
    """Compare the results in two runs' folders; `UserError` if one can't be read."""
    first, second = (results.read(each.folder / results.NAME) for each in (old, new))
    names = dict.fromkeys([*old.measured, *new.measured])
    metrics = [(name, old.measured.get(name), new.measured.get(name)) for name in names]
    return Compared(_apart(first, second, config), metrics)


def tell_differences(run: Run, here: Mapping[str, Any]) -> None:
    """Print what is reproduced, and what isn't as it was: ``here`` is this process's record."""
    took = f", {run.seconds:.0f} s then" if run.seconds is not None else ""
    print(f"reproducing {run.folder}: {run.title}{took}")
    for kind, asset in (run.record.get("assets") or {}).items():
        name, digest = asset.get("path") or asset.get("name"), asset.get("sha256")
        told = f"sha256 {digest[: provenance.DIGITS]}, as then" if digest else "no file"
        print(f"{kind}: {name} ({told})")
    known, now = provenance.made_with(run.record), provenance.made_with(here)
    if apart := provenance.differences(run.record, here):
        print("differs from then:")
        for each in apart:
            print(f"  {each.name}: {each.then} then, {each.now} now")
    else:
        names = ("styleexp", "commit", "torch", "device", "threads")
        shown = ", ".join(f"{name} {known[name]}" for name in names if name in known)
        print(f"made with what it was made with then: {shown}")
    if unknown := [name for name in now if name not in known]:
        print(f"not recorded then: {', '.join(unknown)}")


def tell_results(old: Run, new: Run, config: Config) -> int:
    """Print what is equal and what isn't; return the exit code."""
    found = compare(old, new, config)
    print(f"\n{old.folder} and {new.folder}:")
    print(f"  vertices: {found.vertices or 'the same bits'}")
    width = max((len(name) for name, *_ in found.metrics), default=0)
    for name, first, second in found.metrics:
        told = "equal" if _same(first, second) else f"{_shown(first)} then, {_shown(second)} now"
        print(f"  {name.ljust(width)}  {told}")
    if not found.metrics:
        print("  no metrics: neither run measured its result")
    print("reproduced: all is equal" if found.equal else "not reproduced: the results differ")
    return SAME if found.equal else DIFFERENT


def _check_plugins(config: Config, run: Run) -> None:
    """Raise `UserError` if a plugin's code has changed; one that the record has no hash of can't be
    checked, which is told."""
    for name in identity.edited(config, run.record):
        before = [
            each for each in run.record.get("plugins") or ()
            if f"{each.get('kind')}={each.get('name')}" == name
        ]  # fmt: skip
        if not before or not before[0].get("sha256"):
            print(f"note: the record has no hash of the plugin {name}: it may have changed")
            continue
        where, digest = before[0].get("file"), before[0]["sha256"][: provenance.DIGITS]
        raise UserError(
            f"cannot reproduce '{run.folder}': the code of the plugin {name} ('{where}') has "
            f"changed since (sha256 {digest}... then): restore it, or make a new run."
        )


def _here(config: Config, run: Run) -> dict[str, Any]:
    """A record of this process, with the device that the run will use."""
    from styleexp.config import build
    from styleexp.system import process

    device = build.device_of(config)
    found = records.environment(config) | {"device": _numbered(device), "threads": config.threads}
    if gpu := process.gpu(device):
        found["gpu"] = gpu
    weights = origins.noted(config, run.record.get("weights") or {})["weights"]
    return found | {"weights": weights}


def _is_there(device: str) -> bool:
    import torch

    return not device.startswith("cuda") or torch.cuda.is_available()


def _numbered(device: torch.device) -> str:
    """A device as tensors on it name it."""
    import torch

    if device.type == "cuda" and device.index is None:
        return f"cuda:{torch.cuda.current_device()}"
    return str(device)


def _is_empty(folder: Path) -> bool:
    return folder.is_dir() and not any(folder.iterdir())


def _apart(first: results.Stored, second: results.Stored, config: Config) -> str | None:
    import numpy as np

    if first.vertices.shape != second.vertices.shape:
        return f"{len(first.vertices)} then, {len(second.vertices)} now"
    if not np.array_equal(first.faces, second.faces):
        return f"equally many ({len(first.vertices)}), but with other faces"
    if _bits(first.vertices) == _bits(second.vertices):
        return None
    from styleexp.config import sources
    from styleexp.inputs import meshes

    radius = meshes.normalisation(sources.load_source(config.source).vertices).scale
    apart = np.linalg.norm(second.vertices - first.vertices, axis=1)
    moved = int((apart > 0).sum())
    return (
        f"{moved} of {len(apart)} differ, by up to {apart.max() / radius:.3g} radii of the source"
    )


def _bits(vertices: np.ndarray) -> bytes:
    return vertices.tobytes()


def _same(first: Any, second: Any) -> bool:
    if isinstance(first, float) and isinstance(second, float):
        return first == second or (math.isnan(first) and math.isnan(second))
    return type(first) is type(second) and first == second


def _shown(value: Any) -> str:
    return "none" if value is None else f"{value!r}"
