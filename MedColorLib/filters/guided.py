"""Guided filter (He, Sun, Tang: Guided Image Filtering, 2013): a local linear model of the source in the guide."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import lru_cache
from itertools import islice

import numpy as np

from . import options
from .checks import checked_planes, merged, output_dtype, require_parameters


@dataclass(frozen=True)
class GuidedParameters:
    """Parameters of the guided filter.

    Attributes:
        radius: of the square window in pixels, 0..100000; a window has (2 radius + 1)^2 pixels, fewer at the border.
        eps: guide variance below which a window is averaged rather than followed, in guide units squared,
            1e-100..1e100. The paper's eps = 2 is for 8-bit guides: a standard deviation of 1.4 grey levels.
    """

    radius: int = options.count(16, 0, 100_000, "Half the side of the window.", "px")
    eps: float = options.number(
        2.0, 1e-100, 1e100, "Variance of luminance below which a window is averaged rather than followed.", "of 255²"
    )

    def __post_init__(self) -> None:
        options.check(self)


_SINGLE_EPS = 6e-5  # of the largest squared centred guide from which float32 is enough: eps = 1 for 8 bits
_LEAST_EPS = 1e-30  # float32 has no square of a window's size times less than that
_SINGLE_SOURCE = 1e20  # largest magnitude whose products stay inside float32


def _window_counts(length: int, radius: int) -> np.ndarray:
    """How many pixels of a line each window really has."""
    index = np.arange(length)
    return np.minimum(index + radius + 1, length) - np.maximum(index - radius, 0)


class _Windows:
    """Sums over the windows, cut off at the border: OpenCV's running sums, which it keeps in float64.

    Attributes:
        counts, squared_counts, shares: (H, W) number of pixels n of each window, n^2 and 1 / n.
    """

    def __init__(self, shape: tuple[int, int], radius: int, dtype: np.dtype) -> None:
        self._side = (2 * radius + 1,) * 2
        rows, columns = (_window_counts(n, radius).astype(dtype) for n in shape)
        self.counts = rows[:, None] * columns
        self.squared_counts, self.shares = self.counts**2, 1 / self.counts
        for array in (self.counts, self.squared_counts, self.shares):
            array.setflags(write=False)

    def sums(self, plane: np.ndarray, out: np.ndarray) -> np.ndarray:
        import cv2

        return cv2.boxFilter(plane, -1, self._side, dst=out, normalize=False, borderType=cv2.BORDER_CONSTANT)


class _Room(threading.local):
    """Arrays to work in that are used again by calls of one size, a set for every thread.

    Fresh ones cost as much as the arithmetic: the system hands them out page by page.
    """

    _MOST_BYTES = 40 << 20  # a thread; of more nothing is kept
    _kept: tuple[np.ndarray, ...] = ()

    def arrays(self, count: int, shape: tuple[int, int], dtype: np.dtype) -> Iterator[np.ndarray]:
        """`count` arrays of that kind; they hold anything, or what was put into them since they were asked for."""
        kept = self._kept
        if len(kept) != count or kept[0].shape != shape or kept[0].dtype != dtype:
            size = shape[0] * shape[1]
            line = np.empty((count, size + _APART), dtype)
            kept = tuple(row[:size].reshape(shape) for row in line)
            self._kept = kept if line.nbytes <= self._MOST_BYTES else ()
        return iter(kept)


_APART = 272  # numbers between arrays: at distances of whole pages they would be in each other's way in the cache
_ROOM = _Room()
_SHARED = 6  # arrays beside the channels: the guide, and five to work in


def _room(channels: int, shape: tuple[int, int], dtype: np.dtype) -> Iterator[np.ndarray]:
    """The channels' arrays, the guide's, and five more."""
    return _ROOM.arrays(channels + _SHARED, shape, dtype)


@lru_cache(maxsize=4)  # slices of a volume are of few sizes
def _windows(shape: tuple[int, int], radius: int, dtype: str) -> _Windows:
    return _Windows(shape, radius, np.dtype(dtype))


def guided_filter(source: np.ndarray, guide: np.ndarray, radius: int = 16, eps: float = 2.0) -> np.ndarray:
    """Smooth an image, following the guide where the guide varies.

    In each window q = a (I - mean I) + mean f with a = cov(I, f) / (var(I) + eps); the result averages the windows over
    each pixel. Moments are of centred values, their sums in float64. For sources of float64 so is all the rest; for others
    it is in float32 where that is within 1e-5 of the source's largest magnitude: eps above 6e-5 of the centred guide's
    largest square. The result is linear in the source but not limited to its range.

    Args:
        source: (H, W) or (H, W, C), any real dtype and range.
        guide: (H, W), any real dtype; `eps` is in its units squared.
        radius, eps: see `GuidedParameters`.

    Returns:
        Shape of the source; its dtype for floats, float32 for integers.

    Raises:
        InputError: shapes that do not fit, empty arrays, NaN or infinite values.
        SettingsError: a parameter outside its range.
    """
    import cv2

    parameters = GuidedParameters(radius, eps)
    planes, centred = checked_planes(source, guide, _room)
    centred -= centred.dtype.type(round(cv2.mean(centred)[0]))  # whole numbers stay whole
    largest = max(-float(centred.min()), float(centred.max()))
    small = all(max(-float(plane.min()), float(plane.max())) < _SINGLE_SOURCE for plane in planes)
    if planes[0].dtype == np.float32 and (
        parameters.eps < max(_SINGLE_EPS * largest**2, _LEAST_EPS) or not small or largest > 1e6
    ):
        planes, centred = [plane.astype(np.float64) for plane in planes], centred.astype(np.float64)
    result = _filtered(planes, centred, min(parameters.radius, max(centred.shape)), parameters.eps)
    # of several channels `merged` makes a new array; a single one still lies in the room
    return merged(result, source).astype(output_dtype(source), copy=len(result) == 1)


def _filtered(planes: list[np.ndarray], guide: np.ndarray, radius: int, eps: float) -> list[np.ndarray]:
    """The filter on channels (H, W), which are overwritten, of the dtype of the centred guide (H, W).

    With n the number of pixels of a window and S its sums: a = (n S(If) - S(I) S(f)) / (n S(I^2) - S(I)^2 + n^2 eps),
    b = (S(f) - a S(I)) / n, result (S(a) I + S(b)) / n.
    """
    windows = _windows(guide.shape, radius, guide.dtype.char)
    guide_sums, work, divisor, of_product, slope = islice(
        _room(len(planes), guide.shape, guide.dtype), len(planes) + 1, None
    )
    np.multiply(guide, guide, out=work)
    windows.sums(guide, guide_sums)
    windows.sums(work, divisor)
    divisor *= windows.counts
    divisor -= np.multiply(guide_sums, guide_sums, out=work)
    np.maximum(divisor, 0, out=divisor)
    divisor += np.multiply(windows.squared_counts, guide.dtype.type(eps), out=work)
    np.divide(windows.counts, divisor, out=of_product)
    guide_sums *= -1
    of_sum = np.divide(guide_sums, divisor, out=divisor)
    for plane in planes:
        _filter_plane(plane, guide, windows, (guide_sums, of_product, of_sum), (work, slope))
    return planes


def _filter_plane(plane: np.ndarray, guide: np.ndarray, windows: _Windows, shared: tuple, spare: tuple) -> None:
    """One channel, in place, with what all channels share and two arrays to work in; formulas in `_filtered`."""
    import cv2

    (minus_guide_sums, of_product, minus_of_sum), (sums, slope) = shared, spare
    mean = plane.dtype.type(cv2.mean(plane)[0])
    plane -= mean
    windows.sums(plane, sums)
    plane *= guide
    windows.sums(plane, slope)
    slope *= of_product
    cv2.accumulateProduct(sums, minus_of_sum, slope)
    cv2.accumulateProduct(slope, minus_guide_sums, sums)
    sums *= windows.shares  # the offset
    windows.sums(sums, plane)
    windows.sums(slope, sums)
    cv2.accumulateProduct(sums, guide, plane)
    plane *= windows.shares
    plane += mean


def smooth(source: np.ndarray, guide: np.ndarray, parameters: GuidedParameters | None = None) -> np.ndarray:
    """`guided_filter` with the signature of FILTERS: source (H, W, C), guide (H, W) in 0..255 -> like source."""
    parameters = GuidedParameters() if parameters is None else parameters
    require_parameters(parameters, GuidedParameters)
    return guided_filter(source, guide, **asdict(parameters))
