"""Mean and mean square of every feature, instead of Gram matrices."""

import torch
from torch.nn.functional import adaptive_avg_pool2d

from styleexp.method.losses import Loss


class Moments(Loss):
    """See the module. Only cells that show the mesh count, by their coverage."""

    def __init__(self, encoder, layers, spread):
        self.encoder, self.layers, self.spread = encoder, layers, spread

    def describe(self, seen):
        """A tensor (2, features) for each layer."""
        features = self.encoder(seen.image.permute(0, 3, 1, 2), self.layers)
        statistics = []
        for layer in features.values():
            cells = adaptive_avg_pool2d(seen.coverage, layer.shape[2:])
            share = cells[:, None] / cells.sum().clamp(min=1)
            mean = (layer.float() * share).sum((0, 2, 3))
            square = (layer.float().square() * share).sum((0, 2, 3))
            statistics.append(torch.stack([mean, square]))
        return statistics

    def distance(self, found, target, scales):
        """Squared differences, relative to the style's."""
        pairs = zip(found, target, scales, strict=True)
        apart = [(a - b).square().sum(1) / scale for a, b, scale in pairs]
        return sum(mean + self.spread * square for mean, square in apart)

    def scales(self, target, source):
        """The squared size of the style's statistics."""
        sizes = [each.square().sum() for each in target]
        return [torch.where(size > 0, size, torch.inf) for size in sizes]
