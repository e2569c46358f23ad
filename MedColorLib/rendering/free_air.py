"""Says in each voxel of air how far a ray may go on without meeting tissue: two thirds of a picture's time is air."""

from __future__ import annotations

import numpy as np

BLOCK = 4  # voxels a side; distances are counted in such blocks
_FARTHEST = 62  # blocks, so that the distance in voxels stays within a byte


def mark_free_air(rgba: np.ndarray) -> None:
    """Write into red of voxels far from all that can be seen how many voxels around them are free, in place.

    `shaders.SKIP_AIR` reads it where alpha, green and blue are 0. Voxels next to tissue, whose colour interpolation may
    need, keep it.

    Args:
        rgba: (k, j, i, 4) uint8; what has alpha 0 cannot be seen.
    """
    voxels = rgba.view("<u4")[..., 0]  # red in the lowest byte, alpha in the highest
    distance = _distance(_occupied(voxels))
    free = np.where(distance > 1, (distance - 1) * BLOCK - 1, 0).astype(np.uint32)
    for k, plane in enumerate(voxels):
        pure = plane - np.uint32(1) < np.uint32(255)  # red alone, which would be taken for a distance
        if pure.any():
            plane[pure] |= np.uint32(1 << 16)
        blocks = free[k // BLOCK].repeat(BLOCK, axis=0).repeat(BLOCK, axis=1)[: plane.shape[0], : plane.shape[1]]
        np.copyto(plane, blocks, where=blocks > 0)


def _occupied(voxels: np.ndarray) -> np.ndarray:
    """(k, j, i) bool, for each block of voxels (k, j, i) uint32 whether anything in it can be seen."""
    found = []
    for k in range(0, len(voxels), BLOCK):
        most = voxels[k : k + BLOCK].max(axis=0)
        for axis in (0, 1):
            most = np.maximum.reduceat(most, np.arange(0, most.shape[axis], BLOCK), axis=axis)
        found.append(most >= 1 << 24)
    return np.stack(found)


def _distance(occupied: np.ndarray) -> np.ndarray:
    """(k, j, i) int, chessboard distance in blocks to the nearest occupied one; at most _FARTHEST."""
    import cv2

    square, within = np.ones((3, 3), np.uint8), occupied.astype(np.uint8)
    distance = np.full(occupied.shape, _FARTHEST)
    distance[occupied] = 0
    for step in range(1, _FARTHEST):
        planes = np.stack([cv2.dilate(plane, square) for plane in within])
        grown = planes.copy()
        np.maximum(grown[1:], planes[:-1], out=grown[1:])
        np.maximum(grown[:-1], planes[1:], out=grown[:-1])
        new = grown > within
        if not new.any():
            break
        distance[new] = step
        within = grown
    return distance
