"""The contract of an encoder: images in, features by layer out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING

from torch import nn

from styleexp.system.errors import UserError

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor


class Encoder(nn.Module, ABC):
    """A frozen network that describes images. `testing.check_encoder` checks all of this.

    Its parameters don't require gradients; gradients flow to the images. It has no state beyond its
    weights, so the same images give the same features. An encoder is moved with ``to(device)``.
    """

    name: str = "encoder"
    """Name in messages and records."""
    precision: str = "fp32"
    """Dtype it computes in, ``fp32`` or ``bf16``; recorded with the run. With ``bf16`` the field's
    hidden layers run in it too."""

    def resolve(self, layers: Sequence[str | int]) -> tuple[str, ...]:
        """Names of the requested layers, in this order. An integer is the paper's 1-based index of
        a convolution of VGG-19.

        Raises `UserError` for a layer it doesn't have, a duplicate, or an empty list. The default
        has no layer.
        """
        raise UserError(f"encoder={self.name} has no layers: use a loss that needs none.")

    @abstractmethod
    def forward(
        self, images: Float[Tensor, "images channels height width"], layers: Sequence[str | int]
    ) -> dict[str, Float[Tensor, "images features rows columns"]]:
        """Features of the requested layers, by resolved name, in the order requested.

        ``images`` are in [0, 1], RGB or grey (one channel), in any size. Cells are spread evenly
        over the image, row 0 at the top: a masked loss takes a layer's rows for equal parts of the
        image's height.
        """
