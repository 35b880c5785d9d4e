"""How often the host waits, and how many kernels it launches: no more than stated here and in
docs/benchmarks.md. And that what a GPU would refuse doesn't pass."""

import pytest
import torch

from benchmarks import waits
from styleexp.method.losses import GramLoss
from styleexp.renderers.soft_raster import deferred
from styleexp.system.errors import UserError

pytestmark = [
    pytest.mark.usefixtures("coarse_shapes"),
    pytest.mark.filterwarnings("ignore:the encoder 'vgg19_random'"),
]
SMOKE = ["source=torus", "style=bubble", "profile=smoke", "encoder=vgg19_random", "device=cuda",
         "threads=1"]  # fmt: skip
BUDGETS = {
    "method=robust": (60, 8, 1050),
    "method=robust shading.outlines=true": (80, 20, 1950),
    "method=paper": (60, 8, 950),
    "method=paper shading.outlines=true": (60, 20, 1800),
}
"""Waits before the first step, of a step, and its kernels, whatever its sizes, as long as memory
holds all at once."""


def within(words, budget):
    """Fails if a run takes more than its budget."""
    prepared, step = waits.counted([*SMOKE, *words.split()])
    assert prepared.waits.total() <= budget[0], prepared.waits
    assert step.waits.total() <= budget[1], step.waits
    assert step.kernels.total() <= budget[2], step.by_part()


@pytest.mark.parametrize(("words", "budget"), BUDGETS.items(), ids=BUDGETS)
def test_a_step_stays_within_its_budget(simulator, words, budget):
    within(words, budget)


def test_a_hidden_item_is_found(simulator, monkeypatch):
    real = GramLoss.distance

    def distance(self, found, target, scales):
        total = real(self, found, target, scales)
        for gram in found:
            assert gram.sum().item() == gram.sum().item()
        return total

    monkeypatch.setattr(GramLoss, "distance", distance)
    with pytest.raises(AssertionError, match="_local_scalar_dense"):
        within("method=robust", BUDGETS["method=robust"])


def test_a_loop_of_kernels_is_found(simulator, monkeypatch):
    real = GramLoss.distance

    def distance(self, found, target, scales):
        for gram in found:
            for row in gram[:32]:
                row.square()
        return real(self, found, target, scales)

    monkeypatch.setattr(GramLoss, "distance", distance)
    with pytest.raises(AssertionError, match="kernels"):
        within("method=robust", BUDGETS["method=robust"])


def test_a_tensor_left_on_the_cpu_is_found(simulator, monkeypatch):
    real = deferred.world_light
    monkeypatch.setattr(deferred, "world_light", lambda *given: real(*given).cpu())
    with pytest.raises(RuntimeError, match="same device"):
        within("method=robust", BUDGETS["method=robust"])


def test_a_generator_of_the_cpu_is_found(simulator, monkeypatch):
    def noisy(images, generator=torch.Generator()):  # noqa: B008
        return images + 0 * torch.empty_like(images).uniform_(generator=generator)

    real = GramLoss.describe

    def describe(self, seen):
        noisy(seen.image)
        return real(self, seen)

    monkeypatch.setattr(GramLoss, "describe", describe)
    with pytest.raises(RuntimeError, match="generator"):
        within("method=robust", BUDGETS["method=robust"])


def test_an_operator_of_the_cpu_alone_is_found(simulator, monkeypatch):
    monkeypatch.setattr("styleexp.encoders.vgg.VGG.is_fused", True)
    with pytest.raises(NotImplementedError, match="mkldnn"):
        within("method=robust", BUDGETS["method=robust"])


def test_an_image_shrunk_at_once_is_found(gpu):
    if gpu is None:
        pytest.skip("a newer CUDA may do it")
    row = torch.ones(1, 1, 2000, 8, device="cuda")
    with pytest.raises(RuntimeError, match="shared memory"):
        torch.nn.functional.interpolate(row, [8, 8], mode="bilinear", antialias=True)


def test_auto_takes_cuda_only_for_a_renderer_that_can(gpu):
    from styleexp.config.build import choose_device

    assert choose_device("auto").type == "cuda"
    assert choose_device("auto", "mitsuba_ad", ("cpu",)).type == "cpu"
    with pytest.raises(UserError, match="renderer=mitsuba_ad can't use device=cuda, only cpu"):
        choose_device("cuda", "mitsuba_ad", ("cpu",))


def test_a_device_that_runs_no_kernel_is_told(gpu, monkeypatch):
    from styleexp.config.build import choose_device

    def ones(*given, device=None, **more):
        raise RuntimeError("CUDA error: no kernel image is available for execution on the device")

    monkeypatch.setattr(torch, "ones", ones)
    with pytest.raises(UserError, match=r"device=auto can't be used \(CUDA error: no kernel"):
        choose_device("auto")


def test_fp32_is_fp32_and_the_callers_choice_is_put_back(gpu):
    from styleexp.system import process

    before = torch.backends.cudnn.allow_tf32
    torch.backends.cudnn.allow_tf32 = True
    try:
        with process.undisturbed(1, 0):
            assert process.gpu(torch.device("cuda"))["tf32"]["convolutions"] is False
            assert process.gpu(torch.device("cpu")) == {}
        assert torch.backends.cudnn.allow_tf32 is True
    finally:
        torch.backends.cudnn.allow_tf32 = before
