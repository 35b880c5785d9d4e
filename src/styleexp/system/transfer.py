"""Tensors from a device to the host, all in one copy, since the host waits for each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor


def to_host(tensors: Sequence[Tensor]) -> list[Tensor]:
    """The tensors on the CPU, detached and contiguous, of any dtypes and shapes. Those that are
    there already aren't copied."""
    import torch

    found = [each.detach().contiguous() for each in tensors]
    away = [i for i, each in enumerate(found) if each.device.type != "cpu"]
    if away:
        parts = [found[i].flatten().view(torch.uint8) for i in away]
        sizes = [part.numel() for part in parts]
        for i, part in zip(away, torch.cat(parts).cpu().split(sizes), strict=True):
            # A copy, because a dtype's view must begin at a multiple of its size.
            found[i] = part.clone().view(found[i].dtype).view(found[i].shape)
    return found
