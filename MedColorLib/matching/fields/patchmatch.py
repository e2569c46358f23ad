"""PatchMatch (Barnes et al. 2009) for the fine layers, where a full similarity would not fit: batched, seeded, on any device.

Propagation takes the four neighbours' matches, shifted by one; random search tries positions around the best one in a
window that halves down to one pixel. All positions move at once (Jacobi), so the result does not depend on a scan order or
on the number of threads. A candidate replaces a match only when it is better by more than rounding, so constant regions
keep their start instead of filling with chance.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ...progress import check

_MARGIN = 1e-6  # a candidate must be better by this much of a unit similarity
_CHUNK_BYTES = 64 << 20


def patch_similarity(target: Tensor, reference: Tensor, field: Tensor, radius: int) -> Tensor:
    """Mean inner product of the patches that `field` joins: (N, h, w). Positions off either map count as 0."""
    count, channels, height, width = target.shape
    cols2 = reference.shape[3]
    here = torch.nn.functional.pad(target, (radius,) * 4).permute(0, 2, 3, 1).contiguous()
    there = torch.nn.functional.pad(reference, (radius,) * 4).permute(0, 2, 3, 1).reshape(len(reference), -1, channels)
    stride = cols2 + 2 * radius
    base = (field // cols2) * stride + field % cols2  # index of the patch's first corner in the padded map
    out = torch.zeros(field.shape, dtype=torch.float32, device=target.device)
    side = 2 * radius + 1
    rows = max(1, _CHUNK_BYTES // (width * channels * 4))
    for n in range(count):
        values = there[n if len(there) > 1 else 0]
        for top in range(0, height, rows):
            bottom = min(height, top + rows)
            for dy in range(side):
                check()
                for dx in range(side):
                    picked = values[base[n, top:bottom] + dy * stride + dx]
                    out[n, top:bottom] += (picked * here[n, top + dy : bottom + dy, dx : dx + width]).sum(-1).float()
    return out / side**2


def refine(
    target: Tensor,
    reference: Tensor,
    field: Tensor,
    reference_mask: Tensor,
    patch_radius: int,
    search_radius: int,
    iterations: int,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Improve a start field by PatchMatch.

    Args:
        target: (N, C, h, w), reference: (N or 1, C, h2, w2), unit features.
        field: (N, h, w) start.
        reference_mask: (h2, w2) bool, allowed targets of a match.
        search_radius: half side of the first random window (Liao et al.: 6 at layers 4 and 3, 4 at layers 2 and 1).
        generator: CPU generator: the same candidates on every device.

    Returns:
        (field, similarity), both (N, h, w). Never worse than the start where the start was allowed.
    """
    allowed = reference_mask.reshape(-1)
    best = patch_similarity(target, reference, field, patch_radius)
    best = torch.where(allowed[field], best, torch.full_like(best, -1e4))
    shape2 = reference.shape[2:]
    for _ in range(iterations):
        for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            field, best = _try(
                target, reference, _propagated(field, dy, dx, shape2), field, best, allowed, patch_radius
            )
        radius = search_radius
        while radius >= 1:
            candidate = _jittered(field, radius, shape2, generator)
            field, best = _try(target, reference, candidate, field, best, allowed, patch_radius)
            radius //= 2
    return field, best


def _try(target, reference, candidate, field, best, allowed, radius):
    score = patch_similarity(target, reference, candidate, radius)
    better = (score > best + _MARGIN) & allowed[candidate]
    return torch.where(better, candidate, field), torch.where(better, score, best)


def _propagated(field: Tensor, dy: int, dx: int, shape2) -> Tensor:
    """The match of the neighbour at p - (dy, dx), shifted by (dy, dx); at the map's edge the position's own."""
    rows2, cols2 = shape2
    row, col = torch.roll(field // cols2, (dy, dx), (1, 2)) + dy, torch.roll(field % cols2, (dy, dx), (1, 2)) + dx
    inside = (row >= 0) & (row < rows2) & (col >= 0) & (col < cols2)
    return torch.where(inside, row * cols2 + col, field)


def _jittered(field: Tensor, radius: int, shape2, generator: torch.Generator) -> Tensor:
    rows2, cols2 = shape2
    offset = torch.randint(-radius, radius + 1, (2, *field.shape), generator=generator).to(field.device)
    row = (field // cols2 + offset[0]).clamp(0, rows2 - 1)
    col = (field % cols2 + offset[1]).clamp(0, cols2 - 1)
    return row * cols2 + col
