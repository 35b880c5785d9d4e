"""The preconditioner of the vertex field, and Adam with one second moment."""

import json

import pytest
import torch

from styleexp.inputs import shapes
from styleexp.method.fields import VertexField
from styleexp.method.large_steps import AdamUniform, Diffusion
from tests.helpers import warm

SMOKE = ("profile=smoke", "encoder=vgg19_random")


@pytest.fixture(scope="module")
def sphere():
    mesh = shapes.make("sphere", 300)
    return torch.as_tensor(mesh.vertices).float(), torch.as_tensor(mesh.faces).long()


def laplacian(faces, vertices):
    """D - A, entry by entry."""
    dense = torch.zeros(vertices, vertices, dtype=torch.float64)
    for a, b, c in faces.tolist():
        for i, j in ((a, b), (b, c), (c, a)):
            dense[i, j] = dense[j, i] = -1
    return dense - torch.diag(dense.sum(1))


def noise(count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(count, generator=generator, dtype=torch.float64)


def test_it_solves_the_papers_system_and_so_does_its_gradient(sphere):
    points, faces = sphere
    count = len(points)
    diffuse = Diffusion(faces, count, 19.0)
    system = torch.eye(count, dtype=torch.float64) + 19.0 * laplacian(faces, count)
    u = noise(count).requires_grad_()
    x = diffuse(u)
    torch.testing.assert_close(system @ x.detach(), u.detach())
    torch.testing.assert_close(diffuse(torch.ones(count)), torch.ones(count))
    weights = noise(count, 1)
    (gradient,) = torch.autograd.grad((x * weights).sum(), u)
    torch.testing.assert_close(system @ gradient, weights)


def test_gradients_are_those_of_finite_differences():
    tetrahedron = torch.tensor([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    diffuse = Diffusion(tetrahedron, 5, 2.0)  # the fifth vertex has no face
    u = noise(5).requires_grad_()
    torch.autograd.gradcheck(diffuse, u)
    assert diffuse(u)[4] == u[4]


def test_a_negative_lambda_is_refused(sphere):
    with pytest.raises(ValueError, match="negative"):
        Diffusion(sphere[1], len(sphere[0]), -1.0)


def test_a_step_of_one_vertex_moves_its_neighbours_too(sphere):
    points, faces = sphere
    moved = {}
    for smoothness in (0.0, 19.0):
        field = VertexField(len(points), 0.1, smoothness)
        field.connect(faces)
        assert (field(points) == 0).all()
        field(points)[7].backward()
        with torch.no_grad():
            field.latent += field.latent.grad / field.latent.grad.norm()
        moved[smoothness] = field(points).detach()
    assert (moved[0.0] != 0).sum() == 1
    neighbours = faces[(faces == 7).any(1)].unique()
    assert (moved[19.0][neighbours] > 0.3 * moved[19.0].max()).all()


def test_without_smoothness_nothing_changes(sphere):
    points, faces = sphere
    field, plain = VertexField(len(points), 0.1, 0.0), VertexField(len(points), 0.1)
    field.connect(faces)
    with torch.no_grad():
        for each in (field, plain):
            each.latent.copy_(noise(len(points)).float())
    assert torch.equal(field(points), plain(points))
    assert field.state_dict().keys() == plain.state_dict().keys() == {"latent"}


def test_smoothness_needs_the_faces(sphere):
    with pytest.raises(ValueError, match="connect"):
        VertexField(len(sphere[0]), 0.1, 19.0)(sphere[0])


def test_uniform_adam_divides_all_entries_by_the_same_number():
    """Against the formula, written out; with a single entry it is Adam."""
    parameter, plain = (torch.nn.Parameter(torch.zeros(1)) for _ in range(2))
    ours, adam = AdamUniform([parameter], lr=0.1), torch.optim.Adam([plain], lr=0.1)
    several = torch.nn.Parameter(torch.zeros(4, dtype=torch.float64))
    uniform, value = AdamUniform([several], lr=0.1), torch.zeros(4, dtype=torch.float64)
    mean, square = torch.zeros(4).double(), torch.zeros(4).double()
    for step in range(1, 6):
        gradient = noise(4, step)
        parameter.grad, plain.grad = gradient[:1].float(), gradient[:1].float()
        several.grad = gradient
        for each in (ours, adam, uniform):
            each.step()
        mean = 0.9 * mean + 0.1 * gradient
        square = 0.999 * square + 0.001 * gradient**2
        size = (square / (1 - 0.999**step)).max().sqrt() + 1e-8
        value = value - 0.1 * mean / (1 - 0.9**step) / size
    torch.testing.assert_close(parameter, plain)
    torch.testing.assert_close(several.detach(), value)
    with pytest.raises(ValueError, match="closure"):
        ours.step(lambda: 0.0)


def test_a_resumed_run_gives_the_same_bits(tmp_path):
    arguments = ["method=vertex", "field.smoothness=19", "optim.second_moment=uniform"]
    arguments += ["source=torus", "style=bubble", *SMOKE]
    done = warm.run(
        "-m", "styleexp", *arguments, "hydra.run.dir=whole", cwd=tmp_path, env=warm.coarse()
    )
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "whole"
    steps = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert steps[-1]["rms_displacement"] != steps[0]["rms_displacement"]
    (folder / "checkpoint.previous.safetensors").replace(folder / "checkpoint.safetensors")
    before = (folder / "result.ply").read_bytes()
    (folder / "result.ply").unlink()
    done = warm.run("-m", "styleexp", "resume=whole", cwd=tmp_path, env=warm.coarse())
    assert "resuming at step" in done.stdout, done.stderr
    assert (folder / "result.ply").read_bytes() == before
