"""Windowed search: exhaustive within a window around the start, as small matrix products. For fine layers.

The map is cut into blocks; all positions of a block are compared with all positions of one window of the other side,
placed where the block's start field points (its median). Each comparison is a whole patch, exact as in `exact.py`. A second
pass with the blocks moved by half a block lets matches cross block borders. No chance is involved.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from ...progress import check
from .patchmatch import patch_similarity

BLOCK = 8
REACH = 8  # the window reaches this far beyond the block on every side: 24 x 24 candidates for each position
_CHUNK_BYTES = 4 << 20  # of blocks at a time on a CPU: they stay in the cache, 1.7 times as fast as 96 MB
_DEVICE_CHUNK_BYTES = 96 << 20
_EXCLUDED = -1e4


def refine(
    target: Tensor, reference: Tensor, field: Tensor, reference_mask: Tensor, patch_radius: int
) -> tuple[Tensor, Tensor]:
    """Improve a start field; same contract as `patchmatch.refine`, without chance.

    Args:
        target: (N, C, h, w), reference: (N or 1, C, h2, w2), unit features.
        field: (N, h, w) start.
        reference_mask: (h2, w2) bool, allowed targets of a match.

    Returns:
        (field, similarity), both (N, h, w). Never worse than the start where the start was allowed.
    """
    allowed = reference_mask.reshape(-1)
    start = patch_similarity(target, reference, field, patch_radius)
    best = torch.where(allowed[field], start, torch.full_like(start, _EXCLUDED))
    fields, scores = [], []
    for n in range(len(target)):
        one, score = field[n], best[n]
        for shift in (0, BLOCK // 2):
            other = reference[n if len(reference) > 1 else 0]
            one, score = _pass(target[n], other, one, score, reference_mask, patch_radius, shift)
        fields.append(one)
        scores.append(score)
    return torch.stack(fields), torch.stack(scores)


def _pass(target, reference, field, best, mask, radius, shift):
    """One pass over all blocks, whose grid starts at -shift."""
    height, width = field.shape
    rows2, cols2 = reference.shape[1:]
    bottom, right = (-(height + shift)) % BLOCK, (-(width + shift)) % BLOCK
    edges = (shift, right, shift, bottom)
    blocks = _blocks_of_targets(pad(target, tuple(e + radius for e in edges)), radius)
    rows, cols = (_block_medians(values, edges) for values in (field // cols2, field % cols2))
    side_y, side_x = min(BLOCK + 2 * REACH, rows2), min(BLOCK + 2 * REACH, cols2)
    top = (rows - side_y // 2).clamp(0, rows2 - side_y)
    left = (cols - side_x // 2).clamp(0, cols2 - side_x)
    found, score = _search_windows(blocks, reference, mask, top, left, (side_y, side_x), radius)
    found, score = (_unblocked(values, height, width, edges) for values in (found, score))
    better = score > best + 1e-6
    return torch.where(better, found, field), torch.where(better, score, best)


def _search_windows(blocks, reference, mask, top, left, sides, radius):
    """Best position of the window, flat in the whole map, and its similarity: (blocks, BLOCK * BLOCK) each."""
    channels, _, cols2 = reference.shape
    padded = pad(reference, (radius,) * 4).flatten(1).T.contiguous()
    stride = cols2 + 2 * radius
    halo_y, halo_x = sides[0] + 2 * radius, sides[1] + 2 * radius
    inside = _raster(halo_y, halo_x, stride, reference.device)
    candidates = _raster(*sides, cols2, reference.device)
    per_block = 4 * halo_y * halo_x * (channels + (BLOCK + 2 * radius) ** 2)
    most_bytes = _CHUNK_BYTES if reference.device.type == "cpu" else _DEVICE_CHUNK_BYTES
    chunk = max(1, most_bytes // per_block)
    found, score = [], []
    for first in range(0, len(blocks), chunk):
        check()
        part = slice(first, first + chunk)
        windows = padded[(top[part] * stride + left[part])[:, None] + inside]
        product = torch.bmm(blocks[part], windows.transpose(1, 2))
        side = BLOCK + 2 * radius
        product = _patch_sums(product.view(-1, side, side, halo_y, halo_x), sides, radius)
        where = (top[part] * cols2 + left[part])[:, None] + candidates
        product = product.masked_fill(~mask.reshape(-1)[where][:, None, :], _EXCLUDED)
        top_value = product.max(dim=2)
        found.append(torch.gather(where, 1, top_value.indices))
        score.append(top_value.values)
    return torch.cat(found), torch.cat(score)


def _patch_sums(product: Tensor, sides, radius: int) -> Tensor:
    """Mean over the patch of products at positions shifted alike on both sides: (blocks, BLOCK^2, sides product)."""
    steps = range(2 * radius + 1)
    rows = sum(product[:, o : o + BLOCK, :, o : o + sides[0], :] for o in steps)
    both = sum(rows[:, :, o : o + BLOCK, :, o : o + sides[1]] for o in steps)
    return both.reshape(len(product), BLOCK * BLOCK, sides[0] * sides[1]) / (2 * radius + 1) ** 2


def _raster(rows: int, cols: int, stride: int, device) -> Tensor:
    return (torch.arange(rows, device=device)[:, None] * stride + torch.arange(cols, device=device)).reshape(-1)


def _blocks_of_targets(padded: Tensor, radius: int) -> Tensor:
    """(C, H, W) with its halo -> (blocks, (BLOCK + 2 radius)^2, C)."""
    side = BLOCK + 2 * radius
    cut = padded.unfold(1, side, BLOCK).unfold(2, side, BLOCK)
    return cut.permute(1, 2, 3, 4, 0).reshape(-1, side * side, padded.shape[0])


def _block_medians(values: Tensor, edges) -> Tensor:
    """(h, w) int64 -> (blocks,) median of the block's values; beyond the map the nearest value counts."""
    padded = pad(values[None, None].double(), edges, mode="replicate")[0, 0]
    cut = padded.unfold(0, BLOCK, BLOCK).unfold(1, BLOCK, BLOCK).reshape(-1, BLOCK * BLOCK)
    return cut.median(dim=1).values.long()


def _unblocked(values: Tensor, height: int, width: int, edges) -> Tensor:
    """(blocks, BLOCK^2) -> (h, w)."""
    left, right, top, bottom = edges
    rows, cols = (height + top + bottom) // BLOCK, (width + left + right) // BLOCK
    full = values.view(rows, cols, BLOCK, BLOCK).permute(0, 2, 1, 3).reshape(rows * BLOCK, cols * BLOCK)
    return full[top : top + height, left : left + width]
