"""Digests of named tensors; safetensors files have no checksum of their own."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np


def of(tensors: Mapping[str, Any], about: str = "") -> str:
    """SHA-256, as hex, of NumPy arrays or torch tensors with their names and shapes, sorted by
    name, and of the text ``about``."""
    digest = hashlib.sha256(about.encode())
    for name in sorted(tensors):
        digest.update(f"{name}{tuple(tensors[name].shape)}".encode())
        digest.update(_bytes(tensors[name]))
    return digest.hexdigest()


def _bytes(tensor: Any) -> memoryview:
    if isinstance(tensor, np.ndarray):
        return np.ascontiguousarray(tensor).data
    import torch

    flat = tensor.detach().cpu().contiguous().flatten()
    return flat.view(torch.uint8).numpy().data  # numpy has no bfloat16
