"""Published VGG weights, converted to one convention and one file format.

The convention is torchvision's: RGB input in [0, 1], ``(x - mean) / std`` first, cross-correlation
kernels of shape (out, in, 3, 3). Files are safetensors whose header holds the mean, the std, the
weights' origin and a digest of the content, so each file can be verified on its own.
"""

from __future__ import annotations

import io
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from styleexp.system import atomic, digests

FORMAT = "styleexp-vgg-1"
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
CAFFE_MEAN_RGB = (123.68 / 255, 116.779 / 255, 103.939 / 255)

Arrays = dict[str, np.ndarray]


@dataclass(frozen=True)
class VGGWeights:
    """The convolutions of a VGG and the input normalisation that they expect."""

    tensors: Arrays
    """``conv1_1.weight`` (out, in, 3, 3), ``conv1_1.bias`` (out,), ... as float32."""
    mean: tuple[float, ...]
    """Mean of the input, RGB in [0, 1]."""
    std: tuple[float, ...]
    source: str = ""
    """SHA-256 of the published file, or empty."""


class DamagedWeights(Exception):
    """A weights file that can't be read or doesn't match its digest."""


# ---------------------------------------------------------------------------- converters


def from_caffe(tensors: Arrays) -> VGGWeights:
    """Convert Caffe's input convention (BGR, 0-255, mean subtracted) to torchvision's, exactly.

    ``w_rgb[:, c] = w_bgr[:, 2 - c] * 255 * std_c``. The mean stays Caffe's: zero padding happens
    after the subtraction, so another mean could not be folded into the bias at the border.
    """
    first = tensors["conv1_1.weight"].astype(np.float64)
    scale = 255.0 * np.asarray(IMAGENET_STD)[None, :, None, None]
    tensors = {**tensors, "conv1_1.weight": (first[:, ::-1] * scale).astype(np.float32)}
    return VGGWeights(tensors, CAFFE_MEAN_RGB, IMAGENET_STD)


def from_keras_onnx(data: bytes) -> VGGWeights:
    """Keras' VGG-16 as written by tf2onnx: kernels are (out, in, 3, 3), input is Caffe's."""
    import onnx
    from onnx import numpy_helper

    found: Arrays = {}
    for tensor in onnx.load_model_from_string(data).graph.initializer:
        name = re.search(r"block(\d)_conv(\d)\w*/(convolution|Squeeze|BiasAdd)", tensor.name)
        if name is not None:
            kind = "weight" if len(tensor.dims) == 4 else "bias"
            array = np.array(numpy_helper.to_array(tensor), dtype=np.float32)
            found[f"conv{name[1]}_{name[2]}.{kind}"] = array
    return from_caffe(_checked(found, (2, 2, 3, 3, 3)))


def from_keras_hdf5(data: bytes) -> VGGWeights:
    """Keras 3 HDF5 with groups block1..block5: kernels are (3, 3, in, out), input is Caffe's."""
    import h5py

    found: Arrays = {}
    with h5py.File(io.BytesIO(data), "r") as file:
        for block in range(1, 6):
            layers = file[f"block{block}/layers"]
            # conv2d, conv2d_1, conv2d_2: Keras numbers from the second on.
            for layer in sorted(name for name in layers if name.startswith("conv2d")):
                index = int(layer.partition("_")[2] or 0) + 1
                kernel, bias = layers[f"{layer}/vars/0"][()], layers[f"{layer}/vars/1"][()]
                found[f"conv{block}_{index}.weight"] = kernel.transpose(3, 2, 0, 1)
                found[f"conv{block}_{index}.bias"] = bias
    return from_caffe(_checked(found, (2, 2, 3, 3, 3)))


def from_torchvision(path: str | Path) -> VGGWeights:
    """torchvision's VGG-19 state dict; only the convolutions (``features.*``) are kept."""
    import torch

    # The published file uses torch's 2017 format, which can't be memory-mapped.
    state = torch.load(path, map_location="cpu", weights_only=True)
    indices = sorted(
        {int(key.split(".")[1]) for key in state if re.fullmatch(r"features\.\d+\.weight", key)}
    )
    names = layer_names((2, 2, 4, 4, 4))
    if len(indices) != len(names):
        raise DamagedWeights(f"{len(indices)} convolutions where VGG-19 has {len(names)}")
    found = {
        f"{name}.{kind}": state[f"features.{index}.{kind}"].float().numpy()
        for name, index in zip(names, indices, strict=True)
        for kind in ("weight", "bias")
    }
    return VGGWeights(_checked(found, (2, 2, 4, 4, 4)), IMAGENET_MEAN, IMAGENET_STD)


def layer_names(convs_per_block: tuple[int, ...]) -> tuple[str, ...]:
    """conv1_1, conv1_2, conv2_1, ... in the order of the network."""
    return tuple(
        f"conv{block}_{index}"
        for block, count in enumerate(convs_per_block, start=1)
        for index in range(1, count + 1)
    )


def _checked(found: Arrays, convs_per_block: tuple[int, ...]) -> Arrays:
    """Validate a complete, finite VGG; return it as contiguous float32, in the network's order."""
    names = layer_names(convs_per_block)
    wanted = [f"{name}.{kind}" for name in names for kind in ("weight", "bias")]
    if missing := sorted(set(wanted) - set(found)):
        raise DamagedWeights(f"lacks {', '.join(missing)}")
    channels = 3
    for name in names:
        weight, bias = found[f"{name}.weight"], found[f"{name}.bias"]
        if weight.shape != (bias.size, channels, 3, 3):
            raise DamagedWeights(f"{name} has shape {weight.shape}")
        if not (np.isfinite(weight).all() and np.isfinite(bias).all()):
            raise DamagedWeights(f"{name} holds values that are not finite")
        channels = bias.size
    return {key: np.ascontiguousarray(found[key], dtype=np.float32) for key in wanted}


# ------------------------------------------------------------------------------ the file


def write(path: str | Path, weights: VGGWeights, source: str, credit: str) -> None:
    """Write a safetensors file atomically: readers see the old file or the complete new one.

    Args:
        path: the file; its folder exists.
        weights: what to store.
        source: SHA-256 of the published file it was made from.
        credit: author and licence, kept with the copy.
    """
    from safetensors.numpy import save

    normalisation = {"mean": list(weights.mean), "std": list(weights.std), "source": source}
    metadata = {
        "format": FORMAT,
        "credit": credit,
        "normalisation": json.dumps(normalisation),
        "digest": digests.of(weights.tensors, json.dumps(normalisation)),
    }
    data = save(weights.tensors, metadata)
    atomic.write(Path(path), atomic.data(data))


def read(path: str | Path) -> VGGWeights:
    """Read and verify a file that :func:`write` made.

    Raises:
        DamagedWeights: truncated, altered, or a different kind of file. OSError: the file is
        missing or not readable.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load

    data = Path(path).read_bytes()
    try:
        metadata = _metadata(data)
        normalisation = json.loads(metadata["normalisation"])
        tensors = load(data)
        whole = digests.of(tensors, metadata["normalisation"]) == metadata["digest"]
    except (SafetensorError, ValueError, KeyError, TypeError) as error:
        raise DamagedWeights(f"not readable ({type(error).__name__})") from error
    if metadata.get("format") != FORMAT:
        raise DamagedWeights(f"its format is {metadata.get('format')!r}, not {FORMAT!r}")
    if not whole:
        raise DamagedWeights("its content does not match its digest")
    mean, std = tuple(normalisation["mean"]), tuple(normalisation["std"])
    return VGGWeights(tensors, mean, std, normalisation["source"])


def _metadata(data: bytes) -> dict[str, Any]:
    # safetensors reads metadata only from a named file; the layout is 8 bytes of length, then JSON.
    length = int.from_bytes(data[:8], "little")
    return json.loads(data[8 : 8 + length])["__metadata__"]
