"""Nearest-neighbour fields: (N, h, w) int64, flat row-major indices into the other side's (h2, w2) map."""

from __future__ import annotations

import torch
from torch import Tensor


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


def average_vote(values: Tensor, field: Tensor, radius: int = 2) -> Tensor:
    """Reconstruct by the average vote of overlapping patches (Liao et al. 2017, section 4.4).

    Every patch of side 2 * radius + 1 brings its whole matched patch; a pixel is the mean of all votes it gets. The vote
    of the patch centred at p - o is values[field[p - o] + o]; votes that fall off either map are not counted.

    Args:
        values: (N or 1, C, h2, w2) of the other side, at the field's resolution.
        field: (N, h, w).
    """
    total, votes = _votes(values, field, radius)
    return total / votes.clamp_min(1)


def group_vote(
    values: Tensor, field: Tensor, groups: Tensor, other_groups: Tensor, radius: int = 2
) -> tuple[Tensor, Tensor]:
    """`average_vote` in which a pixel counts only the votes of its own group.

    Args:
        groups: (N, h, w) integers, negative where every vote counts. other_groups: (h2, w2) of the other side.

    Returns:
        (N, C, h, w), 0 where no vote counts; (N, h, w) bool, where at least one does.
    """
    total, votes = _votes(values, field, radius, (groups, other_groups.flatten()))
    return total / votes.clamp_min(1), votes[:, 0] > 0


def _votes(values: Tensor, field: Tensor, radius: int, groups: tuple[Tensor, Tensor] | None = None):
    """Sum of the votes (N, C, h, w) and their number (N, 1, h, w)."""
    count, height, width = field.shape
    rows2, cols2 = values.shape[2:]
    flat = values.flatten(2).expand(count, -1, -1)
    row, col = field // cols2, field % cols2
    total = torch.zeros(count, values.shape[1], height, width, dtype=values.dtype, device=values.device)
    votes = torch.zeros(count, 1, height, width, dtype=values.dtype, device=values.device)
    for dy in range(-radius, radius + 1):
        here_y, from_y = _shifted(height, dy)
        for dx in range(-radius, radius + 1):
            here_x, from_x = _shifted(width, dx)
            y, x = row[:, from_y, from_x] + dy, col[:, from_y, from_x] + dx
            inside = ((y >= 0) & (y < rows2) & (x >= 0) & (x < cols2)).unsqueeze(1)
            index = (y.clamp(0, rows2 - 1) * cols2 + x.clamp(0, cols2 - 1)).flatten(1).unsqueeze(1)
            if groups is not None:
                here = groups[0][:, here_y, here_x]
                inside = inside & ((groups[1][index].view(here.shape) == here) | (here < 0)).unsqueeze(1)
            vote = torch.gather(flat, 2, index.expand(-1, flat.shape[1], -1)).view(*flat.shape[:2], *y.shape[1:])
            total[:, :, here_y, here_x] += vote * inside
            votes[:, :, here_y, here_x] += inside
    return total, votes


def _shifted(size: int, offset: int) -> tuple[slice, slice]:
    """Slices (where p lies, where p - offset lies) of the positions for which both are on the map."""
    here = slice(max(offset, 0), min(size, size + offset) if size + offset > 0 else 0)
    return here, slice(max(-offset, 0), max(size - max(offset, 0), 0))
