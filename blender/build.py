"""Pack the extension: ``python blender/build.py``, with equal bytes for equal sources."""

from __future__ import annotations

import tomllib
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / "blender" / "extension"


def build(target: Path) -> Path:
    """Write ``styleexp-blender-VERSION.zip`` into a folder; return its path."""
    version = tomllib.loads((FOLDER / "blender_manifest.toml").read_text())["version"]
    package = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    if version != package:
        raise SystemExit(f"the extension's version is {version}, the package's {package}.")
    target.mkdir(parents=True, exist_ok=True)
    path = target / f"styleexp-blender-{version}.zip"
    files = [*FOLDER.glob("*.py"), FOLDER / "blender_manifest.toml", ROOT / "LICENSE"]
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(files, key=lambda each: each.name):
            entry = zipfile.ZipInfo(file.name, (1980, 1, 1, 0, 0, 0))
            entry.compress_type, entry.create_system = zipfile.ZIP_DEFLATED, 3
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, file.read_bytes())
    return path


if __name__ == "__main__":
    print(build(ROOT / "dist").relative_to(ROOT))
