"""Self-similarity: modality-independent neighbourhood descriptors (MIND) over a pyramid, for the first, coarse match.

MIND (Heinrich et al. 2012, Medical Image Analysis 16(7)) describes a pixel by how its patch resembles the patches around
it, exp(-D / V) with D the patch distance and V the local variance. It does not change when grey values are inverted or
remapped monotonically in a neighbourhood, which is what CT against photograph needs.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

_RING = ((0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1))


class SelfSimilarity:
    """Self-similarity features at five scales; see the module docstring."""

    def extract(self, luminance: Tensor, layers: Sequence[int]) -> dict[int, Tensor]:
        """See `Extractor.extract`. 10 to 26 channels; no layer needs another, so only those asked for are computed."""
        return {layer: _layer_features(luminance.float(), layer) for layer in layers}


def mind(image: Tensor, distance: int = 1) -> Tensor:
    """(N, 1, h, w) -> (N, 8, h, w): exp(-D / V) for eight neighbours at `distance`, zero mean and unit length per pixel.

    D is a mean over 3 x 3 patches. V is kept within a factor of 1000 of its mean over the image; a constant image gives
    zeros.
    """
    height, width = image.shape[2:]
    around = pad(image, (distance,) * 4, mode="replicate")
    differences = [
        around[:, :, distance * (1 + y) :, distance * (1 + x) :][:, :, :height, :width] - image for y, x in _RING
    ]
    squared = torch.cat(differences, 1).square()
    squared = avg_pool2d(pad(squared, (1,) * 4, mode="replicate"), 3, 1)
    variance = squared.mean(1, keepdim=True)
    typical = variance.mean((2, 3), keepdim=True)
    variance = torch.maximum(torch.minimum(variance, typical * 1e3), typical * 1e-3).clamp_min(1e-12)
    similarity = torch.exp(-squared / variance)
    similarity = similarity - similarity.mean(1, keepdim=True)
    return similarity / similarity.norm(dim=1, keepdim=True).clamp_min(1e-6)


def _layer_features(luminance: Tensor, layer: int) -> Tensor:
    stride = 2 ** (layer - 1)
    image = avg_pool2d(luminance, stride) if stride > 1 else luminance
    smallest = min(image.shape[2:])
    parts = [mind(image, 1)] + ([mind(image, 2)] if layer < 5 and smallest > 4 else [])
    if layer > 1:
        finer = avg_pool2d(luminance, stride // 2) if stride > 2 else luminance
        parts.append(avg_pool2d(mind(finer, 1), 2))
        spread = (avg_pool2d(luminance.square(), stride) - image.square()).clamp_min(0).sqrt()
        parts += [torch.cos(3 * torch.pi * spread), torch.sin(3 * torch.pi * spread)]
    return torch.cat(parts, 1)
