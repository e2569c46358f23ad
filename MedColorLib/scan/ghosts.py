"""Stage *body*: ghosts of a moving body in MR, beside it along the phase direction: noise brighter than that of the air.

They are told from dim tissue by their texture: magnitudes of noise lie within about two standard deviations of zero
(1.91 for one coil), those of tissue lie farther. Only what reaches the air or the border of the picture through such noise is
taken, and only where it is broad: a rim of skin stays.
"""

from __future__ import annotations

import numpy as np

from .air import Air
from .parts import CLEAR, TISSUE, opened
from .reduced import resized

_NOISE = 2.8  # mean over standard deviation; lung in noise has it, too, but no way to the border
_SIGMA_PX = 2.0  # of the window, in pixels of the raster
_NARROW = 64  # narrower than the side of the raster over this stays
_MOST = 0.35  # of clear tissue: more is a scan that is hardly above its noise, and nothing is taken
_LEAST = 0.0005


def take_ghosts(flags: np.ndarray, array: np.ndarray, air: Air) -> float:
    """Remove TISSUE (and CLEAR) where it is a ghost.

    Args:
        flags: (k, h, w) uint8 on the reduced raster; changed in place.
        array: (k, j, i) scalars of the same slices.

    Returns:
        Share of the tissue that was taken, 0..1; 0 where air is no noise of magnitudes, where nothing or too much was found.
    """
    if air.dim is None:
        return 0.0
    found = np.zeros(flags.shape, bool)
    for out, plane, values in zip(found, flags, array):
        tissue = (plane & TISSUE) > 0
        if tissue.any():
            out[:] = _ghosts(tissue, _noisy(values, air, tissue.shape))
    share, of_clear = (
        np.count_nonzero(flags[found] & bit) / max(np.count_nonzero(flags & bit), 1) for bit in (TISSUE, CLEAR)
    )
    if share < _LEAST or of_clear > _MOST:
        return 0.0
    flags[found] &= ~(TISSUE | CLEAR)
    return share


def _noisy(values: np.ndarray, air: Air, size: tuple[int, int]) -> np.ndarray:
    """(h, w) bool: dim, and like the noise of magnitudes."""
    import cv2

    zero = air.scale.grey_of(0.0)
    grey = np.nan_to_num(air.scale.grey(values)) - np.float32(zero)
    mean, square = (cv2.GaussianBlur(resized(part, size), (0, 0), _SIGMA_PX) for part in (grey, grey * grey))
    deviation = np.sqrt(np.maximum(square - mean * mean, 0))
    return (mean < _NOISE * deviation) & (mean < air.scale.grey_of(air.dim) - zero)


def _ghosts(tissue: np.ndarray, noisy: np.ndarray) -> np.ndarray:
    """(h, w) bool: noisy tissue that is broad and that air or the border reaches."""
    import cv2

    mottled = cv2.blur(noisy.astype(np.float32), (7, 7)) > 0.5  # single brighter pixels are of it
    ghosts = opened(tissue & (noisy | mottled), max(3, round(max(tissue.shape) / _NARROW)))
    if not ghosts.any():
        return ghosts
    free = cv2.copyMakeBorder((ghosts | ~tissue).astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=1)
    labels = cv2.connectedComponents(free, connectivity=4)[1]
    return ghosts & (labels == labels[0, 0])[1:-1, 1:-1]
