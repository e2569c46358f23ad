"""Exhaustive search: all patches against all patches by one matrix product. No iteration, no chance, no wrong optimum."""

from __future__ import annotations

import math

import torch
from torch import Tensor

_EXCLUDED = -1e4  # below any similarity of unit features


def similarity_volume(target: Tensor, reference: Tensor, radius: int) -> Tensor:
    """Mean inner product of patches of side 2 * radius + 1: S[n, p, q] = mean over o of <target[p+o], reference[q+o]>.

    For unit features |x - y|^2 = 2 - 2 <x, y>, so the largest S is the smallest patch distance of Liao et al. 2017. The
    sum over a patch is a box sum along the diagonals of the (h, w, h2, w2) array: one product instead of
    (2 radius + 1)^2. Positions off either map count as 0.

    Args:
        target: (C, h, w), one slice. reference: (C, h2, w2).

    Returns:
        (h * w, h2 * w2) float32 on the same device.
    """
    h, w = target.shape[1:]
    h2, w2 = reference.shape[1:]
    product = (target.flatten(1).T @ reference.flatten(1)).float().view(h, w, h2, w2)
    product = _diagonal_box_sum(product, 0, 2, radius)
    product = _diagonal_box_sum(product, 1, 3, radius)
    return product.view(h * w, h2 * w2).div_((2 * radius + 1) ** 2)


def search(target: Tensor, reference: Tensor, radius: int, target_mask: Tensor, reference_mask: Tensor, both: bool):
    """Best match of every position, in one direction or both, from the same similarity.

    Args:
        target: (N, C, h, w) features; reference: (N or 1, C, h2, w2).
        target_mask: (N, h, w) bool, reference_mask: (h2, w2) bool: where a match may lie.
        both: also return the field from reference to target (the same matrix read along its other axis).

    Returns:
        field (N, h, w), similarity (N, h, w), reverse field (N, h2, w2) or None, reverse similarity or None.
    """
    count = target.shape[0]
    shape, shape2 = target.shape[2:], reference.shape[2:]
    forward, backward = [], []
    for n in range(count):
        volume = similarity_volume(target[n], reference[n if len(reference) > 1 else 0], radius)
        volume[:, ~reference_mask.reshape(-1)] = _EXCLUDED
        forward.append(volume.max(dim=1))
        if both:
            # lower still: positions whose column is excluded take an allowed row, too
            volume[~target_mask[n].reshape(-1)] = 2 * _EXCLUDED
            backward.append(_best_rows(volume))
    field = torch.stack([m.indices for m in forward]).view(count, *shape)
    similarity = torch.stack([m.values for m in forward]).view(count, *shape)
    if not both:
        return field, similarity, None, None
    reverse = torch.stack([rows for _, rows in backward]).view(count, *shape2)
    return field, similarity, reverse, torch.stack([values for values, _ in backward]).view(count, *shape2)


def _diagonal_box_sum(values: Tensor, axis: int, axis2: int, radius: int) -> Tensor:
    """Sum of values shifted by the same offset -radius..radius along both axes; outside counts as 0."""
    out = values.clone()
    size, size2 = values.shape[axis], values.shape[axis2]
    for d in range(1, radius + 1):
        if d >= min(size, size2):
            break
        late = values.narrow(axis, d, size - d).narrow(axis2, d, size2 - d)
        early = values.narrow(axis, 0, size - d).narrow(axis2, 0, size2 - d)
        out.narrow(axis, 0, size - d).narrow(axis2, 0, size2 - d).add_(late)
        out.narrow(axis, d, size - d).narrow(axis2, d, size2 - d).add_(early)
    return out


def _best_rows(volume: Tensor) -> tuple[Tensor, Tensor]:
    """Largest value of every column and its row; like volume.max(dim=0), five times faster on a CPU.

    The best block of rows first, by a reduction that runs along memory, then the best row inside it.
    """
    count = len(volume)
    side = math.gcd(count, 64)
    block = volume.view(count // side, side, -1).amax(dim=1).argmax(dim=0)
    rows = block * side + torch.arange(side, device=volume.device)[:, None]
    values, inside = torch.gather(volume, 0, rows).max(dim=0)
    return values, torch.gather(rows, 0, inside[None])[0]
