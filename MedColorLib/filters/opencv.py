"""OpenCV's filters where they are safe: the same results as ours within BOUND of the source's largest magnitude, and faster.

What OpenCV (4.8 to 5.0) gets wrong stays with our own solvers: fast global smoother at sigma = 0 (NaN), at a lambda of 1e4
(1e-4), 1e5 (2e-3) and 1e9 (NaN), guides that are not 8-bit integers (refused); domain transform with sigma_s below 1 px or
sigma_r below 0.01 (silently raised), sigma_s above 1000 px (4e-4). One NaN spreads over the whole image in both, so values are
looked at first. Sources of float64 are never sent here: they are computed in float32.

`ximgproc` is part of opencv-contrib. Where only plain OpenCV is installed, our solvers take over: slower, the same within BOUND.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from .checks import merged, split

BOUND = 1e-5  # of the source's largest magnitude: how far the two ways may differ
LARGEST_LAMBDA = 100.0  # of a single iteration: the error grows with it, 6e-6 here in lines of 4096 pixels, 2e-5 at 300
SIGMA_RANGE = (0.01, 1e6)  # of the fast global smoother: OpenCV's weights are exp in float32
SIGMA_S_RANGE, SIGMA_R_LEAST = (1.0, 200.0), 0.1  # of the domain transform: 4e-6 at 200 px
_LARGEST_SOURCE, _LONGEST = 1e30, 4096
_LARGEST_GUIDE = 1e4  # in units of the domain transform's guide
_MOST_CHANNELS = 4
_THREADS = threading.Lock()


def contributed() -> Any | None:
    """cv2.ximgproc, or None where OpenCV was built without its contributed modules."""
    try:
        from cv2 import ximgproc
    except ImportError:
        return None
    return ximgproc if hasattr(ximgproc, "createFastGlobalSmootherFilter") else None


def eight_bit(guide: Any) -> np.ndarray | None:
    """The guide as uint8 (H, W) or (H, W, 3) where it holds whole numbers from 0 to 255, of any type; else None."""
    values = np.asarray(guide)
    if values.dtype.kind not in "buif" or values.ndim not in (2, 3) or (values.ndim == 3 and values.shape[2] != 3):
        return None
    if values.dtype == np.uint8:
        return np.ascontiguousarray(values)
    if values.size == 0 or not (values.min() >= 0 and values.max() <= 255):  # NaN fails both
        return None
    whole = values.astype(np.uint8)
    return whole if np.array_equal(whole, values) else None


def fast_global_smoother(
    source: np.ndarray, guide: np.ndarray, lambdas: list[float], sigma: float
) -> np.ndarray | None:
    """`fgs.fast_global_smoother` by OpenCV, or None where it is not safe.

    Args:
        source: (H, W) or (H, W, C), any real dtype; guide: see `eight_bit`.
        lambdas: of each iteration, every one a quarter of the one before.

    Returns:
        float32 of the source's shape, each channel within its range.
    """
    if not (0 < lambdas[0] <= LARGEST_LAMBDA and SIGMA_RANGE[0] <= sigma <= SIGMA_RANGE[1]):
        return None
    planes = _safe_planes(source, np.shape(guide)[:2])
    whole = None if planes is None else eight_bit(guide)
    ximgproc = None if whole is None else contributed()
    if ximgproc is None:
        return None
    with _one_thread():
        solver = ximgproc.createFastGlobalSmootherFilter(whole, lambdas[0], sigma, 0.25, len(lambdas))
        return merged([_within(solver.filter(plane), *limits) for plane, *limits in planes], source)


@contextmanager
def _one_thread() -> Iterator[None]:
    """OpenCV with one thread: the last digit of its fast global smoother depends on how many share the lines.

    A run has one already (`device.one_thread`) and changes nothing here.
    """
    import cv2

    threads = cv2.getNumThreads()
    if threads == 1:
        yield
        return
    with _THREADS:
        cv2.setNumThreads(1)
        try:
            yield
        finally:
            cv2.setNumThreads(threads)


def domain_transform(
    source: np.ndarray, guide: np.ndarray, sigma_s: float, sigma_r: float, iterations: int
) -> np.ndarray | None:
    """`domain_transform.domain_transform` by OpenCV, or None where it is not safe; arguments as there.

    Returns:
        float32 of the source's shape, each channel within its range.
    """
    values, guide_values = np.asarray(source), np.asarray(guide)
    if not (SIGMA_S_RANGE[0] <= sigma_s <= SIGMA_S_RANGE[1] and sigma_r >= SIGMA_R_LEAST):
        return None
    if not _suits(values, guide_values.shape) or guide_values.dtype.kind not in "buif":
        return None
    single, ximgproc = np.ascontiguousarray(values, np.float32), contributed()
    channels = values.shape[2] if values.ndim == 3 else 1
    (low, high), largest_guide = _limits(single, channels), _largest(guide_values)
    if ximgproc is None or channels > _MOST_CHANNELS or not largest_guide <= _LARGEST_GUIDE or not _small(low, high):
        return None
    result = ximgproc.dtFilter(
        guide_values.astype(np.float32), single, sigma_s, sigma_r, mode=ximgproc.DTF_RF, numIters=iterations
    ).reshape(values.shape)
    new_low, new_high = _limits(result, channels)
    if (new_low < low).any() or (new_high > high).any():  # by rounding, rarely: looking is faster than limiting
        np.clip(result, low, high, out=result)
    return result


def _suits(values: np.ndarray, shape: tuple[int, ...]) -> bool:
    """Whether a source is of a kind that is computed in float32, and of a shape for OpenCV, beside a guide (H, W)."""
    fits = values.ndim in (2, 3) and values.shape[:2] == shape and len(shape) == 2 and values.size > 0
    if not fits or min(shape) < 2 or max(shape) > _LONGEST:  # a line has no second direction
        return False
    return values.dtype.kind in "buif" and values.dtype.itemsize <= 4 and values.dtype != np.float16


def _small(low, high) -> bool:
    return bool(np.all(np.maximum(-low, high) <= _LARGEST_SOURCE))  # NaN fails


def _safe_planes(source: Any, shape: tuple[int, ...]) -> list[tuple[np.ndarray, float, float]] | None:
    """Channels (H, W) float32 with their smallest and largest value; None where they are not for OpenCV."""
    values = np.asarray(source)
    if not _suits(values, shape):
        return None
    planes = [(plane, plane.min(), plane.max()) for plane in split(np.ascontiguousarray(values, np.float32))]
    return planes if all(_small(low, high) for _, low, high in planes) else None


def _limits(values: np.ndarray, channels: int) -> tuple[np.ndarray, np.ndarray]:
    """Smallest and largest value of each channel of contiguous (H, W) or (H, W, C); NaN where there is one."""
    rows = values.reshape(len(values), -1)  # along rows first, which lie in memory as they are read
    low, high = (extreme(rows, axis=0).reshape(-1, channels) for extreme in (np.min, np.max))
    return low.min(axis=0), high.max(axis=0)


def _largest(values: np.ndarray) -> float:
    """Largest magnitude; NaN where there is one."""
    return float(np.maximum(-float(values.min()), float(values.max())))


def _within(plane: np.ndarray, low: float, high: float) -> np.ndarray:
    return np.clip(plane, low, high, out=plane)
