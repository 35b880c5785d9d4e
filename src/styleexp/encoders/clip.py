"""CLIP's image tower, for Text2Mesh's loss: one embedding of a whole image, no layers.

Loaded with transformers from a folder provided by the user; nothing is downloaded.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.nn import functional

from styleexp.encoders.base import Encoder
from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from jaxtyping import Float

MEAN = (0.48145466, 0.4578275, 0.40821073)
STD = (0.26862954, 0.26130258, 0.27577711)
"""CLIP's input normalisation (Radford et al. 2021), RGB."""

WANTED = "a folder with config.json and model.safetensors, as transformers saves a CLIP model"


class ClipEncoder(Encoder):
    """Maps images to unit embeddings. Frozen, in fp32; gradients flow to the images."""

    mean: Tensor
    std: Tensor
    name = "clip"

    def __init__(self, tower: Any):
        super().__init__()
        self.tower = tower
        self.size = int(tower.config.image_size)
        self.register_buffer("mean", torch.tensor(MEAN).view(1, 3, 1, 1))
        self.register_buffer("std", torch.tensor(STD).view(1, 3, 1, 1))
        self.requires_grad_(False)
        self.eval()

    def resolve(self, layers: Sequence[str | int]) -> tuple[str, ...]:
        """Raise `UserError`: CLIP has no layers; it only works with ``loss=clip``."""
        raise UserError("encoder=clip has no layers for this loss: use loss=clip with it.")

    def forward(
        self, images: Float[Tensor, "images channels height width"], layers: Sequence[str | int]
    ) -> dict[str, Tensor]:
        """Raise `UserError`, as `resolve` does."""
        return dict.fromkeys(self.resolve(layers), images)

    def embed(
        self, images: Float[Tensor, "images channels height width"]
    ) -> Float[Tensor, "images size"]:
        """Unit embeddings of images in [0, 1], RGB or grey, resized to CLIP's input."""
        size = [self.size, self.size]
        images = functional.interpolate(images, size, mode="bicubic", antialias=True)
        images = (images.expand(-1, 3, -1, -1) - self.mean) / self.std
        return functional.normalize(self.tower(pixel_values=images).image_embeds, dim=1)


def load(path: str, device: str | torch.device) -> ClipEncoder:
    """Load the image tower of a CLIP model in transformers' format.

    Raises `UserError` if the folder has no model, or lacks some of its weights.
    """
    from transformers import CLIPVisionModelWithProjection
    from transformers.utils import logging

    if not (Path(path) / "config.json").is_file():
        raise UserError(f"encoder.weights={path} is not a CLIP model: give {WANTED}.")
    shown, bars = logging.get_verbosity(), logging.is_progress_bar_enabled()
    logging.set_verbosity_error()  # silence warnings about the unused text tower
    logging.disable_progress_bar()
    try:
        tower, loading = CLIPVisionModelWithProjection.from_pretrained(
            path,
            local_files_only=True,
            use_safetensors=True,
            output_loading_info=True,
            dtype=torch.float32,
        )
    except Exception as error:  # many kinds, for damaged, foreign or missing files
        reason = str(error).strip().splitlines() or [type(error).__name__]
        raise UserError(
            f"encoder.weights={path} can't be read ({reason[0].rstrip('.:')}): give {WANTED}."
        ) from error
    finally:
        logging.set_verbosity(shown)
        if bars:
            logging.enable_progress_bar()
    if loading["missing_keys"] or loading["mismatched_keys"]:
        lacks = sorted(map(str, {*loading["missing_keys"], *loading["mismatched_keys"]}))
        raise UserError(
            f"encoder.weights={path} lacks {len(lacks)} of CLIP's image weights, such as "
            f"{lacks[0]}: give {WANTED}."
        )
    return ClipEncoder(tower).to(device)
