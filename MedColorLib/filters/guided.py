"""Guided filter (He, Sun, Tang: Guided Image Filtering, 2013): a local linear model of the source in the guide."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from . import options
from .checks import float64_pair, output_dtype, require_parameters


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


def _box_sums(planes: np.ndarray, radius: int) -> np.ndarray:
    """Sums over the windows, cut off at the border. planes (H, W, C) float64."""
    for axis in (0, 1):
        length = planes.shape[axis]
        shape = list(planes.shape)
        shape[axis] += 1
        cumulated = np.zeros(shape)
        np.cumsum(planes, axis=axis, out=cumulated[1:] if axis == 0 else cumulated[:, 1:])
        index = np.arange(length)
        ends, starts = np.minimum(index + radius + 1, length), np.maximum(index - radius, 0)
        planes = cumulated.take(ends, axis=axis)
        planes -= cumulated.take(starts, axis=axis)
    return planes


def _box_means(planes: np.ndarray, radius: int) -> np.ndarray:
    """Means over the pixels that each window really has."""
    sums = _box_sums(planes, radius)
    sums /= _box_sums(np.ones((*planes.shape[:2], 1)), radius)
    return sums


def guided_filter(source: np.ndarray, guide: np.ndarray, radius: int = 16, eps: float = 2.0) -> np.ndarray:
    """Smooth an image, following the guide where the guide varies.

    In each window q = a (I - mean I) + mean f with a = cov(I, f) / (var(I) + eps); the result averages the windows over
    each pixel. Moments are of centred values in float64: exact sums for 16-bit guides; for others var(I) is accurate to
    1e-15 of the guide's squared range. The result is linear in the source but not limited to its range.

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
    parameters = GuidedParameters(radius, eps)
    planes, guide64 = float64_pair(source, guide)
    source_mean = planes.mean(axis=(0, 1))
    planes -= source_mean
    guide64 -= np.round(guide64.mean())  # whole numbers stay whole: their sums are exact
    guide64 = guide64[..., None]
    radius = min(parameters.radius, max(guide64.shape[:2]))
    channels = planes.shape[2]
    means = _box_means(np.concatenate([guide64, guide64**2, planes, guide64 * planes], axis=2), radius)
    guide_mean, guide_square = means[..., :1], means[..., 1:2]
    local_mean, product = means[..., 2 : 2 + channels], means[..., 2 + channels :]
    variance = np.maximum(guide_square - guide_mean**2, 0.0)
    slope = (product - guide_mean * local_mean) / (variance + parameters.eps)
    offset = local_mean - slope * guide_mean
    means = _box_means(np.concatenate([slope, offset], axis=2), radius)
    result = means[..., :channels] * guide64 + means[..., channels:] + source_mean
    return result.reshape(np.shape(source)).astype(output_dtype(source))


def smooth(source: np.ndarray, guide: np.ndarray, parameters: GuidedParameters | None = None) -> np.ndarray:
    """`guided_filter` with the signature of FILTERS: source (H, W, C), guide (H, W) in 0..255 -> like source."""
    parameters = GuidedParameters() if parameters is None else parameters
    require_parameters(parameters, GuidedParameters)
    return guided_filter(source, guide, **asdict(parameters))
