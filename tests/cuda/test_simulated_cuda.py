"""That the simulated CUDA device refuses what a real one does, and counts what it should."""

import copy
from typing import Any

import pytest
import torch


def test_it_refuses_counts_and_computes_as_it_should(simulator: Any) -> None:
    simulate, without_cuda = simulator.simulate, simulator.without_cuda

    def refuses(kind: type[Exception], told: str, call: Any) -> None:
        with pytest.raises(kind, match=told):
            call()

    class Twice(torch.autograd.Function):
        """Waits once backward."""

        @staticmethod
        def forward(ctx: Any, x: Any) -> Any:
            return 2 * x

        @staticmethod
        def backward(ctx: Any, grad: Any) -> Any:
            return 2 * grad if bool((grad == grad).all()) else None

    with simulate(watch=__file__) as gpu:
        x, cpu = torch.arange(6.0, device="cuda"), torch.ones(6)
        pair, row = x.view(2, 3), torch.ones(1, 1, 2000, 8, device="cuda")
        linear, shrink = torch.ops.mkldnn._linear_pointwise, torch.nn.functional.interpolate
        at = torch.tensor([1], device="cuda")
        refuses(RuntimeError, "same device", lambda: x + cpu)
        refuses(RuntimeError, "same device", lambda: torch.stack([x.sum(), cpu.sum()]))
        refuses(RuntimeError, "same device", lambda: x.index_select(0, torch.tensor([1])))
        refuses(RuntimeError, "indices", lambda: cpu[at])
        refuses(RuntimeError, "generator", lambda: x.uniform_(generator=torch.Generator()))
        refuses(RuntimeError, "ordinal", lambda: cpu.to("cuda:7"))
        small = {"mode": "bilinear", "antialias": True}
        refuses(RuntimeError, "shared memory", lambda: shrink(row, [8, 8], **small))
        refuses(NotImplementedError, "mkldnn", lambda: linear(pair, pair, None, "relu", [], ""))
        refuses(TypeError, "numpy", x.numpy)
        mask, two = x > 2, torch.full((3,), 2, device="cuda")
        for waits, call in [
            (0, lambda: x * cpu.sum() + torch.where(mask, x, 0.5)),
            (0, lambda: cpu.to("cuda", non_blocking=True)),
            (0, lambda: torch.repeat_interleave(two, output_size=6)),
            (0, lambda: x.masked_fill_(mask, 0.5)),
            (1, lambda: bool(mask.any())),
            (1, x.tolist),
            (1, lambda: cpu.to("cuda")),
            (1, lambda: x[[1, 0]]),  # a list is copied there
            (1, lambda: x[mask]),
            (2, two.bincount),
        ]:
            gpu.reset()
            call()
            assert len(gpu.waits) == waits, (waits, gpu.table())
        net = torch.nn.Sequential(torch.nn.Conv2d(3, 4, 3), torch.nn.ReLU(), torch.nn.Flatten())
        found, images = [], torch.randn(2, 3, 8, 8)
        for device in ("cpu", "cuda"):
            moved = copy.deepcopy(net).to(device)
            adam = torch.optim.Adam(moved.parameters())
            for _ in range(2):
                gpu.reset()
                adam.zero_grad()
                Twice.apply(moved(images.to(device)).square().sum()).backward()
                adam.step()
            found.append([p.detach().cpu() for p in moved.parameters()])
        assert all(map(torch.equal, *found))
        assert [w.backward for w in gpu.waits[:2]] == [False, True], gpu.table()
        assert without_cuda(gpu.operators) == []
    assert not torch.cuda.is_available()
