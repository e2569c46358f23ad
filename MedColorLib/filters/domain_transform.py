"""Domain transform filter (Gastal, Oliveira: Domain Transform for Edge-Aware Image and Video Processing, 2011)."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import numpy as np

from . import opencv, options
from .checks import float64_pair, in_range_of, output_dtype, require_parameters


@dataclass(frozen=True)
class DomainTransformParameters:
    """Parameters of the domain transform filter.

    Attributes:
        sigma_s: spatial standard deviation in pixels, 1e-3..1e9.
        sigma_r: range standard deviation in the guide's units, 1e-100..1e100; the default is for 8-bit guides.
        iterations: 1 to 30; each runs along rows, both ways, then along columns.
    """

    sigma_s: float = options.number(8.0, 1e-3, 1e9, "Distance over which colours mix.", "px")
    sigma_r: float = options.number(
        200.0, 1e-100, 1e100, "Difference of luminance across which colours mix less.", "of 255"
    )
    iterations: int = options.count(3, 1, 30, "Passes, each along rows and then along columns.")

    def __post_init__(self) -> None:
        options.check(self)


def _recurse(lines: np.ndarray, feedback: np.ndarray) -> None:
    """J_i = f_i + w_i (J_(i-1) - f_i) along the first axis and back, in place. lines (n, C, L), feedback (n - 1, L)."""
    rows, weights = list(lines), list(feedback)
    step = np.empty_like(lines[0])
    pairs = zip(rows, rows[1:], weights)
    back = zip(rows[:0:-1], rows[-2::-1], weights[::-1])
    for one_way in (pairs, back):
        for previous, current, weight in one_way:
            np.subtract(previous, current, out=step)
            step *= weight
            np.add(current, step, out=current)


def domain_transform(
    source: np.ndarray, guide: np.ndarray, sigma_s: float = 8.0, sigma_r: float = 200.0, iterations: int = 3
) -> np.ndarray:
    """Smooth an image except across the edges of a guide, by recursive filtering (RF) in the transformed domain.

    Neighbouring pixels are at the distance d = 1 + sigma_s / sigma_r |guide difference|; iteration i of N runs a
    recursion with feedback exp(-sqrt(2) d / sigma_i), sigma_i = sigma_s sqrt(3) 2^(N-i) / sqrt(4^N - 1). The result is linear
    in the source and within its range; constants stay exactly. In float64, but for numbers of up to 32 bits where OpenCV's
    filter is within 1e-5 of the source's largest magnitude: sigma_s from 1 to 200 px, sigma_r from 0.1, guides up to 1e4.

    Args:
        source: (H, W) or (H, W, C), any real dtype and range.
        guide: (H, W), any real dtype; `sigma_r` is in its units.
        sigma_s, sigma_r, iterations: see `DomainTransformParameters`.

    Returns:
        Shape of the source; its dtype for floats, float32 for integers.

    Raises:
        InputError: shapes that do not fit, empty arrays, NaN or infinite values.
        SettingsError: a parameter outside its range.
    """
    parameters = DomainTransformParameters(sigma_s, sigma_r, iterations)
    found = opencv.domain_transform(source, guide, sigma_s, sigma_r, iterations)
    if found is not None:
        return found.astype(output_dtype(source), copy=False)
    planes, guide64 = float64_pair(source, guide)
    ratio = parameters.sigma_s / parameters.sigma_r
    along_rows = 1.0 + ratio * np.abs(np.diff(guide64.T, axis=0))  # (W - 1, H)
    along_columns = 1.0 + ratio * np.abs(np.diff(guide64, axis=0))  # (H - 1, W)
    lines = np.ascontiguousarray(planes.transpose(1, 2, 0))  # (W, C, H)
    halvings = parameters.iterations
    for iteration in range(1, halvings + 1):
        sigma = parameters.sigma_s * math.sqrt(3.0) * 2.0 ** (halvings - iteration) / math.sqrt(4.0**halvings - 1.0)
        _recurse(lines, np.exp(along_rows * (-math.sqrt(2.0) / sigma)))
        lines = np.ascontiguousarray(lines.transpose(2, 1, 0))  # (H, C, W)
        _recurse(lines, np.exp(along_columns * (-math.sqrt(2.0) / sigma)))
        lines = np.ascontiguousarray(lines.transpose(2, 1, 0))
    result = in_range_of(lines.transpose(2, 0, 1), planes)
    return result.reshape(np.shape(source)).astype(output_dtype(source))


def smooth(source: np.ndarray, guide: np.ndarray, parameters: DomainTransformParameters | None = None) -> np.ndarray:
    """`domain_transform` with the signature of FILTERS: source (H, W, C), guide (H, W) in 0..255 -> like source."""
    parameters = DomainTransformParameters() if parameters is None else parameters
    require_parameters(parameters, DomainTransformParameters)
    return domain_transform(source, guide, **asdict(parameters))
