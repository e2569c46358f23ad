"""Stage *grid*: target slices and reference on one raster, body outline on body outline.

Both bounding boxes are brought to the same size, so that a position on the raster is a position in the body, and the
reference's features are computed once for all slices.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

MARGIN = 8  # pixels of background around the body: the networks see an outline, not a cut


@dataclass(frozen=True)
class Grid:
    """Raster of `height` x `width` pixels, multiples of 16, with the body's box inside a margin of 8 pixels."""

    height: int
    width: int

    @property
    def inner(self) -> tuple[int, int]:
        """(rows, columns) that the body's bounding box fills."""
        return self.height - 2 * MARGIN, self.width - 2 * MARGIN


def choose_grid(size: int) -> Grid:
    """Square raster of `size` rounded up to a multiple of 16; at least 48, where layer 5 still has 3 x 3 positions."""
    side = max(48, -(-size // 16) * 16)
    return Grid(side, side)


def to_grid(picture: np.ndarray, grid: Grid) -> np.ndarray:
    """Resample a picture cut to its body, (h, w) or (h, w, c), onto the grid; float32, zero in the margin.

    Area averaging where pixels get larger, bilinear where they get smaller.
    """
    import cv2

    rows, cols = grid.inner
    shrinks = picture.shape[0] > rows or picture.shape[1] > cols
    method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    out = cv2.resize(np.ascontiguousarray(picture, dtype=np.float32), (cols, rows), interpolation=method)
    out = out if out.ndim == picture.ndim else out[..., None]
    padding = ((MARGIN, MARGIN), (MARGIN, MARGIN)) + ((0, 0),) * (picture.ndim - 2)
    return np.pad(out, padding)


def from_grid(values: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """The inverse for results: the grid's inner part (H, W[, c]) resampled to a body box of `shape` (rows, cols)."""
    import cv2

    inner = np.ascontiguousarray(values[MARGIN:-MARGIN, MARGIN:-MARGIN], dtype=np.float32)
    out = cv2.resize(inner, (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR)
    return out if out.ndim == values.ndim else out[..., None]


def continue_outwards(values: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Give pixels outside `mask` the value of the nearest pixel inside: no background colour at the outline.

    Args:
        values: (H, W, c); mask: (H, W) bool with at least one True.
    """
    from scipy import ndimage

    rows, cols = ndimage.distance_transform_edt(~mask, return_distances=False, return_indices=True)
    return values[rows, cols]
