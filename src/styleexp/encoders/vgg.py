"""A frozen VGG that returns all requested layers in one pass."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from styleexp.encoders import fused
from styleexp.encoders.base import Encoder
from styleexp.inputs.weights import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    VGGWeights,
    layer_names,
)
from styleexp.system.errors import UserError, unknown_name
from styleexp.system.process import has_onednn

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

log = logging.getLogger(__name__)

VGG16_CONVS = (2, 2, 3, 3, 3)
VGG19_CONVS = (2, 2, 4, 4, 4)
CHANNELS = (64, 128, 256, 512, 512)
PAPER_LAYERS = layer_names(VGG19_CONVS)
"""Layers by the paper's index: i is PAPER_LAYERS[i - 1], so 1 = conv1_1, 5 = conv3_1, 13 =
conv5_1."""
PAPER_MEAN = (0.481, 0.458, 0.408)
PAPER_STD = (0.268, 0.261, 0.276)

_PRECISION_NAMES = {torch.float32: "fp32", torch.bfloat16: "bf16", torch.float64: "fp64"}


class VGG(Encoder):
    """VGG activations by layer name.

    The network consists of 3x3 convolutions with zero padding 1, ReLU, and 2x2 pooling between
    blocks. Activations are taken *after* the ReLU, unless ``activations`` is ``conv``, in the
    compute dtype (``precision``). Weights are frozen; gradients flow to the images.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        name: str,
        weights: VGGWeights,
        *,
        pooling: str = "max",
        activations: str = "relu",
        mean: Sequence[float] | None = None,
        std: Sequence[float] | None = None,
    ) -> None:
        """Build it in fp32 on the CPU.

        Args:
            name: name in messages and records.
            weights: convolutions ``convB_I`` in torchvision's convention.
            pooling: ``max`` or ``avg``.
            activations: ``relu``, or ``conv`` for those before the ReLU.
            mean: input normalisation, RGB. Default: that of the weights.
            std: likewise.
        """
        super().__init__()
        self.name = name
        self.pooling = pooling
        self.activations = activations
        self.layer_names = tuple(
            sorted({key.partition(".")[0] for key in weights.tensors}, key=_position)
        )
        self.convs = nn.ModuleDict()
        for layer in self.layer_names:
            weight = torch.from_numpy(weights.tensors[f"{layer}.weight"])
            bias = torch.from_numpy(weights.tensors[f"{layer}.bias"])
            conv = nn.utils.skip_init(
                nn.Conv2d, weight.shape[1], weight.shape[0], kernel_size=3, padding=1
            )
            conv.load_state_dict({"weight": weight, "bias": bias})
            self.convs[layer] = conv
        self.register_buffer("mean", torch.tensor(mean or weights.mean).view(1, 3, 1, 1))
        self.register_buffer("std", torch.tensor(std or weights.std).view(1, 3, 1, 1))
        self.requires_grad_(False)
        self.eval()
        self._turned: dict[str, tuple[Any, Tensor]] = {}

    @property
    def precision(self) -> str:  # type: ignore[override]
        """Compute precision, ``fp32`` or ``bf16``, derived from the weights' dtype."""
        dtype = next(self.convs.parameters()).dtype
        return _PRECISION_NAMES.get(dtype, str(dtype))

    def resolve(self, layers: Sequence[str | int]) -> tuple[str, ...]:
        """Resolve names, and the paper's 1-based convolution indices of VGG-19, to layer names.

        The paper's [1, 3, 5, 9, 13] is conv1_1, conv2_1, conv3_1, conv4_1, conv5_1 for every
        encoder: an index means the name, not the position in a shallower network.

        Raises:
            UserError: a layer that this encoder doesn't have, a duplicate, or an empty list.
        """
        names: list[str] = []
        for layer in [layers] if isinstance(layers, str) else layers:
            text = str(layer)
            if text.isdecimal():
                if not 1 <= int(text) <= len(PAPER_LAYERS):
                    raise UserError(
                        f"there is no convolution {text}: the paper counts VGG-19's from 1 "
                        f"(conv1_1) to {len(PAPER_LAYERS)} (conv5_4)."
                    )
                text = PAPER_LAYERS[int(text) - 1]
            if text not in self.layer_names:
                if text in PAPER_LAYERS:
                    raise UserError(
                        f"the encoder '{self.name}' has no layer {text}; "
                        f"it has {', '.join(self.layer_names)}."
                    )
                raise unknown_name(f"layer of the encoder '{self.name}'", text, self.layer_names)
            if text in names:
                raise UserError(f"the layer {text} is given twice in {list(layers)}.")
            names.append(text)
        if not names:
            raise UserError(
                f"no encoder layer is given; '{self.name}' has {', '.join(self.layer_names)}."
            )
        return tuple(names)

    def stride(self, layer: str | int) -> int:
        """Pixels per cell, per side: 1 in block 1 to 16 in block 5.

        Cell (i, j) sits on pixels [i s, (i + 1) s) x [j s, (j + 1) s); ``size // s`` cells fit, and
        the pixels left over at the bottom and right only reach into them through the convolutions.
        """
        (name,) = self.resolve([layer])
        return 2 ** (_position(name)[0] - 1)

    def forward(
        self,
        images: Float[Tensor, "images channels height width"],
        layers: Sequence[str | int],
    ) -> dict[str, Float[Tensor, "images features rows columns"]]:
        """Run up to the deepest requested layer and return the activations of all requested layers.

        Args:
            images: in [0, 1]; RGB, or grey (one channel, used as R = G = B).
            layers: names or the paper's indices.

        Returns:
            Name -> activations (see the class) in the compute dtype, in the order of ``layers``;
            rows are ``height // stride``. Don't modify them: the backward pass needs them.

        Raises:
            UserError: an unknown layer, or images too small for the deepest layer.
            ValueError: a wrong shape or an integer dtype.
        """
        names = self.resolve(layers)
        x, run = self._prepare(images, names)
        served: dict[str, Tensor] = {}
        for before, layer in itertools.pairwise((run[0], *run)):
            if _position(layer)[0] != _position(before)[0]:
                pool = functional.max_pool2d if self.pooling == "max" else functional.avg_pool2d
                x = pool(x, 2)
            x = self.convs[layer](x)
            if self.activations == "conv":
                served[layer], x = x, x.relu()
            else:
                # In place on the convolution's output, which is not needed elsewhere; the next
                # layer makes a new tensor, so returned activations stay intact.
                served[layer] = x = x.relu_()
        return {name: served[name] for name in names}

    @property
    def is_fused(self) -> bool:
        """Whether `gram_sums` can be used: on a CPU with oneDNN, after the ReLU, in fp32 or
        bf16."""
        weight = next(self.convs.parameters())
        return has_onednn(weight) and self.activations == "relu" and weight.dtype in fused.BITS

    def gram_sums(
        self,
        images: Float[Tensor, "images channels height width"],
        masks: Mapping[str, Bool[Tensor, "images rows columns"] | None],
    ) -> dict[str, Float[Tensor, "features features"]]:
        """F^T F of the activations of ``forward``, without keeping them, which is much cheaper.

        Args:
            images: as for ``forward``.
            masks: cells to sum, for each layer by its resolved name; None means all.

        Returns:
            Name -> sum over images and cells in float32, in the order of ``masks``. Backward can
            only run once.

        Raises:
            The same as ``forward``.
        """
        x, run = self._prepare(images, tuple(masks))
        blocks = [
            [self._layer(name) for name in block]
            for _, block in itertools.groupby(run, lambda name: _position(name)[0])
        ]
        found = fused.GramSums.apply(x, blocks, masks, self.pooling)
        return dict(zip(masks, found, strict=True))

    def _layer(self, name: str) -> fused.Layer:
        """A convolution for `gram_sums`, with a cached transposed kernel."""
        weight, bias = (self.convs[name].get_parameter(each) for each in ("weight", "bias"))
        now = weight.data_ptr(), weight._version, weight.dtype
        if name not in self._turned or self._turned[name][0] != now:
            back = weight.detach().flip(2, 3).transpose(0, 1)
            self._turned[name] = now, back.contiguous(memory_format=torch.channels_last)
        return fused.Layer(name, weight, bias, self._turned[name][1])

    def _prepare(self, images: Tensor, names: tuple[str, ...]) -> tuple[Tensor, tuple[str, ...]]:
        """Normalised images in the compute dtype, channels last, and the layers to run."""
        if images.ndim != 4 or images.shape[1] not in (1, 3) or not images.is_floating_point():
            raise ValueError(
                "images must be floats of shape (images, 1 or 3, height, width), not "
                f"{images.dtype} of shape {tuple(images.shape)}"
            )
        deepest = max(names, key=_position)
        height, width = images.shape[2:]
        if min(height, width) < self.stride(deepest):
            raise UserError(
                f"images of {width}x{height} pixels are too small for the layer {deepest} of "
                f"'{self.name}': it needs at least {self.stride(deepest)} pixels on each side."
            )
        dtype = next(self.convs.parameters()).dtype
        # Normalise before rounding to the compute dtype, so that bf16 is most precise near the
        # mean. A grey image becomes three channels here; collapsing the first kernel instead saves
        # no time.
        x = ((images - self.mean) / self.std).to(dtype, memory_format=torch.channels_last)
        return x, self.layer_names[: self.layer_names.index(deepest) + 1]


def _position(layer: str) -> tuple[int, int]:
    """(block, index) of ``convB_I``."""
    block, index = layer.removeprefix("conv").split("_")
    return int(block), int(index)


def build(
    name: str,
    weights: VGGWeights,
    *,
    precision: str = "auto",
    pooling: str = "max",
    activations: str = "relu",
    normalisation: str = "weights",
    device: str | torch.device = "cpu",
) -> VGG:
    """Build a `VGG` in its final precision and on its device.

    Args:
        name: name in messages and records.
        weights: its convolutions.
        precision: ``fp32``, ``bf16``, or ``auto`` (bf16 if this processor is faster with it).
            ``VGG.precision`` holds the choice.
        pooling: ``max`` as trained, or ``avg`` (Gatys et al. 2016).
        activations: after the ReLU (``relu``) or before it (``conv``).
        normalisation: ``weights`` uses the mean and std that the network was trained with,
            ``paper`` the paper's mean (0.481, 0.458, 0.408) and std (0.268, 0.261, 0.276).
        device: device of the encoder.
    """
    device = torch.device(device)
    paper = normalisation == "paper"
    encoder = VGG(
        name,
        weights,
        pooling=pooling,
        activations=activations,
        mean=PAPER_MEAN if paper else None,
        std=PAPER_STD if paper else None,
    )
    chosen = fastest_precision(device) if precision == "auto" else precision
    if chosen == "bf16":
        if precision == "bf16" and fastest_precision(device) != "bf16":
            log.warning("bf16 was requested, but this %s is not faster with it.", device.type)
        encoder.convs.to(torch.bfloat16)
    # The fast convolutions need channels_last; only 4-D tensors change their layout.
    encoder.convs.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return encoder.to(device, non_blocking=True)


def fastest_precision(device: torch.device) -> str:
    """``bf16`` if the hardware multiplies it natively, else ``fp32``.

    Measured for VGG-16 to conv5_1, five 250x250 images, forward and input gradient, on two cores
    with AMX: 0.3 s in bf16, 1.3 s in fp32. Without AMX or AVX512-BF16 bf16 is emulated and slower.
    """
    if device.type == "cuda":
        return "bf16" if torch.cuda.is_bf16_supported(including_emulation=False) else "fp32"
    if device.type == "cpu":
        checks = ("_is_amx_tile_supported", "_is_avx512_bf16_supported")
        if any(getattr(torch.cpu, check, bool)() for check in checks):
            return "bf16"
    return "fp32"


def random_weights(convs_per_block: Sequence[int], seed: int) -> VGGWeights:
    """He-initialised convolutions from a separate generator; biases are zero."""
    generator = np.random.default_rng(seed)
    tensors: dict[str, np.ndarray] = {}
    fan_in = 3
    for layer in layer_names(tuple(convs_per_block)):
        channels = CHANNELS[_position(layer)[0] - 1]
        weight = generator.standard_normal((channels, fan_in, 3, 3), dtype=np.float32)
        tensors[f"{layer}.weight"] = weight * np.float32(np.sqrt(2 / (9 * fan_in)))
        tensors[f"{layer}.bias"] = np.zeros(channels, np.float32)
        fan_in = channels
    return VGGWeights(tensors, IMAGENET_MEAN, IMAGENET_STD)
