"""Stage *body*: which of the things that are no air are the body, plane by plane: labels of a whole stack take too much memory.

Everything that is tissue stays, joined or not: arms, legs, ears, several animals. What goes: specks of noise, ghosts too weak
to be tissue, and plates: long, thin things at one place through the stack, such as a table, a holder or wires.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..progress import check

TISSUE, CLEAR, PLATE, BODY = (np.uint8(1 << n) for n in range(4))  # bits of the flags of a voxel of the reduced raster

_LONG = 0.15  # of the picture's side: shorter things are ears, noses and fingers
_PERSISTENT = 0.3  # of the slices
_MOST_PLATES = 0.6  # of what is no air: a mouse on its bed
_LARGE = 0.02  # of the largest part


def disc(radius: int) -> np.ndarray:
    """Structuring element (2 radius + 1, 2 radius + 1)."""
    import cv2

    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def opened(plane: np.ndarray, radius: int) -> np.ndarray:
    """(h, w) bool: what a disc fits into; beyond the border of the picture it goes on as it ends."""
    import cv2

    wide = cv2.copyMakeBorder(plane.astype(np.uint8), *([2 * radius] * 4), cv2.BORDER_REPLICATE)
    rows, cols = plane.shape
    fitting = cv2.morphologyEx(wide, cv2.MORPH_OPEN, disc(radius))
    return fitting[2 * radius : 2 * radius + rows, 2 * radius : 2 * radius + cols] > 0


def holes_filled(plane: np.ndarray) -> np.ndarray:
    """(h, w) bool: with what the border cannot reach."""
    import cv2

    empty = cv2.copyMakeBorder((~plane).astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=1)
    labels = cv2.connectedComponents(empty, connectivity=4)[1]
    return (labels != labels[0, 0])[1:-1, 1:-1]


def filled(plane: np.ndarray, radius: int) -> np.ndarray:
    """Fill cavities, also those that open to the outside by a gap of up to `radius` pixels (nostrils, orbits).

    Gaps between things that lie side by side (two legs, arm and trunk) stay open.
    """
    import cv2

    if not plane.any():
        return plane
    rows, cols = plane.shape
    wide = cv2.copyMakeBorder(plane.astype(np.uint8), *([2 * radius] * 4), cv2.BORDER_CONSTANT, value=0)
    closed = cv2.morphologyEx(wide, cv2.MORPH_CLOSE, disc(radius)) > 0
    cavities = holes_filled(closed) & ~closed
    if cavities.any():
        wide = (wide > 0) | cavities | (closed & (cv2.dilate(cavities.astype(np.uint8), disc(radius + 1)) > 0))
    return holes_filled(wide > 0)[2 * radius : 2 * radius + rows, 2 * radius : 2 * radius + cols]


def without_mottle(plane: np.ndarray, strong: np.ndarray, radius: int) -> np.ndarray:
    """Weak pixels stay only inside what is strong or where a disc fits: noise and ghosts are mottled, dim tissue is solid."""
    inside = filled(strong, 2 * radius)
    return strong | (plane & (inside | opened(plane | inside, radius)))


def mark_plates(flags: np.ndarray) -> None:
    """Set PLATE where something long and thin stays at one place through the stack.

    Nothing in stacks of under 4 slices, nor where that would be most of what is no air.
    """
    import cv2

    if len(flags) < 4:
        return
    side = max(flags.shape[1:])
    radius = max(2, round(side / 48))
    times = np.zeros(flags.shape[1:], np.int32)
    for plane in flags:
        check()
        tissue = (plane & TISSUE) > 0
        thin = (tissue & ~opened(holes_filled(tissue), radius)).astype(np.uint8)
        _, labels, stats, _ = cv2.connectedComponentsWithStats(thin, connectivity=8)
        long = stats[:, 2:4].max(1) >= _LONG * side
        long[0] = False
        plates = long[labels]
        plane[plates] |= PLATE
        times += plates
    often = (times >= max(3, _PERSISTENT * len(flags))).astype(np.uint8)
    often = cv2.dilate(often, np.ones((3, 3), np.uint8)) > 0
    found = tissue_count = 0
    for plane in flags:
        plane[~often] &= ~PLATE
        found += np.count_nonzero(plane & PLATE)
        tissue_count += np.count_nonzero(plane & TISSUE)
    if found > _MOST_PLATES * tissue_count:  # not a table but a body of thin parts
        flags &= ~PLATE


@dataclass
class _Parts:
    """3-D connected parts.

    Attributes:
        of: (n,) for each part of a plane, numbered from the first plane on, the part it belongs to.
        firsts: for each plane the number of its first part.
        size, clear, thick: voxels, clear ones, those that survive an opening. extent: longest side in the plane.
    """

    of: np.ndarray
    firsts: list[int]
    size: np.ndarray
    clear: np.ndarray
    thick: np.ndarray
    extent: np.ndarray


def mark_body(flags: np.ndarray, may_hold_plates: bool) -> None:
    """Set BODY where TISSUE without PLATE belongs to the body.

    Large parts are body, the one with most clear tissue in any case; small ones where they are clear and close to a large
    one. Specks far from everything (skin markers, noise) are not.
    """
    side = max(flags.shape[1:])
    parts = _find_parts(flags, max(1, round(side / 100)))
    if not parts.size.size:
        return
    large = (parts.size >= _LARGE * parts.size.max()) & (parts.clear >= 0.1 * parts.size)
    plate = np.zeros(large.shape, bool)
    if may_hold_plates:
        plate = (parts.thick < 0.15 * parts.size) & (parts.extent > _LONG * side)
        plate &= parts.size < 0.3 * parts.size.max()
    large &= ~plate
    large[np.argmax(parts.clear)] = True
    _select(flags, parts, large)
    near = _near_body(flags, parts, max(2, round(side / 50)))
    _select(flags, parts, large | (near & ~plate & (parts.clear >= 0.2 * parts.size) & (parts.size >= 4)))


def _labels(plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Labels of what may be body in a plane of flags, and their statistics without the background's."""
    import cv2

    check()
    chosen = ((plane & (TISSUE | PLATE)) == TISSUE).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(chosen, connectivity=4)
    return labels, stats[1:]


def _find_parts(flags: np.ndarray, thin: int) -> _Parts:
    from scipy import sparse

    columns, boxes, links, firsts, first = [], [], [], [], 0
    below, below_first = np.zeros(flags.shape[1:], np.int32), 0
    for plane in flags:
        labels, stats = _labels(plane)
        count = len(stats)
        clear = np.bincount(labels[(plane & CLEAR) > 0], minlength=count + 1)[1:]
        thick = np.bincount(labels[opened(labels > 0, thin)], minlength=count + 1)[1:]
        columns.append(np.stack([stats[:, 4], clear, thick]))
        boxes.append(np.column_stack([stats[:, :2], stats[:, :2] + stats[:, 2:4]]))
        links.append(_overlaps(below, labels) + np.array([[below_first - 1], [first - 1]]))
        firsts.append(first)
        below, below_first, first = labels, first, first + count
    low, high = np.concatenate(links, axis=1)
    graph = sparse.coo_matrix((np.ones(low.size, bool), (low, high)), (first, first))
    count, of = sparse.csgraph.connected_components(graph, directed=False) if first else (0, np.zeros(0, int))
    size, clear, thick = (np.bincount(of, column, count) for column in np.concatenate(columns, axis=1))
    ends = np.tile([1 << 30, 1 << 30, 0, 0], (count, 1))
    box = np.concatenate(boxes)
    np.minimum.at(ends[:, :2], of, box[:, :2])
    np.maximum.at(ends[:, 2:], of, box[:, 2:])
    return _Parts(of, firsts, size, clear, thick, (ends[:, 2:] - ends[:, :2]).max(1) if count else np.zeros(0))


def _overlaps(below: np.ndarray, above: np.ndarray) -> np.ndarray:
    """(2, n) int64: which labels of two planes lie on each other, 0 (nothing) left out."""
    both = (below > 0) & (above > 0)
    keys = np.unique(below[both].astype(np.int64) << 32 | above[both])
    return np.stack([keys >> 32, keys & 0xFFFFFFFF])


def _select(flags: np.ndarray, parts: _Parts, chosen: np.ndarray) -> None:
    """BODY on exactly the parts (n,) bool that are `chosen`."""
    for plane, first in zip(flags, parts.firsts):
        labels, stats = _labels(plane)
        body = np.concatenate([[False], chosen[parts.of[first : first + len(stats)]]])[labels]
        plane[:] = np.where(body, plane | BODY, plane & ~BODY)


def _near_body(flags: np.ndarray, parts: _Parts, reach: int) -> np.ndarray:
    """(n,) bool: parts within `reach` pixels of BODY in their slice or the next."""
    import cv2

    near = np.zeros(parts.size.shape, bool)
    if near.size == 1:
        return near
    for k, (plane, first) in enumerate(zip(flags, parts.firsts)):
        if not (plane & (TISSUE | PLATE | BODY) == TISSUE).any():
            continue
        labels = _labels(plane)[0]
        body = (np.bitwise_or.reduce(flags[max(k - 1, 0) : k + 2], axis=0) & BODY) > 0
        there = cv2.dilate(body.astype(np.uint8), disc(reach)) > 0
        found = np.unique(labels[there])
        near[parts.of[first + found[found > 0] - 1]] = True
    return near
