"""Pictures that tests draw."""

from pathlib import Path

import numpy as np
from PIL import Image


def grain(path: Path, size: int) -> Path:
    """A square picture of soft grain, ``size`` pixels a side."""
    coarse = np.random.default_rng(0).integers(0, 255, (size // 20, size // 20), dtype=np.uint8)
    Image.fromarray(coarse).resize((size, size), Image.Resampling.BICUBIC).save(path)
    return path
