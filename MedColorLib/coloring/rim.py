"""Stage *rim*: colour goes on across the border of tissue and fades as the scan itself fades there.

A body cut out by a mask ends in a step, and shading shows each voxel of a step as a stair: rings like wood grain. The scan
has no step: voxels at the skin are part air. So the outermost two voxels of tissue and three voxels beyond take the colour
of the tissue around them, times the scan's own ramp from air to that tissue. Voxels that are all tissue count for far more
than those that hold air, so that a thin skin keeps its colour and none is taken from air. Noise outside fades out: it counts
from its own level on, and never grows outwards. Air inside the body (sinuses, lungs) is not cut out by a mask: there
luminance follows the scan by itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from ..device import Each

INSIDE, OUTSIDE = 2, 3  # voxels that take part on either side of the border
_FADE = (1.0, 0.8, 0.45)  # most of the ramp that is left in the first, second, third voxel outside
_FULLEST = 1.5  # a voxel may hold more than the mean around it
_SLAB_VOXELS = 2_500_000  # of the body's boxes in one slab, about 30 bytes each
_AT_ONCE = 2  # slabs, if there are threads for them
_SLAB_SLICES = 32  # at most: more save little, and memory would grow with the stack
_MARGIN = OUTSIDE + INSIDE + 2  # pixels around the body's box
_THICK = 2.0  # slices so many times farther apart than pixels are no neighbours


def air_level(values: Sequence[np.ndarray], mask: Sequence[np.ndarray], threshold: float) -> float:
    """Value from which something counts as more than air.

    Args:
        values: (k, j, i) scalars. mask: (k, j, i) bool, the body. threshold: between air and tissue.

    Returns:
        What nine in ten voxels outside the body stay below, at most a quarter of the way from their median to the threshold
        (a table lies there, too); the smallest value where there is hardly anything outside.
    """
    ks = range(0, len(values), max(1, len(values) // 16))
    outside = np.concatenate([values[k][~mask[k]][::7] for k in ks])
    outside = outside[np.isfinite(outside)].astype(np.float64)
    if outside.size < 100:
        lowest = [float(np.nanmin(values[k])) for k in ks if np.isfinite(values[k]).any()]
        return min([*lowest, float(threshold)])
    median, most = np.percentile(outside, (50, 90))
    return float(min(most, median + 0.25 * max(threshold - median, 0.0)))


def add_rim(
    rgb: np.ndarray,
    mask: Sequence[np.ndarray],
    values: Sequence[np.ndarray],
    threshold: float,
    air: float,
    spacing_mm: tuple[float, float, float] = (1.0, 1.0, 1.0),
    slices: np.ndarray | None = None,
    check: Callable[[], None] = lambda: None,
    each: Each = map,
) -> int:
    """Give the border of tissue the scan's own ramp, in place.

    The ends of the arrays are no border: a body that goes on beyond them is cut there.

    Args:
        rgb: (k, j, i, 3) uint8 colours, black where there are none; changed.
        mask: (k, j, i) bool, where the body was coloured.
        values: (k, j, i) scalars of the scan; NaN counts as air. Of mask and values single planes [k] are asked for.
        threshold: value between air and tissue. air: `air_level`.
        spacing_mm: (k, j, i). Along an axis of more than twice the smallest spacing nothing goes on.
        slices: (k,) bool, which may be changed; None: all.
        check: called again and again; may raise to stop.
        each: does slabs of slices side by side; see `device.side_by_side`.

    Returns:
        How many voxels were changed.
    """
    spacing = np.asarray(spacing_mm, dtype=np.float64)
    reach = tuple(bool(n) for n in spacing <= _THICK * spacing.min())
    halo = INSIDE + OUTSIDE + 1 if reach[0] else 0
    least = max(4, halo)  # a slab looks into its neighbours, not beyond them
    count = min(max(least, _SLAB_VOXELS // _box_area(mask) - 2 * halo), _SLAB_SLICES)

    def ramped(start: int):
        check()
        return _slab(rgb, mask, values, (start, start + count), halo, threshold, air, reach, slices, check)

    starts, last, changed = range(0, len(rgb), count), None, 0
    for n in range(0, len(starts), _AT_ONCE):
        *done, newest = [last, *each(ramped, starts[n : n + _AT_ONCE])]
        changed += sum(_put(rgb, *slab) for slab in done if slab)
        last = newest  # those that come next look at it as it was
    return changed + (_put(rgb, *last) if last else 0)


def _slab(rgb, mask, values, ends: tuple[int, int], halo: int, threshold, air, reach, slices, check) -> tuple | None:
    """(its slices, rows and columns, new colours, where they count) of some slices; None where there is no body."""
    low, high = max(ends[0] - halo, 0), min(ends[1] + halo, len(rgb))
    masks = np.stack([mask[k] for k in range(low, high)])
    if not masks.any():
        return None
    box = _box(masks, _MARGIN)
    level = np.stack([_level(values[k][box], threshold, air) for k in range(low, high)])
    inside = (slice(None), *box)
    new, where = _ramped(rgb[low:high][inside], masks[inside], level, reach, check)
    if slices is not None:
        where[~slices[low:high]] = False
    own = slice(ends[0] - low, min(ends[1], len(rgb)) - low)
    return slice(*ends), box, new[own].copy(), where[own].copy()


def _level(values: np.ndarray, threshold: float, air: float) -> np.ndarray:
    """float32, 0 at air and 1 at the threshold, whatever the units; what is not finite is air."""
    span = threshold - air
    with np.errstate(over="ignore", invalid="ignore"):
        level = (values.astype(np.float64) - air) / (span if span > 0 else 1.0)
    return np.nan_to_num(level.clip(-1, 200), nan=0.0).astype(np.float32)


def _put(rgb: np.ndarray, planes: slice, box: tuple, new: np.ndarray, where: np.ndarray) -> int:
    rgb[planes][(slice(None), *box)][where] = new[where]
    return int(np.count_nonzero(where))


def _box(mask: np.ndarray, margin: int) -> tuple[slice, slice]:
    """Rows and columns of the mask with a margin."""
    ends = [np.flatnonzero(mask.any(axis=axes)) for axes in ((0, 2), (0, 1))]
    return tuple(slice(max(e[0] - margin, 0), e[-1] + 1 + margin) for e in ends)


def _box_area(mask: Sequence[np.ndarray]) -> int:
    """Pixels of the largest box around the body in a few of its planes."""
    areas = [1]
    for k in range(0, len(mask), max(1, len(mask) // 16)):
        rows, cols = (np.flatnonzero(mask[k].any(axis=axis)) for axis in (1, 0))
        if rows.size:
            areas.append(int((np.ptp(rows) + 1 + 2 * _MARGIN) * (np.ptp(cols) + 1 + 2 * _MARGIN)))
    return max(areas)


def _ramped(rgb: np.ndarray, mask: np.ndarray, level: np.ndarray, reach, check) -> tuple[np.ndarray, np.ndarray]:
    """New colours (k, j, i, 3) uint8 and the voxels (k, j, i) that take them; level: 0 at air, 1 at the threshold."""
    air_around = ~mask
    for _ in range(OUTSIDE):  # the mask may lie a little outside the skin
        air_around |= _dilated(air_around, reach) & (level < 1)
    near = air_around
    for _ in range(INSIDE):
        near = _dilated(near, reach)
    tissue, shell = np.pad(~air_around, 1), ~air_around & near
    inner = (slice(1, -1),) * 3
    # colour and level of the tissue behind; one voxel of nothing around so that flat offsets never leave the array
    state = np.zeros((*tissue.shape, 4), np.float16)
    state[inner][..., :3] = rgb
    state[inner][..., 3] = level.clip(0)
    border = np.flatnonzero(np.pad(shell, 1))
    for _ in range(INSIDE):
        check()
        _take_fullest(state, tissue, border, reach)
    layer = np.where(tissue, np.uint8(0), np.uint8(255))
    for distance in range(1, OUTSIDE + 1):
        check()
        new = np.zeros_like(tissue)
        new[inner] = (_dilated(tissue, reach) & ~tissue)[inner]
        _take_fullest(state, tissue, np.flatnonzero(new), reach)
        layer[new] = distance
        tissue |= new
    return _colours(state[inner], shell, layer[inner], level, reach)


def _colours(state, shell, layer, level, reach) -> tuple[np.ndarray, np.ndarray]:
    where = shell | ((layer > 0) & (layer <= OUTSIDE))
    ramp = np.where(layer == 0, np.float32(1), np.float32(0))
    ramp[where] = np.clip(level[where] / np.maximum(state[where][:, 3].astype(np.float32), 1e-3), 0.0, _FULLEST)
    for distance in range(1, OUTSIDE + 1):
        here = layer == distance
        ramp[here] = np.minimum(
            ramp[here], _highest(np.where(layer < distance, ramp, 0), here, reach) * _FADE[distance - 1]
        )
    new = np.zeros((*where.shape, 3), np.uint8)
    new[where] = np.rint((state[where][:, :3].astype(np.float32) * ramp[where][:, None]).clip(0, 255))
    return new, where


def _offsets(shape: tuple[int, ...], reach: tuple[bool, ...]) -> list[tuple[int, float]]:
    """Flat offset and binomial weight of the neighbours along the axes that take part."""
    steps = [(-1, 0, 1) if each else (0,) for each in reach]
    return [
        ((dk * shape[1] + dj) * shape[2] + di, 0.5 ** (abs(dk) + abs(dj) + abs(di)))
        for dk, dj, di in product(*steps)
        if dk or dj or di
    ]


def _take_fullest(state: np.ndarray, known: np.ndarray, targets: np.ndarray, reach) -> None:
    """Give the voxels `targets` (flat) the mean of what they touch, in which voxels that hold more tissue count for more."""
    flat, flat_known = state.reshape(-1, 4), known.reshape(-1)
    voxels = state.view(np.uint64).reshape(-1)  # a voxel is one number: read at once
    total = np.zeros((targets.size, 4), np.float32)
    weights = np.zeros(targets.size, np.float32)
    places = np.empty_like(targets)
    for offset, weight in [(0, 1.0), *_offsets(known.shape, reach)]:
        np.add(targets, offset, out=places)
        neighbour = voxels.take(places).view(np.float16).reshape(-1, 4).astype(np.float32)
        share = neighbour[:, 3] + np.float32(1e-3)
        share *= share
        share *= share * (flat_known.take(places) * np.float32(weight))
        total += np.multiply(neighbour, share[:, None], out=neighbour)
        weights += share
    found = weights > 0
    flat[targets[found]] = total[found] / weights[found, None]


def _highest(values: np.ndarray, where: np.ndarray, reach) -> np.ndarray:
    """Largest value among the neighbours of the voxels `where`, as a list in their order."""
    padded = np.pad(values, 1)
    targets = np.flatnonzero(np.pad(where, 1))
    flat = padded.reshape(-1)
    best = np.zeros(targets.size, np.float32)
    for offset, _weight in _offsets(padded.shape, reach):
        np.maximum(best, flat[targets + offset], out=best)
    return best


def _dilated(mask: np.ndarray, reach: tuple[bool, ...]) -> np.ndarray:
    """Mask grown by one voxel along the axes that take part, diagonals included."""
    grown = mask
    for axis in range(3):
        if not reach[axis]:
            continue
        source, grown = grown, grown.copy()
        towards, back = [slice(None)] * 3, [slice(None)] * 3
        towards[axis], back[axis] = slice(1, None), slice(None, -1)
        grown[tuple(towards)] |= source[tuple(back)]
        grown[tuple(back)] |= source[tuple(towards)]
    return grown
