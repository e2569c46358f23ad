"""Stage *natural lightness*: the reference's lightness for each tissue, with the scan's own detail on it.

Tissues change order between modalities: fat is darker than muscle in CT and lighter in a photograph. Keeping the scan's L*
shows what no anatomy has; taking the reference's loses what the scan alone knows. So each pixel is taken apart:

    L* = R + d,    d = L*_scan - E[L*_scan | place, R]

R is the lightness that the matches give a pixel. E is the scan's mean lightness of what has the same R nearby: of that
tissue. d, what the scan shows within a tissue, is the scan's own, whatever the order of the tissues. E is a bilateral grid
(place, R), like the regression of colour on grey, but the other way round.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..filters import regression

DETAIL_GAIN = 0.6  # of the scan's detail within a tissue; what a photograph's tissue shows beside a scan's
DETAIL_LIMIT = 30.0  # L*: detail larger than this is another tissue that the matches missed, and is pressed together
AIR_LIGHTNESS = 8.0  # L* of the scan below which a pixel fades to what it is in the scan: air stays black
_TISSUES = regression.RegressionParameters(cell_px=24.0, bins=24, support_px=16.0, levels=2)
_RASTER = 240  # pixels of the box's longer side to which `cell_px` refers
_NOISE_RADIUS_PX, _NOISE_DEVIATION = 2, 0.01  # square and least deviation of display grey that count as noise
# Deviations of the slice's own noise that do. Chest CT: no specks of fat in the liver; fewer leave some, four cost detail.
_NOISE_SIGMAS = 3.0
_COARSEST = 2.0  # times the noise of pixels: noise of twice their size; white noise has there what it has here
_AIR_GREY = 0.03  # display grey below which noise is not looked for
_LAPLACIANS = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32) / 6  # of white noise: its deviation
_MEDIAN_OF_NORMAL = 0.6745  # median of |x| of a normal distribution of deviation 1
_EVERY = 2  # each so many-th row and column is a witness of what lightness a tissue has in the scan


def natural_lightness(
    own: np.ndarray, reference: np.ndarray, mask: np.ndarray, amount: float
) -> tuple[np.ndarray, np.ndarray]:
    """L* of a slice, and what its detail makes of the reference's lightness.

    Args:
        own: (rows, cols) L* of the scan. mask: (rows, cols) bool body.
        reference: (n,) R of the mask's pixels, row by row.
        amount: 0 gives the scan's own, 1 the reference's with the scan's detail; between them a mixture.

    Returns:
        L*, (n,) float32 of the mask's pixels, and R + d of them, whatever the amount; R in air.
    """
    own, reference = own.astype(np.float32), reference.astype(np.float32)
    inside = own[mask]
    detail = inside - _mean_of_tissue(own, reference, mask)
    natural = reference + np.float32(DETAIL_GAIN * DETAIL_LIMIT) * np.tanh(detail * np.float32(1 / DETAIL_LIMIT))
    tissue = np.clip(_without_specks(own)[mask] * np.float32(1 / AIR_LIGHTNESS), 0, 1) * (inside > 0)
    return inside + tissue * np.float32(amount) * (natural - inside), reference + tissue * (natural - reference)


def _mean_of_tissue(own: np.ndarray, reference: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """E[own | place, reference] at the mask's pixels."""
    tissues = replace(_TISSUES, cell_px=max(1.0, _TISSUES.cell_px * max(own.shape) / _RASTER))
    guide = np.zeros(own.shape, np.float32)
    guide[mask] = reference * np.float32(2.55)
    few = (slice(None, None, _EVERY), slice(None, None, _EVERY))
    weight = mask[few].astype(np.float32)
    sums = regression.splat(own[few][..., None], guide[few], weight, tissues, every=_EVERY)
    return regression.predict(regression.solve(sums, tissues), guide, mask=mask)[..., 0]


def without_noise(grey: np.ndarray, coarse: float = 0.0) -> np.ndarray:
    """Tones 0..1 (rows, cols) as float32, noise smoothed and edges kept: a guided filter of itself (He et al. 2013).

    Where colour depends steeply on grey, noise would become colour.

    Args:
        coarse: deviation up to which noise may be coarser than a pixel, as in CT after its reconstruction; 0 for MR, where what
            is that coarse is anatomy.
    """
    grey = grey.astype(np.float32)
    sigma = noise_sigma(grey)
    deviation = max(_NOISE_DEVIATION, _NOISE_SIGMAS * sigma)
    if deviation < coarse and min(grey.shape) > 1:
        of_two = _NOISE_SIGMAS * min(2 * noise_sigma(_halved(grey)), _COARSEST * sigma)
        deviation = max(deviation, min(of_two, coarse))
    around = _mean_of_square(grey)
    variance = np.maximum(_mean_of_square(grey * grey) - around * around, 0)
    slope = variance / (variance + np.float32(deviation**2))
    return _mean_of_square(slope) * grey + _mean_of_square(around - slope * around)


def noise_sigma(grey: np.ndarray) -> float:
    """Standard deviation of the noise of (rows, cols) float32 where there is no air: what a plane leaves over, robustly.

    By the difference of two Laplacians (Immerkaer 1996, Fast noise variance estimation), the median in place of the mean:
    edges do not count. Noise that is coarser than a pixel is seen in part.
    """
    import cv2

    left = cv2.filter2D(grey, cv2.CV_32F, _LAPLACIANS)[::2, ::2]
    inside = np.abs(left[grey[::2, ::2] > _AIR_GREY])
    return float(np.median(inside)) / _MEDIAN_OF_NORMAL if inside.size else 0.0


def _halved(values: np.ndarray) -> np.ndarray:
    """Means of 2 x 2 pixels."""
    rows, cols = (n // 2 * 2 for n in values.shape)
    return values[:rows, :cols].reshape(rows // 2, 2, cols // 2, 2).mean(axis=(1, 3), dtype=np.float32)


def _mean_of_square(values: np.ndarray) -> np.ndarray:
    import cv2

    return cv2.blur(values, (2 * _NOISE_RADIUS_PX + 1,) * 2, borderType=cv2.BORDER_REFLECT)


def _without_specks(values: np.ndarray) -> np.ndarray:
    """Median of 5 x 5: noise makes no holes in dark tissue, and air beside tissue stays air."""
    import cv2

    return cv2.medianBlur(np.ascontiguousarray(values), 5)
