"""``logger=tensorboard``."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from torch.utils.tensorboard import SummaryWriter

if TYPE_CHECKING:
    from styleexp.method.base import Result
    from styleexp.plugins.loggers.options import TensorBoardConfig

FOLDER = "tensorboard"
"""Subfolder of the run's folder."""
GREY = 190


class TensorBoard:
    """Writes event files. TensorBoard purges what an interrupted run wrote after its checkpoint."""

    def __init__(
        self, config: TensorBoardConfig, folder: Path, record: Mapping[str, Any], step: int
    ):
        self._mesh, self._step = config.mesh, step
        purge = step + 1 if step else None
        self._writer = SummaryWriter(str(folder / FOLDER), purge_step=purge, flush_secs=10)
        if not step:
            text = json.dumps(dict(record), indent=2, default=str)
            self._writer.add_text("run", f"```json\n{text}\n```", 0)

    def log(self, values: Mapping[str, float], step: int) -> None:
        """Log one scalar per number."""
        self._step = step
        for key, value in values.items():
            self._writer.add_scalar(key, value, step)

    def finish(self, result: Result, folder: Path) -> None:
        """Log the preview, and source and result as meshes in the source's own frame."""
        from PIL import Image

        with Image.open(folder / "preview.png") as opened:
            picture = np.asarray(opened.convert("RGB"))
        self._writer.add_image("preview", picture, self._step, dataformats="HWC")
        if not self._mesh:
            return
        source = result.subject.source
        faces = source.faces[None].astype(np.int32)
        for name, vertices in (("source", source.vertices), ("result", result.vertices)):
            colors = np.full((1, len(vertices), 3), GREY, dtype=np.uint8)
            shape = result.subject.frame.apply(vertices)[None].astype(np.float32)
            self._writer.add_mesh(name, shape, colors, faces, global_step=self._step)

    def close(self, status: str) -> None:
        """Close the event files."""
        self._writer.close()
