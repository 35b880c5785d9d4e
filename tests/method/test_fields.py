import math

import pytest
import torch

from styleexp.experiments.metrics.shape import flipped_faces
from styleexp.inputs import meshes, shapes
from styleexp.method import fields
from styleexp.method.fields import FourierFeatures, FourierMLP, zero_mean
from styleexp.method.options import FieldConfig
from styleexp.method.surface import Surface, unfolded


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def test_encoding_is_equation_1():
    encode = FourierFeatures(4, 5.0, False, generator())
    point = torch.tensor([[0.1, -0.2, 0.3]])
    phase = 2 * math.pi * encode.frequencies @ point[0]
    torch.testing.assert_close(encode(point)[0], torch.cat([phase.cos(), phase.sin()]))


def test_frequencies_have_the_configured_spread_and_do_not_train():
    encode = FourierFeatures(4096, 5.0, False, generator())
    assert encode.frequencies.std() == pytest.approx(5.0, rel=0.02)
    assert not list(encode.parameters())


def test_progressive_opening_goes_from_low_to_high_frequencies():
    encode = FourierFeatures(64, 5.0, True, generator())
    half = encode(torch.full((1, 3), 0.37), opened=0.5)[0]
    cosines = half[3 : 3 + 64]
    assert (cosines[:32] != 0).all()
    assert (cosines[32:] == 0).all()
    norms = encode.frequencies.norm(dim=1)
    assert (norms[1:] >= norms[:-1]).all()
    assert half[:3].tolist() == pytest.approx([0.37] * 3)  # the raw input is never closed


def test_encoding_follows_points_and_frequencies_that_change_in_place():
    encode = FourierFeatures(4, 5.0, False, generator())
    points = torch.rand(3, 3, generator=generator())
    first = encode(points)
    assert encode(points) is first
    points.add_(0.5)
    moved = encode(points)
    assert not torch.equal(moved, first)
    encode.load_state_dict({"frequencies": torch.ones(4, 3)})
    assert not torch.equal(encode(points), moved)
    assert encode(points.clone().requires_grad_()).requires_grad


@pytest.mark.parametrize("onednn", [True, False])
@pytest.mark.parametrize("rows", [2, 300])
def test_bf16_layers_are_those_of_torch(rows, onednn, monkeypatch):
    if not onednn:  # as on processors without AVX-512
        monkeypatch.setattr(fields, "has_onednn", lambda tensor: False)
    field = FourierMLP(FieldConfig(width=64, depth=4), generator(), 5.0, 0.1)
    torch.nn.init.normal_(field.last.weight, generator=generator())
    points = torch.rand(rows, 3, generator=generator())
    encoded = field.encode(points)
    field(points, precision=torch.bfloat16).sum().backward()
    fused = [layer.weight.grad.clone() for layer in field.hidden]
    field.zero_grad()
    x = encoded.bfloat16()
    for layer in field.hidden:
        x = torch.relu(
            torch.nn.functional.linear(x, layer.weight.bfloat16(), layer.bias.bfloat16())
        )
    latent = field.last(x.float()).squeeze(-1)
    expected = field.bound * torch.tanh(latent - latent.mean() if field.centred else latent)
    torch.testing.assert_close(field(points, precision=torch.bfloat16), expected)
    expected.sum().backward()
    for gradient, layer in zip(fused, field.hidden, strict=True):
        torch.testing.assert_close(gradient, layer.weight.grad, rtol=0.02, atol=1e-4)


def test_starts_at_the_source_and_keeps_its_bound():
    field = FourierMLP(FieldConfig(), generator(), 5.0, 0.1)
    points = torch.rand(50, 3)
    assert (field(points) == 0).all()
    torch.nn.init.normal_(field.last.weight, std=1e3, generator=generator(1))
    assert field(points).max().item() == pytest.approx(0.1)


def test_a_last_layer_at_random_starts_beside_the_source():
    field = FourierMLP(FieldConfig(last_layer="random"), generator(), 5.0, 0.1)
    displacement = field(torch.rand(50, 3, generator=generator(1)))
    assert displacement.std() > 0
    assert displacement.abs().max() < 0.1


def test_a_clamp_keeps_the_bound_without_bending_what_is_within():
    field = FourierMLP(FieldConfig(limit="clamp", zero_mean=False), generator(), 5.0, 0.1)
    points = torch.rand(5, 3, generator=generator(1))
    for latent, displacement in ((0.5, 0.05), (-0.9, -0.09), (3.0, 0.1), (-3.0, -0.1)):
        torch.nn.init.constant_(field.last.bias, latent)
        torch.testing.assert_close(field(points), torch.full((5,), displacement))


@pytest.mark.parametrize("zero_mean", [True, False])
def test_a_drift_of_the_mean_saturates_nothing_where_the_mean_is_taken_off(zero_mean):
    field = FourierMLP(FieldConfig(zero_mean=zero_mean), generator(), 5.0, 0.1)
    torch.nn.init.normal_(field.last.weight, std=0.1, generator=generator(1))
    torch.nn.init.constant_(field.last.bias, 20.0)
    displacement = field(torch.rand(50, 3, generator=generator(2)))
    saturated = (displacement.abs() > 0.0999).float().mean()
    assert saturated < 0.1 if zero_mean else saturated == 1


def test_paper_sizes():
    field = FourierMLP(FieldConfig(), generator(), 5.0, 0.1)
    shapes = [tuple(layer.weight.shape) for layer in (*field.hidden, field.last)]
    assert shapes == [(256, 256)] * 7 + [(1, 256)]


def test_equal_generators_make_equal_fields_and_others_do_not():
    def weights(seed):
        return FourierMLP(FieldConfig(), generator(seed), 5.0, 0.1).hidden[0].weight

    assert torch.equal(weights(1), weights(1))
    assert not torch.equal(weights(1), weights(2))


def test_zero_mean_is_weighted_by_area_and_keeps_the_bound():
    displacement = torch.tensor([0.05, 0.01, -0.02])
    areas = torch.tensor([1.0, 2.0, 5.0])
    centred = zero_mean(displacement, areas, 0.1)
    assert (centred * areas).sum() == pytest.approx(0.0, abs=1e-7)
    far = zero_mean(torch.tensor([0.1, -0.1, -0.1]), torch.ones(3), 0.1)
    assert far.abs().max() <= 0.1


def test_what_turns_over_is_damped_and_nothing_else_is_touched():
    mesh = shapes.make("torus", detail=600)
    vertices, faces = torch.from_numpy(mesh.vertices), torch.from_numpy(mesh.faces)
    normals = torch.from_numpy(meshes.vertex_normals(mesh.vertices, mesh.faces))
    surface = Surface(vertices, faces, normals)
    rough = torch.zeros(len(vertices), dtype=torch.float64)
    rough[::40] = 0.6  # far beyond the edges' length
    smooth = unfolded(surface, rough)

    def flipped(displacement):
        return flipped_faces(
            mesh.vertices, mesh.vertices + (displacement[:, None] * normals).numpy(), mesh.faces
        )

    assert flipped(-rough) > 0.01
    assert flipped(unfolded(surface, -rough)) == 0 == flipped(smooth)
    assert (unfolded(surface, -rough).abs() <= rough).all()
    assert unfolded(surface, -rough).abs().sum() > 0
    gentle = 1e-3 * rough
    assert torch.equal(unfolded(surface, gentle), gentle)
