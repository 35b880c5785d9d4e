"""A sum of plane waves, instead of a network."""

import math

import torch

from styleexp.method.fields import Field


class Waves(Field):
    """See the module. Heights start at zero; wave vectors are as random as the paper's B."""

    def __init__(self, count, generator, sigma, bound):
        super().__init__()
        self.bound = bound
        self.register_buffer("waves", sigma * torch.randn(3, count, generator=generator))
        self.heights = torch.nn.Parameter(torch.zeros(2, count))

    def forward(self, points, opened=1.0, precision=torch.float32):
        """Displacements of all points."""
        phase = 2 * math.pi * points @ self.waves
        height = phase.cos() @ self.heights[0] + phase.sin() @ self.heights[1]
        return self.bound * torch.tanh(height)
