"""Exhaustive search: all patches against all patches by matrix products. No iteration, no chance, no wrong optimum.

On a CPU the similarities are made and read some rows of the target at a time, which stay in the cache: twice as fast
as the whole matrix at once, and the same but for the rounding of the products.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

_EXCLUDED = -1e4  # below any similarity of unit features
_BLOCK_ENTRIES = 2**21  # similarities at a time on a CPU: 8 MB


def similarity_volume(target: Tensor, reference: Tensor, radius: int, rows: tuple[int, int] | None = None) -> Tensor:
    """Mean inner product of patches of side 2 * radius + 1: S[p, q] = mean over o of <target[p+o], reference[q+o]>.

    For unit features |x - y|^2 = 2 - 2 <x, y>, so the largest S is the smallest patch distance of Liao et al. 2017. The
    sum over a patch is a box sum along the diagonals of the (h, w, h2, w2) array: one product instead of
    (2 radius + 1)^2. Positions off either map count as 0.

    Args:
        target: (C, h, w), one slice. reference: (C, h2, w2). Inner products are taken in their dtype, sums in float32.
        rows: first and last + 1 row of the target; None for all.

    Returns:
        (rows * w, h2 * w2) float32 on the same device.
    """
    (h, w), (h2, w2) = target.shape[1:], reference.shape[1:]
    first, stop = rows or (0, h)
    low, high = max(first - radius, 0), min(stop + radius, h)
    patch_rows = target[:, low:high].flatten(1)
    product = (patch_rows.T @ reference.flatten(1)).float().view(high - low, w, h2, w2)
    product = _diagonal_box_sum(product, 0, 2, radius)[first - low : stop - low]
    product = _diagonal_box_sum(product, 1, 3, radius)
    return product.view((stop - first) * w, h2 * w2).div_((2 * radius + 1) ** 2)


def search(target: Tensor, reference: Tensor, radius: int, target_mask: Tensor, reference_mask: Tensor, both: bool):
    """Best match of every position, in one direction or both, from the same similarity.

    Args:
        target: (N, C, h, w) features; reference: (N or 1, C, h2, w2).
        target_mask: (N, h, w) bool, reference_mask: (h2, w2) bool: where a match may lie.
        both: also return the field from reference to target (the same matrix read along its other axis).

    Returns:
        field (N, h, w), similarity (N, h, w), reverse field (N, h2, w2) or None, reverse similarity or None.
    """
    found = [
        _search_one(side, reference[n if len(reference) > 1 else 0], radius, target_mask[n], reference_mask, both)
        for n, side in enumerate(target)
    ]
    field, similarity, reverse, reverse_similarity = (
        torch.stack(values) if values[0] is not None else None for values in zip(*found)
    )
    return field, similarity, reverse, reverse_similarity


def _search_one(
    target: Tensor, reference: Tensor, radius: int, target_mask: Tensor, reference_mask: Tensor, both: bool
):
    (h, w), (h2, w2) = target.shape[1:], reference.shape[1:]
    # Added, since writing into some columns takes longer than the search: 0 where a match may lie.
    penalty = torch.where(reference_mask.reshape(-1), 0.0, _EXCLUDED)
    step = h if target.device.type != "cpu" else max(1, _BLOCK_ENTRIES // (w * h2 * w2))
    forward = []
    best = torch.full((h2 * w2,), -torch.inf, device=target.device)
    position = torch.zeros(h2 * w2, dtype=torch.int64, device=target.device)
    for first in range(0, h, step):
        rows = first, min(first + step, h)
        block = similarity_volume(target, reference, radius, rows)
        block += penalty
        forward.append(block.max(dim=1))
        if both:
            block[~target_mask[slice(*rows)].reshape(-1)] = 2 * _EXCLUDED
            values, inside = _best_rows(block)
            better = values > best
            best = torch.where(better, values, best)
            position = torch.where(better, inside + first * w, position)
    if both:  # positions where no match may lie take the first allowed row: what is warped there looks like nothing
        first_row = target_mask.reshape(-1).to(torch.uint8).argmax()
        position = torch.where(penalty < 0, first_row, position)
        best = torch.where(penalty < 0, _EXCLUDED, best)
    field = torch.cat([m.indices for m in forward]).view(h, w)
    similarity = torch.cat([m.values for m in forward]).view(h, w)
    return field, similarity, *((position.view(h2, w2), best.view(h2, w2)) if both else (None, None))


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
