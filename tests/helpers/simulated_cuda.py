"""A CUDA device that isn't there: run code with ``device=cuda`` on a CPU-only build of torch.

What code puts on ``cuda`` is a `CudaTensor`: to torch, its autograd included, it is on ``cuda:0``;
inside is a CPU tensor with the numbers. Every operation passes a mode, which computes it there and

- raises what torch raises on a GPU: for tensors of two devices, a CPU generator, ``.numpy()``, an
  operator that only CPUs have (``torch.ops.mkldnn.*``), ``cuda:7``, or an antialiased downscaling
  that CUDA's kernel can't do;
- notes where the host waits for the device (`Wait`), forward and backward: it reads a number,
  copies (blocking copies wait, those to the device too), or needs a size that only the device
  knows (``nonzero``, a mask as index, ``unique``, ``bincount``, ``repeat_interleave``);
- counts kernels by the line that launches them: each takes a GPU's host 5 to 10 microseconds.

::

    with simulate(watch="/mypackage/") as gpu:
        run(device="cuda")
        print(gpu.table())          # who waits, how often, forward or backward
        gpu.reset()                 # count what comes next by itself

``pytest -p simulated_cuda tests/test_x.py`` gives all tests the device, those that are skipped
where there is no CUDA as well; ``torch.cuda.set_sync_debug_mode`` does what it should. Import it
before torch's first backward pass. ``test_simulated_cuda.py`` tests it.

The device is made known to torch by some lines of C++, compiled at import in two seconds: there
must be a compiler (``c++`` or ``$CXX``). Tried with torch 2.13 on Linux; it relies on what torch
doesn't promise to keep.

What it can't tell: time and memory; other rounding (TF32, other orders of summation, atomics by
which two runs differ); races between streams; the strides of CUDA's results; data types that a
CUDA kernel lacks (`without_cuda` knows operators that have none at all); other processes. There is
one device, without ``torch.Generator(device="cuda")``, streams, events, and changes of a shape in
place.
"""

from __future__ import annotations

import contextlib
import copy
import ctypes
import math
import os
import subprocess
import sys
import tempfile
import threading
import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import torch
import torch._dynamo  # imported by and by in any case, it would stumble over what is patched
from torch.optim import optimizer
from torch.utils import _foreach_utils
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

DEVICE = """
#include <ATen/detail/CUDAHooksInterface.h>
#include <c10/core/impl/DeviceGuardImplInterface.h>
using c10::Device, c10::DeviceType, c10::Stream;
struct Guard : c10::impl::NoOpDeviceGuardImpl<DeviceType::CUDA> {
  Device getDevice() const override { return Device(DeviceType::CUDA, 0); }
  Device exchangeDevice(Device) const override { return getDevice(); }
  Stream getStream(Device) const noexcept override { return Stream(Stream::DEFAULT, getDevice()); }
};
C10_REGISTER_GUARD_IMPL(CUDA, Guard)
struct Hooks : at::CUDAHooksInterface {
  bool isBuilt() const override { return true; }
  bool hasPrimaryContext(c10::DeviceIndex) const override { return true; }
};
// torch made its own long ago, which say that there is no CUDA. Neither holds any data.
static auto* hooks = new (const_cast<at::CUDAHooksInterface*>(&at::detail::getCUDAHooks())) Hooks;
"""
"""What a CPU-only torch lacks to name a CUDA tensor's device and stream, as autograd does."""

READS, SIZE = "reads a number", "size"
WAITS = {
    **dict.fromkeys(("_local_scalar_dense", "equal"), (READS, 1)),
    **dict.fromkeys(("nonzero", "masked_select", "_unique", "_unique2", "unique_dim"), (SIZE, 1)),
    **dict.fromkeys(("unique_consecutive", "unique_dim_consecutive"), (SIZE, 1)),
    "bincount": (SIZE, 2),  # the least, to refuse negative numbers, and the most
    "repeat_interleave": (SIZE, 2),  # the sum, and whether any is negative
    "_linalg_check_errors": ("error check", 1),
}
"""Operators that tell the host something of the device: what, and how often it waits."""
NO_KERNEL = {"detach", "alias", "lift_fresh", "empty", "empty_like", "empty_strided", "new_empty"}
INDEXING = {"index", "index_put", "index_put_", "_index_put_impl_"}
ZERO_DIM = {"fill", "fill_", "masked_fill", "masked_fill_", "where", "index_fill", "index_fill_"}
"""Besides pointwise ones, operators that take a CPU tensor without dimensions as a number."""


class Wait(NamedTuple):
    """The host waits for the device."""

    why: str
    operator: str
    where: str
    """``file:line function``, the innermost that is watched."""
    backward: bool


class CudaTensor(torch.Tensor):
    """A tensor on the simulated device; ``on_cpu`` holds its numbers."""

    on_cpu: torch.Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, on_cpu: torch.Tensor) -> CudaTensor:
        made = torch.Tensor._make_wrapper_subclass(
            cls, on_cpu.shape, strides=on_cpu.stride(), storage_offset=on_cpu.storage_offset(),
            dtype=on_cpu.dtype, device="cuda:0",
        )  # fmt: skip
        made.on_cpu = on_cpu
        return made

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        raise RuntimeError(f"{func} on a simulated CUDA tensor outside of simulate()")

    def numpy(self, **_: Any) -> Any:
        raise TypeError(
            "can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() to copy the tensor "
            "to host memory first."
        )

    def __array__(self, *_: Any, **__: Any) -> Any:
        return self.numpy()

    def tolist(self) -> Any:
        return self.detach().cpu().tolist()

    def data_ptr(self) -> int:
        return self.on_cpu.data_ptr()

    def untyped_storage(self) -> Any:
        return self.on_cpu.untyped_storage()

    def __deepcopy__(self, memo: Any) -> CudaTensor:
        made = CudaTensor(self.on_cpu.clone()).requires_grad_(self.requires_grad)
        rest = {name: value for name, value in vars(self).items() if name != "on_cpu"}
        made.__dict__.update(copy.deepcopy(rest, memo))
        return memo.setdefault(id(self), made)

    def __repr__(self, **_: Any) -> str:
        return f"simulated_cuda({self.on_cpu})"

    def __format__(self, how: str) -> str:
        return format(self.item() if self.dim() == 0 and how else repr(self), how)


class Simulation(TorchDispatchMode):
    """The mode that computes, refuses and counts; made by `simulate`."""

    def __init__(self, watch: str):
        super().__init__()
        self.watch, self.random, self.debug = watch, torch.Generator(), 0
        self.reset()

    def reset(self) -> None:
        """Forget what was counted."""
        self.waits: list[Wait] = []
        self.kernels: Counter[str] = Counter()
        self.operators: set[str] = set()

    def table(self) -> str:
        """The waits by line, as Markdown."""
        rows = Counter((*w[2::-1], "backward" if w.backward else "forward") for w in self.waits)
        lines = [f"| {count} | {' | '.join(row)} |" for row, count in sorted(rows.items())]
        return "\n".join(["| waits | line | operator | why | pass |", "|" + " --- |" * 5, *lines])

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # nothing is compiled, so nothing need be kept from it

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        kwargs.pop("pin_memory", None)
        namespace, _, name = func._schema.name.partition("::")
        tensors = [x for x in tree_leaves((args, kwargs)) if isinstance(x, torch.Tensor)]
        there = {id(x.on_cpu): x for x in tensors if isinstance(x, CudaTensor)}
        target = kwargs.get("device")
        target = None if target is None else torch.device(target)
        to_cuda = target is not None and target.type == "cuda"
        if not there and not to_cuda:
            return func(*args, **kwargs)
        if to_cuda and (target.index or 0) > 0:
            raise RuntimeError("CUDA error: invalid device ordinal")
        if namespace not in ("aten", "prim", "prims") or "mkldnn" in name:
            told = f"Could not run '{namespace}::{name}' with arguments from the 'CUDA' backend."
            raise NotImplementedError(told)
        _check_devices(func, name, args, tensors)
        _check_limits(name, args)
        self.operators.add(str(func))
        self._count(func, name, args, kwargs, target)

        inner, named = tree_map(lambda x: getattr(x, "on_cpu", x), (args, kwargs))
        if to_cuda:
            named["device"] = torch.device("cpu")
        found = self._drawn(func, inner, named)
        if any(x.on_cpu.shape != x.shape for x in there.values()):
            raise NotImplementedError(f"{func} changed a shape in place")
        to_cpu = target is not None and target.type == "cpu"
        if to_cpu or (name == "copy_" and not isinstance(args[0], CudaTensor)):
            return found

        def given_back(x: Any) -> Any:
            """What was written into is given back itself."""
            if not isinstance(x, torch.Tensor):
                return x
            return there[id(x)] if id(x) in there else CudaTensor(x)

        return tree_map(given_back, found)

    def _drawn(self, func: Any, args: Any, kwargs: Any) -> Any:
        """Call it; what it draws comes from the device's own generator."""
        if torch.Tag.nondeterministic_seeded not in func.tags:
            return func(*args, **kwargs)
        if any(isinstance(given, torch.Generator) for given in tree_leaves((args, kwargs))):
            raise RuntimeError("Expected a 'cuda' device type for generator but found 'cpu'")
        before = torch.get_rng_state()
        torch.set_rng_state(self.random.get_state())
        try:
            return func(*args, **kwargs)
        finally:
            self.random.set_state(torch.get_rng_state())
            torch.set_rng_state(before)

    def _count(
        self, func: Any, name: str, args: Any, kwargs: Any, target: torch.device | None
    ) -> None:
        """Note the kernel and the waits of a call."""
        views = any(r.alias_info and not r.alias_info.is_write for r in func._schema.returns)
        if not views and name not in NO_KERNEL:
            self.kernels[self._where()] += 1
        why, times = WAITS.get(name, ("", 0))
        on = [isinstance(x, CudaTensor) for x in args[:2]]
        if name == "repeat_interleave" and kwargs.get("output_size") is not None:
            times = 0
        elif name == "_to_copy" and target is not None:
            why, times = "copies", on[0] != (target.type == "cuda")
        elif name == "copy_":
            why, times = "copies", on[0] != on[1]
        elif name in ("masked_fill", "masked_fill_") and isinstance(args[2], CudaTensor):
            why, times = READS, 1
        elif name in INDEXING:
            given = [each for each in args[1] if each is not None]
            here = [each for each in given if not isinstance(each, CudaTensor)]
            masks = [each for each in given if each.dtype in (torch.bool, torch.uint8)]
            number = len(args) > 2 and not isinstance(args[2], CudaTensor)
            fills = number and len(given) == len(masks) == 1
            self._wait("copies", name, len(here) + (number and not fills))
            why, times = SIZE, 0 if fills else len(masks)
        if kwargs.get("non_blocking") or (name == "copy_" and args[2:] == (True,)):
            times = 0
        self._wait(why, name, times)

    def _wait(self, why: str, name: str, times: int) -> None:
        if not times:
            return
        backward = torch._C._current_autograd_node() is not None
        self.waits += [Wait(why, name, self._where(), backward)] * times
        if self.debug == 2:
            raise RuntimeError("called a synchronizing CUDA operation")
        if self.debug == 1:
            warnings.warn("called a synchronizing CUDA operation", stacklevel=6)

    def _where(self) -> str:
        """The innermost line of the code that is watched."""
        frame: Any = sys._getframe(1)
        while frame is not None:
            file = frame.f_code.co_filename
            if self.watch in file and frame.f_globals is not globals():
                return f"{Path(file).name}:{frame.f_lineno} {frame.f_code.co_name}"
            frame = frame.f_back
        main = threading.current_thread() is threading.main_thread()
        return "(elsewhere)" if main else "(autograd)"


def _check_devices(func: Any, name: str, args: Any, tensors: list[torch.Tensor]) -> None:
    """Raise for CPU tensors where torch would."""
    told = (
        "Expected all tensors to be on the same device, but found at least two devices, cuda:0 and "
        f"cpu! (when checking arguments in method wrapper_CUDA_{name})"
    )
    if name in INDEXING:  # an index may be on the CPU, and a value that is a number
        if not isinstance(args[0], CudaTensor):
            raise RuntimeError(
                "indices should be either on cpu or on the same device as the indexed tensor (cpu)"
            )
        if len(args) > 2 and not isinstance(args[2], CudaTensor) and args[2].dim() > 0:
            raise RuntimeError(told)
    elif name not in ("_to_copy", "copy_"):
        numbers = name in ZERO_DIM or name.startswith("_foreach")
        numbers = numbers or torch.Tag.pointwise in func.tags
        written = [
            given
            for given, argument in zip(args, func._schema.arguments, strict=False)
            if argument.alias_info and argument.alias_info.is_write
        ]
        for x in tensors:
            number = numbers and x.dim() == 0 and not any(x is each for each in written)
            if not isinstance(x, CudaTensor) and not number:
                raise RuntimeError(told)


def _check_limits(name: str, args: Any) -> None:
    """What CUDA's kernel can't do and the CPU's can: an antialiasing filter must fit the 48 kB that
    a block of threads shares (ATen/native/cuda/UpSample.cu)."""
    if name in ("_upsample_bilinear2d_aa", "_upsample_bicubic2d_aa"):
        radius = 1 if "bilinear" in name else 2
        scales = [max(1.0, old / new) for old, new in zip(args[0].shape[2:], args[1], strict=True)]
        rows, columns = (2 * math.ceil(radius * scale) + 1 for scale in scales)
        if (columns * 32 + rows + rows * 32) * args[0].element_size() > 48 * 1024:
            raise RuntimeError(
                "Provided interpolation parameters can not be handled with current algorithm "
                "implementation. Please reduce the scale factor. Too much shared memory required"
            )


def _register_device() -> None:
    """Let this process's torch know of a CUDA device."""
    if torch.version.cuda is not None:
        raise RuntimeError("this torch has CUDA: use it")
    root = Path(torch.__file__).parent
    with tempfile.TemporaryDirectory() as folder:
        source, library = Path(folder) / "device.cpp", Path(folder) / "device.so"
        source.write_text(DEVICE)
        compiler = [os.environ.get("CXX", "c++"), "-std=c++20", "-shared", "-fPIC", str(source)]
        torchs = [f"-I{root / 'include'}", f"-L{root / 'lib'}", "-lc10", "-ltorch_cpu"]
        subprocess.run([*compiler, *torchs, "-o", str(library)], check=True)
        ctypes.CDLL(str(library))


_register_device()  # before the first backward pass, which starts a thread for each device


def _materialize(self: Any, shape: Any, device: Any = None, dtype: Any = None) -> None:
    made = torch.empty(shape, device=device or self.data.device, dtype=dtype or self.data.dtype)
    torch.utils.swap_tensors(self, torch.nn.Parameter(made, self.requires_grad))


@contextlib.contextmanager
def simulate(watch: str = "", bf16: bool = True) -> Iterator[Simulation]:
    """Within, ``cuda`` is a device. ``watch`` is part of the path of the files whose lines are
    told; ``bf16`` is what ``torch.cuda.is_bf16_supported`` says."""
    gpu, apply = Simulation(watch), torch.nn.Module._apply

    def swapping(module: Any, function: Any, recurse: bool = True) -> Any:
        """A module's parameters stay the objects that they are when it changes its device; those
        without a shape yet stay where they are."""
        lazy = {k: p for k, p in module._parameters.items() if torch.nn.parameter.is_lazy(p)}
        for name in lazy:
            del module._parameters[name]
        try:
            with mock.patch.object(torch.__future__, "_swap_module_params_on_conversion", True):
                return apply(module, function, recurse)
        finally:
            module._parameters.update(lazy)

    def debugging(mode: Any) -> None:
        gpu.debug = {"default": 0, "warn": 1, "error": 2}.get(mode, mode)

    def answers(value: Any) -> Any:
        return lambda *_, **__: value

    cuda = {
        **dict.fromkeys(("is_available", "is_initialized"), answers(True)),
        **dict.fromkeys(("_lazy_init", "set_device", "synchronize", "empty_cache"), answers(None)),
        **dict.fromkeys(("memory_allocated", "max_memory_allocated", "current_device"), answers(0)),
        **dict.fromkeys(("manual_seed", "manual_seed_all"), gpu.random.manual_seed),
        "reset_peak_memory_stats": answers(None),
        "device_count": answers(1),
        "get_device_name": answers("simulated CUDA device"),
        "get_device_capability": answers((8, 0) if bf16 else (7, 5)),
        "is_bf16_supported": answers(bf16),
        "get_rng_state": lambda *_: gpu.random.get_state(),
        "set_rng_state": lambda state, *_: gpu.random.set_state(state),
        "get_sync_debug_mode": lambda: gpu.debug,
        "set_sync_debug_mode": debugging,
    }
    types = [*optimizer._foreach_supported_types, CudaTensor]
    patches = [(torch.cuda, name, function) for name, function in cuda.items()] + [
        (torch.nn.Module, "_apply", swapping),
        (torch.nn.parameter.UninitializedTensorMixin, "materialize", _materialize),
        (torch.Tensor, "pin_memory", lambda self, *_: self),
        (_foreach_utils, "_foreach_supported_types", types),
        (optimizer, "_foreach_supported_types", types),
    ]
    lift = torch._C._only_lift_cpu_tensors()
    torch._C._set_only_lift_cpu_tensors(True)
    try:
        with contextlib.ExitStack() as stack:
            for patch in patches:
                stack.enter_context(mock.patch.object(*patch))
            yield stack.enter_context(gpu)
    finally:
        torch._C._set_only_lift_cpu_tensors(lift)


def without_cuda(operators: set[str]) -> list[str]:
    """Those of ``Simulation.operators`` that have no CUDA kernel by torch's own list."""
    import torchgen
    import yaml

    path = Path(torchgen.__file__).parent / "packaged/ATen/native/native_functions.yaml"
    entries = yaml.load(path.read_text(), getattr(yaml, "CLoader", yaml.SafeLoader))
    known = {each["func"].partition("(")[0]: each for each in entries}
    missing = []
    for operator in sorted(operators):
        entry = known.get(operator.removeprefix("aten.").removesuffix(".default"), {})
        entry = known.get(entry.get("structured_delegate"), entry)
        keys = " ".join(entry.get("dispatch", {"CompositeImplicitAutograd": ""}))
        if "CUDA" not in keys and "Composite" not in keys:
            missing.append(operator)
    return missing


def pytest_configure(config: Any) -> None:
    """``pytest -p simulated_cuda``: every test has the device."""
    stack = contextlib.ExitStack()
    stack.enter_context(simulate(watch=str(config.rootpath)))
    config.add_cleanup(stack.close)
