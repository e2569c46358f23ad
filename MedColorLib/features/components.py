"""Principal components of a reference's features: matching compares fewer numbers a position.

The inner product of two features is that of their components along any orthonormal basis; along the first K principal
components of the reference it lacks only what the reference hardly has. Found once a reference; no mean is subtracted,
since inner products are to be kept, not variances.
"""

from __future__ import annotations

import torch
from torch import Tensor

PROJECTED_LAYERS = (4, 3, 2, 1)  # layer 5 has so few positions that its product costs nothing


def principal_components(features: Tensor, count: int) -> Tensor:
    """Basis of the `count`-dimensional space that holds most of the unit features.

    Args:
        features: (1, C, h, w) of the reference.

    Returns:
        (count or C, whichever is less, C) float32 with orthonormal rows, the largest component first.
    """
    values = features[0].flatten(1).cpu().double()  # once a reference, and alike on every device
    values = values / values.norm(dim=0).clamp_min(1e-12)
    directions = torch.linalg.eigh(values @ values.T).eigenvectors  # ascending
    return directions[:, -count:].T.flip(0).contiguous().float().to(features.device)


def project(features: Tensor, basis: Tensor | None) -> Tensor:
    """(N, C, h, w) -> (N, count, h, w): components along `basis` (count, C); as they are without one."""
    if basis is None:
        return features
    return torch.nn.functional.conv2d(features, basis[:, :, None, None])


def kept_energy(features: Tensor, basis: Tensor) -> float:
    """Mean share 0..1 of the squared length of features (N, C, h, w) that their components hold; zero vectors do not count."""
    whole = features.square().sum(1)
    held = project(features, basis).square().sum(1)
    some = whole > 0
    return float((held[some] / whole[some]).mean()) if some.any() else 1.0
