"""Nearest-neighbour fields: (N, h, w) int64, flat row-major indices into the other side's (h2, w2) map."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad


def identity(count: int, height: int, width: int, device=None) -> Tensor:
    """Field (count, height, width) that maps every position to itself."""
    return torch.arange(height * width, device=device).view(1, height, width).expand(count, -1, -1)


def upsample(field: Tensor, to_shape: tuple[int, int], from_width: int) -> Tensor:
    """Field at twice the resolution on both sides; the four children keep their place inside the parent.

    Args:
        field: (N, h, w) into a map of width `from_width`.
        to_shape: (h2, w2) of the other side's map at the finer level; the sizes need not be exact doubles.
    """
    rows, cols = field // from_width, field % from_width
    child = torch.tensor([0, 1], device=field.device)
    rows = 2 * rows[:, :, None, :, None] + child[None, None, :, None, None]
    cols = 2 * cols[:, :, None, :, None] + child[None, None, None, None, :]
    rows, cols = torch.broadcast_tensors(rows, cols)
    count, height, width = field.shape
    flat = rows.clamp_max(to_shape[0] - 1) * to_shape[1] + cols.clamp_max(to_shape[1] - 1)
    return flat.reshape(count, 2 * height, 2 * width)


def warp(values: Tensor, field: Tensor) -> Tensor:
    """Bring `values` of the other side here: out[n, :, p] = values[n, :, field[n, p]].

    Args:
        values: (N or 1, C, h2, w2).
        field: (N, h, w).

    Returns:
        (N, C, h, w).
    """
    count, height, width = field.shape
    flat = values.flatten(2).expand(count, -1, -1)
    index = field.reshape(count, 1, -1).expand(-1, flat.shape[1], -1)
    return torch.gather(flat, 2, index).view(count, -1, height, width)


def average_vote(values: Tensor, field: Tensor, radius: int = 2, scale: int = 1) -> Tensor:
    """Reconstruct by the average vote of overlapping patches (Liao et al. 2017, section 4.4).

    Every patch of side 2 * radius + 1 brings its whole matched patch; a pixel is the mean of all votes it gets. The vote
    of the patch centred at p - o is values[field[p - o] + o]; votes that fall off either map are not counted.

    A field of a coarser layer stands for `scale` x `scale` pixels each, which keep their place inside it (`upsample`). All
    votes that one such block gives a pixel are the same, so they are read once and counted as often as they occur: at
    layer 3 four readings instead of 25.

    Args:
        values: (N or 1, C, H2, W2) of the other side.
        field: (N, h, w) into the other side's (ceil(H2 / scale), ceil(W2 / scale)) map.

    Returns:
        (N, C, scale * h, scale * w).
    """
    total = _votes(values, field, radius, scale)
    return total[:, :-1] / total[:, -1:].clamp_min(1)


def group_vote(
    values: Tensor, field: Tensor, groups: Tensor, other_groups: Tensor, radius: int = 2, scale: int = 1
) -> tuple[Tensor, Tensor]:
    """`average_vote` in which a pixel counts only the votes of its own group.

    Args:
        groups: (N, scale * h, scale * w) integers, negative where every vote counts. other_groups: (H2, W2) of the other side.

    Returns:
        (N, C, scale * h, scale * w), 0 where no vote counts; (N, scale * h, scale * w) bool, where at least one does.
    """
    total = _votes(values, field, radius, scale, (groups, other_groups))
    return total[:, :-1] / total[:, -1:].clamp_min(1), total[:, -1] > 0


def _votes(values: Tensor, field: Tensor, radius: int, scale: int, groups: tuple[Tensor, Tensor] | None = None):
    """Sum of the votes and, last, their number: (N, C + 1, H, W)."""
    count, height, width = field.shape
    cols2 = values.shape[3]
    edge = radius + scale - 1  # around the other side nothing votes: no vote needs to be asked whether it falls off
    table = pad(pad(values, (0, 0, 0, 0, 0, 1), value=1.0), (edge,) * 4)  # a vote each
    line = cols2 + 2 * edge
    other_groups = None if groups is None else pad(groups[1], (edge,) * 4, value=-1).flatten()
    coarse_cols = -(-cols2 // scale)
    start = (scale * (field // coarse_cols) + edge) * line + scale * (field % coarse_cols) + edge
    first = table[0, 0].numel() * torch.arange(count, device=field.device).view(-1, 1, 1) if len(values) > 1 else 0
    table = table.permute(0, 2, 3, 1).contiguous().flatten(0, 2)
    total = values.new_zeros(count, scale * height, scale * width, table.shape[1])
    across = _blocks_around(width, scale, radius, field.device)
    for block_y, offset_y, times_y in _blocks_around(height, scale, radius, field.device):
        rows = start[:, block_y] + (line * offset_y)[:, None]
        for block_x, offset_x, times_x in across:
            index = rows[:, :, block_x] + offset_x
            times = (times_y[:, None] * times_x).to(values.dtype).expand(index.shape)
            if groups is not None:
                times = times * ((other_groups[index] == groups[0]) | (groups[0] < 0))
            votes = torch.index_select(table, 0, (index + first).flatten()).view(total.shape)
            total.addcmul_(votes, times[..., None])
    return total.permute(0, 3, 1, 2)


def _blocks_around(size: int, scale: int, radius: int, device) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Which blocks of `scale` pixels lie within `radius` of each pixel of a line of `size` blocks.

    Returns:
        For the first, second ... of them: index of the block, the pixel's place counted from the block's start, and how many
        pixels of the block are near (0 beyond the line): each (scale * size,).
    """
    pixel = torch.arange(scale * size, device=device)
    found = []
    for number in range((2 * radius + scale - 1) // scale + 1):
        block = torch.div(pixel - radius, scale, rounding_mode="floor") + number
        low = torch.maximum(pixel - radius, scale * block)
        high = torch.minimum(pixel + radius, scale * block + scale - 1)
        times = torch.where((block >= 0) & (block < size), (high - low + 1).clamp_min(0), 0)
        block = block.clamp(0, size - 1)
        found.append((block, pixel - scale * block, times))
    return found
