"""Guided filter (He, Sun, Tang: Guided Image Filtering, 2013): a local linear model of the source in the guide."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import lru_cache

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

    def sums(self, plane: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        import cv2

        return cv2.boxFilter(plane, -1, self._side, dst=out, normalize=False, borderType=cv2.BORDER_CONSTANT)


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
    planes, centred = checked_planes(source, guide)
    centred -= centred.dtype.type(round(cv2.mean(centred)[0]))  # whole numbers stay whole
    largest = max(-float(centred.min()), float(centred.max()))
    small = all(max(-float(plane.min()), float(plane.max())) < _SINGLE_SOURCE for plane in planes)
    if planes[0].dtype == np.float32 and (
        parameters.eps < max(_SINGLE_EPS * largest**2, _LEAST_EPS) or not small or largest > 1e6
    ):
        planes, centred = [plane.astype(np.float64) for plane in planes], centred.astype(np.float64)
    result = _filtered(planes, centred, min(parameters.radius, max(centred.shape)), parameters.eps)
    return merged(result, source).astype(output_dtype(source), copy=False)


def _filtered(planes: list[np.ndarray], guide: np.ndarray, radius: int, eps: float) -> list[np.ndarray]:
    """The filter on channels (H, W), which are overwritten, of the dtype of the centred guide (H, W).

    With n the number of pixels of a window and S its sums: a = (n S(If) - S(I) S(f)) / (n S(I^2) - S(I)^2 + n^2 eps),
    b = (S(f) - a S(I)) / n, result (S(a) I + S(b)) / n.
    """
    windows = _windows(guide.shape, radius, guide.dtype.char)
    guide_sums, work = windows.sums(guide), guide * guide
    divisor = windows.sums(work)
    divisor *= windows.counts
    divisor -= np.multiply(guide_sums, guide_sums, out=work)
    np.maximum(divisor, 0, out=divisor)
    divisor += np.multiply(windows.squared_counts, guide.dtype.type(eps), out=work)
    of_product = windows.counts / divisor
    guide_sums *= -1
    of_sum = np.divide(guide_sums, divisor, out=divisor)
    spare = work, np.empty_like(guide)
    return [_filtered_plane(plane, guide, windows, (guide_sums, of_product, of_sum), spare) for plane in planes]


def _filtered_plane(plane: np.ndarray, guide: np.ndarray, windows: _Windows, shared: tuple, spare: tuple) -> np.ndarray:
    """One channel, which is overwritten, with what all channels share and two arrays to work in; formulas in `_filtered`."""
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
    result = windows.sums(sums)
    windows.sums(slope, plane)
    cv2.accumulateProduct(plane, guide, result)
    result *= windows.shares
    result += mean
    return result


def smooth(source: np.ndarray, guide: np.ndarray, parameters: GuidedParameters | None = None) -> np.ndarray:
    """`guided_filter` with the signature of FILTERS: source (H, W, C), guide (H, W) in 0..255 -> like source."""
    parameters = GuidedParameters() if parameters is None else parameters
    require_parameters(parameters, GuidedParameters)
    return guided_filter(source, guide, **asdict(parameters))
