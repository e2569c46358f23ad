"""Stage *body*: planes on a reduced raster, averaged over what was measured, and the level at which air floods them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .intensity import strided

_ENDS = (0.5, 99.5)  # percentiles: one bad voxel does not set the scale
_SAMPLE = 250_000  # voxels from which ends are taken
_MOST_STRETCHED = 10
_FAST = ("uint8", "int16", "uint16")  # what OpenCV averages as it is


@dataclass(frozen=True)
class Scale:
    """What the values mean: 0..1 from `low` to `high`, and which of them were measured at all.

    Attributes:
        low, high: robust ends of what was measured.
        floor: values below it were not measured: padding.
        missing: whether there may be padding, NaN or infinities.
        cut: exact value that stands for "cut out" although it lies amid the others (a normalised scan on 0), or None.
    """

    low: float
    high: float
    floor: float
    missing: bool
    cut: float | None = None

    def grey(self, values: np.ndarray) -> np.ndarray:
        """(...) float32, low to high as 0..1, up to 4 beyond; halves: the difference of extremes stays finite."""
        if self.high - self.low < 1e30 and max(abs(self.low), abs(self.high)) < 1e30 and values.dtype.itemsize < 8:
            with np.errstate(over="ignore", invalid="ignore"):
                grey = (values.astype(np.float32) - np.float32(self.low)) / np.float32(self.high - self.low)
        else:
            with np.errstate(over="ignore", invalid="ignore"):
                grey = (np.asarray(values, np.float64) / 2 - self.low / 2) / (self.high / 2 - self.low / 2)
        return np.clip(grey, -0.5, 4.0).astype(np.float32, copy=False)

    def value(self, grey: float) -> float:
        """The inverse of `grey` for one number."""
        return 2 * (self.low / 2 * (1 - grey) + self.high / 2 * grey)

    def grey_of(self, value: float) -> float:
        """`grey` of one number, not limited."""
        return float((value / 2 - self.low / 2) / (self.high / 2 - self.low / 2))


def measured_scale(array: np.ndarray) -> tuple[Scale, np.ndarray]:
    """Tell padding from measurement.

    Scanners fill what lies outside their round field of view with one value far below the rest (-2000, -3024, -32768),
    and exports with NaN.

    Returns:
        The scale, and a sample (n,) float64 of the measured values.
    """
    sample = strided(array, _SAMPLE)
    halves = sample[np.isfinite(sample)] / 2  # the difference of extremes stays finite
    lowest = floor = halves.min()
    above = halves[halves > floor]
    if above.size and above.min() - floor > 0.2 * np.ptp(np.percentile(above, _ENDS)) > 0:
        halves, floor = above, above.min()
    low, high = np.percentile(halves, _ENDS)
    if low == high:
        low, high = halves.min(), halves.max()
    missing = bool(floor > lowest) or array.dtype.kind == "f"
    return Scale(2 * float(low), 2 * float(high), 2 * float(floor), missing), 2 * halves


def raster(shape: tuple[int, ...], pixel_mm: tuple[float, float], side: int) -> tuple[int, int]:
    """(height, width) of a raster of square pixels for planes (rows, cols), at most `side` pixels long.

    Its pixels are as fine as the finer side of the plane's: radii mean the same along and across thick slices.
    """
    longest = max(pixel_mm)
    pixel = [max(length, longest / _MOST_STRETCHED) for length in pixel_mm]  # beyond it a header is wrong
    extent = shape[-2] * pixel[0], shape[-1] * pixel[1]
    step = max(min(pixel), max(extent) / side)
    factor = min(1.0, side / max(shape[-2:]))
    height, width = (
        min(side, max(1, round(length / step), round(count * factor))) for length, count in zip(extent, shape[-2:])
    )
    return height, width


def resized(plane: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A plane on a raster of `size` (height, width): averaged along an axis that becomes shorter, else interpolated."""
    import cv2

    rows, cols = plane.shape
    shorter = min(rows, size[0]), min(cols, size[1])
    if shorter != (rows, cols):
        plane = cv2.resize(plane, shorter[::-1], interpolation=cv2.INTER_AREA)
    return cv2.resize(plane, size[::-1], interpolation=cv2.INTER_LINEAR) if shorter != size else plane


def reduced(
    plane: np.ndarray, scale: Scale, size: tuple[int, int], sigma: float
) -> tuple[np.ndarray, np.ndarray | None]:
    """A plane (rows, cols) on a raster of `size` (height, width).

    Args:
        sigma: of the Gaussian that follows, in pixels of the raster: single noisy pixels make no outline.

    Returns:
        Grey (height, width) float32 of what was measured, and bool where less than half of a pixel was; None where all was.
    """
    import cv2

    if not scale.missing and plane.dtype.name in _FAST:
        return cv2.GaussianBlur(scale.grey(resized(np.ascontiguousarray(plane), size)), (0, 0), sigma), None
    grey = scale.grey(plane)
    with np.errstate(invalid="ignore"):
        missing = ~(plane >= scale.floor)
    if scale.cut is not None:
        missing |= plane == scale.cut
    if not missing.any():
        return cv2.GaussianBlur(resized(grey, size), (0, 0), sigma), None
    grey[missing] = 0
    grey, share = resized(grey, size), resized((~missing).astype(np.float32), size)
    blurred, wide = (cv2.GaussianBlur(part, (0, 0), sigma) for part in (grey, share))
    return blurred / np.maximum(wide, 1e-6), share < 0.5


def flood_level(grey: np.ndarray, missing: np.ndarray | None) -> np.ndarray:
    """(h, w) float32: the level at which a flood from the border, or from what is missing, reaches each pixel.

    A cavity has the level of the weakest place of the wall around it, so dark tissue inside a bright skin is told from air.
    """
    import cv2

    lowest, highest = -9.0, 9.0
    ground = cv2.copyMakeBorder(
        np.where(missing, np.float32(lowest), grey) if missing is not None else grey,
        *(1, 1, 1, 1),
        cv2.BORDER_CONSTANT,
        value=lowest,
    )
    level = np.full_like(ground, highest)
    level[[0, -1]] = level[:, [0, -1]] = lowest
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    while True:
        for _ in range(8):
            before = level
            sunk = cv2.erode(level, cross, borderType=cv2.BORDER_CONSTANT, borderValue=highest)
            level = cv2.max(sunk, ground)
        if np.array_equal(before, level):
            return level[1:-1, 1:-1]
