"""Exhaustive search: all patches against all patches by matrix products. No iteration, no chance, no wrong optimum.

On a CPU the similarities are made and read some rows of the target at a time, which stay in the cache: twice as fast
as the whole matrix at once, and the same but for the rounding of the products.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ...progress import check

_EXCLUDED = -1e4  # far below any sum over a patch: at least -50 of features and grey; tissue groups add up to 6100
_BLOCK_ENTRIES = 2**21  # similarities at a time on a CPU: 8 MB
_GROUP = 64  # numbers of which the largest is found first, by a reduction that runs along memory


def similarity_volume(target: Tensor, reference: Tensor, radius: int) -> Tensor:
    """Mean inner product of patches of side 2 * radius + 1: S[p, q] = mean over o of <target[p+o], reference[q+o]>.

    For unit features |x - y|^2 = 2 - 2 <x, y>, so the largest S is the smallest patch distance of Liao et al. 2017. The
    sum over a patch is a box sum along the diagonals of the (h, w, h2, w2) array: one product instead of
    (2 radius + 1)^2. Positions off either map count as 0.

    Args:
        target: (C, h, w), one slice. reference: (C, h2, w2). Inner products are taken in their dtype, sums in float32.

    Returns:
        (h * w, h2 * w2) float32 on the same device.
    """
    sums = PatchSums(target.shape, reference.shape, radius, target.shape[1], target.dtype, target.device)
    ((_, block),) = sums.blocks(target, reference)
    return block / (2 * radius + 1) ** 2


class PatchSums:
    """`similarity_volume` times (2 radius + 1)^2, some rows of the target at a time, in memory that is used again.

    Fresh memory for every block would cost as much as the arithmetic: the system hands it out page by page.
    """

    def __init__(self, shape, shape2, radius: int, rows: int, dtype, device) -> None:
        """Args:
        shape: (C, h, w), shape2: (C, h2, w2) of target and reference. rows: of the target in a block.
        """
        (_, self._height, width), (_, height2, width2) = shape, shape2
        self._radius, self._rows = radius, rows
        around, shape = min(rows + 2 * radius, self._height), (width, height2, width2)
        self._product = torch.empty(around * width, height2 * width2, dtype=dtype, device=device)
        self._raw, self._down, self._out = (torch.empty(n, *shape, device=device) for n in (around, rows, rows))

    def blocks(self, target: Tensor, reference: Tensor, penalty: Tensor | float = 0.0):
        """Yields the block's first row and its sums (rows * w, h2 * w2) float32, to be used before the next one.

        Args:
            penalty: (h2 * w2), added to every position of the reference.
        """
        start, known = 0, 0  # rows of the target whose products are in `_raw`
        for first in range(0, self._height, self._rows):
            check()
            stop = min(first + self._rows, self._height)
            low, high = max(first - self._radius, 0), min(stop + self._radius, self._height)
            kept = known - low
            self._raw[:kept] = self._raw[low - start : known - start].clone()
            raw = self._raw[: high - low]
            self._multiply(target[:, low + kept : high], reference, raw[kept:])
            start, known = low, high
            yield first, self._summed(raw, first - low, stop - first, penalty)

    def _multiply(self, rows: Tensor, reference: Tensor, out: Tensor) -> None:
        rows = rows.flatten(1).T
        out.copy_(torch.mm(rows, reference.flatten(1), out=self._product[: len(rows)]).view(out.shape))

    def _summed(self, raw: Tensor, start: int, rows: int, penalty: Tensor | float) -> Tensor:
        """Sums over patches for `rows` rows, of which the first is number `start` of `raw`."""
        down = self._add_shifted(self._down[:rows].copy_(raw[start : start + rows]), raw, 0, start)
        out = torch.add(down.flatten(2), penalty, out=self._out[:rows].flatten(2))
        return self._add_shifted(out.view(down.shape), down, 1, 0).flatten(0, 1).flatten(1)

    def _add_shifted(self, out: Tensor, values: Tensor, axis: int, start: int) -> Tensor:
        """Add to `out`, in place, values shifted by the same offset -radius..-1, 1..radius along both axes.

        Args:
            out: (rows, w, h2, w2). values: with more rows, of which out's first is number `start`.
            axis: 0, rows, or 1, columns, of target and reference.
        """
        size, size2, there = out.shape[axis], out.shape[axis + 2], values.shape[axis]
        for d in [*range(-self._radius, 0), *range(1, self._radius + 1)]:
            begin, end = max(0, -start - d), min(size, there - start - d)
            begin2, end2 = max(0, -d), min(size2, size2 - d)
            if begin < end and begin2 < end2:
                shifted = values.narrow(axis, begin + start + d, end - begin)
                here = out.narrow(axis, begin, end - begin).narrow(axis + 2, begin2, end2 - begin2)
                here.add_(shifted.narrow(axis + 2, begin2 + d, end2 - begin2))
        return out


def search(target: Tensor, reference: Tensor, radius: int, target_mask: Tensor, reference_mask: Tensor, both: bool):
    """Best match of every position, in one direction or both, from the same similarity; of equal ones the first.

    Args:
        target: (N, C, h, w) features; reference: (N or 1, C, h2, w2).
        target_mask: (N, h, w) bool, reference_mask: (h2, w2) bool: where a match may lie.
        both: also return the field from reference to target (the same matrix read along its other axis).

    Returns:
        field (N, h, w), similarity (N, h, w), reverse field (N, h2, w2) or None, reverse similarity or None.
    """
    shape, shape2 = target.shape[1:], reference.shape[1:]
    rows = shape[1]
    if target.device.type == "cpu":
        rows = min(rows, max(1, _BLOCK_ENTRIES // (shape[2] * shape2[1] * shape2[2])))
    sums = PatchSums(shape, shape2, radius, rows, target.dtype, target.device)
    found = [
        _search_one(sums, side, reference[n if len(reference) > 1 else 0], target_mask[n], reference_mask, both)
        for n, side in enumerate(target)
    ]
    field, similarity, reverse, reverse_similarity = (
        torch.stack(values) if values[0] is not None else None for values in zip(*found)
    )
    scale = (2 * radius + 1) ** 2
    return field, similarity / scale, reverse, None if reverse_similarity is None else reverse_similarity / scale


def _search_one(
    sums: PatchSums, target: Tensor, reference: Tensor, target_mask: Tensor, reference_mask: Tensor, both: bool
):
    """Best matches by the sums over patches."""
    (h, w), (h2, w2) = target.shape[1:], reference.shape[1:]
    # Penalties, since writing into some rows or columns takes longer than the search: 0 where a match may lie.
    penalty = torch.where(reference_mask.reshape(-1), 0.0, _EXCLUDED)
    row_penalty = torch.where(target_mask, 0.0, 2 * _EXCLUDED)
    forward = []
    best = torch.full((h2 * w2,), -torch.inf, device=target.device)
    position = torch.zeros(h2 * w2, dtype=torch.int64, device=target.device)
    for first, block in sums.blocks(target, reference, penalty):
        forward.append(_largest_of_rows(block))
        if both:
            block.add_(row_penalty.view(-1, 1)[first * w : first * w + len(block)])
            raise_largest_of_columns(block, first * w, best, position)
    if both:  # positions where no match may lie take the first allowed row: what is warped there looks like nothing
        first_row = target_mask.reshape(-1).to(torch.uint8).argmax()
        position = torch.where(penalty < 0, first_row, position)
        best = torch.where(penalty < 0, _EXCLUDED, best)
    similarity = torch.cat([values for values, _ in forward]).view(h, w)
    field = torch.cat([index for _, index in forward]).view(h, w)
    return field, similarity, *((position.view(h2, w2), best.view(h2, w2)) if both else (None, None))


def _largest_of_rows(block: Tensor) -> tuple[Tensor, Tensor]:
    """`block.max(dim=1)`, four times as fast on a CPU: the best group of columns first, then the best column inside."""
    rows, columns = block.shape
    side = math.gcd(columns, _GROUP)
    groups = block.view(rows, columns // side, side)
    group = groups.amax(2).argmax(1)
    values, inside = groups[torch.arange(rows, device=block.device), group].max(1)
    return values, group * side + inside


def raise_largest_of_columns(block: Tensor, offset: int, best: Tensor, position: Tensor) -> None:
    """Where a column has a number above `best`, put it there, and its row (+ offset) into `position`.

    The best group of rows first; the row inside only for columns that have improved: all of them in the first block (a
    GPU has no other, and is not asked for their number, which would make it wait).
    """
    rows, columns = block.shape
    side = math.gcd(rows, _GROUP // 2)
    groups = block.view(rows // side, side, columns)
    values, group = groups.amax(1).max(0)
    better = (values > best).nonzero()[:, 0] if offset else torch.arange(columns, device=block.device)
    inside = groups[group[better], :, better].max(1).indices
    best[better], position[better] = values[better], group[better] * side + inside + offset
