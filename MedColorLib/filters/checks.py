"""Checks that all smoothing filters share: parameter ranges, shapes, finite values. One wording, with the remedy."""

from __future__ import annotations

import math
import numbers
from collections.abc import Callable, Iterator
from itertools import islice

import numpy as np

from ..errors import InputError, SettingsError

_LARGEST = 1e100  # squares and sums of values beyond this leave float64
_MOST_TOGETHER = 4  # channels in one call of OpenCV, whose versions take up to 128 or 512


def number_in_range(name: str, value: object, low: float, high: float, *, above_low: bool = False) -> float:
    """The parameter as a float.

    Raises:
        SettingsError: not a real number, NaN, or outside low..high (`above_low`: low itself is refused as well).
    """
    is_number = isinstance(value, numbers.Real) and not isinstance(value, (bool, np.bool_))
    if not is_number or not low <= value <= high or (above_low and value == low):  # NaN fails the comparison
        bounds = f"{'above' if above_low else 'at least'} {low:g} and at most {high:g}"
        raise SettingsError(f"{name}: expected a number {bounds}, got {value!r}")
    return float(value)


def count_in_range(name: str, value: object, low: int, high: int) -> int:
    """The parameter as an int.

    Raises:
        SettingsError: not a whole number or outside low..high.
    """
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, np.integer)) or not low <= value <= high:
        raise SettingsError(f"{name}: expected a whole number from {low} to {high}, got {value!r}")
    return int(value)


def bad_values_error(name: str, bad: int, total: int) -> InputError:
    """The error for NaN and infinite pixels, which recursive filters would spread over the whole image."""
    return InputError(
        f"{name}: {bad} of {total} values are NaN or infinite; replace them first (padding of a scan: with the value "
        "of air; else numpy.nan_to_num) or crop them away"
    )


def require_finite(name: str, array: np.ndarray) -> None:
    """Raise InputError, with the count, when the array holds NaN or infinity."""
    bad = int(array.size - np.count_nonzero(np.isfinite(array)))
    if bad:
        raise bad_values_error(name, bad, array.size)


def _real(name: str, array: object) -> np.ndarray:
    values = np.asarray(array)
    if values.dtype.kind not in "buif":
        raise InputError(f"{name}: expected an array of real numbers, got dtype {values.dtype}")
    return values


def _require_pair(source: object, guide: object, planes: np.ndarray, guide_plane: np.ndarray) -> None:
    if planes.ndim != 3 or guide_plane.ndim != 2 or planes.shape[:2] != guide_plane.shape or planes.size == 0:
        raise InputError(
            f"source and guide: expected (H, W, C) and (H, W) of the same height and width, not empty, got "
            f"{np.shape(source)} and {np.shape(guide)}"
        )


def _require_magnitude(name: str, low: float, high: float) -> None:
    if max(-low, high) > _LARGEST:
        raise InputError(f"{name}: magnitude {max(-low, high):g}; this filter takes up to 1e100; scale it")


def float64_pair(source: np.ndarray, guide: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Source as (H, W, C) and guide as (H, W), both new float64 arrays.

    Args:
        source: (H, W) or (H, W, C), any real dtype.
        guide: (H, W), any real dtype.

    Raises:
        InputError: shapes that do not fit each other, empty, not real, NaN, infinite or beyond 1e100.
    """
    planes, guide64 = _real("source", source).astype(np.float64), _real("guide", guide).astype(np.float64)
    if planes.ndim == 2:
        planes = planes[..., None]
    _require_pair(source, guide, planes, guide64)
    for name, values in (("source", planes), ("guide", guide64)):
        require_finite(name, values)
        _require_magnitude(name, float(values.min()), float(values.max()))
    return planes, guide64


def checked_planes(
    source: np.ndarray, guide: np.ndarray, arrays: Callable[..., Iterator[np.ndarray]]
) -> tuple[list[np.ndarray], np.ndarray]:
    """Copies of the source's channels (H, W) and of the guide (H, W): float32, float64 where the source has more than 32 bits.

    A guide that float32 does not hold makes all float64. Args and errors as for `float64_pair`.

    Args:
        arrays: called with a number, shape and dtype, gives the arrays to be filled: the channels', then the guide's.
    """
    values, guide_plane = _real("source", source), _real("guide", guide)
    _require_pair(source, guide, values[..., None] if values.ndim == 2 else values, guide_plane)
    wide = values.dtype.itemsize > 4 or guide_plane.dtype.itemsize > 4
    wide = wide or (guide_plane.dtype.kind != "f" and guide_plane.dtype.itemsize > 2)  # beyond 24 bits
    dtype = np.float64 if wide else np.float32
    channels = values.size // guide_plane.size
    *planes, copy = islice(arrays(channels, guide_plane.shape, np.dtype(dtype)), channels + 1)
    _split_into(planes, values.reshape(*guide_plane.shape, channels), dtype)
    np.copyto(copy, guide_plane, casting="unsafe")  # to what has been chosen for it
    guide_plane = copy
    for name, whole, of_it in (("source", values, planes), ("guide", guide, [guide_plane])):
        low, high = min(float(plane.min()) for plane in of_it), max(float(plane.max()) for plane in of_it)
        if not (math.isfinite(low) and math.isfinite(high) and low <= high):
            require_finite(name, np.asarray(whole))
        _require_magnitude(name, low, high)
    return planes, guide_plane


def split(values: np.ndarray) -> list[np.ndarray]:
    """Channels (H, W) of (H, W) or (H, W, C), contiguous; new arrays but for a single one."""
    if values.ndim == 2:
        return [values]
    if values.shape[2] > _MOST_TOGETHER:
        return [values[..., channel].copy() for channel in range(values.shape[2])]
    import cv2

    return list(cv2.split(values))  # several times as fast


def _split_into(planes: list[np.ndarray], values: np.ndarray, dtype: type) -> None:
    """Copy the channels of (H, W, C) into `planes`."""
    import cv2

    if 1 < len(planes) <= _MOST_TOGETHER:
        cv2.split(np.ascontiguousarray(values, dtype), planes)
        return
    for number, plane in enumerate(planes):
        np.copyto(plane, values[..., number], casting="unsafe")


def merged(planes: list[np.ndarray], like: np.ndarray) -> np.ndarray:
    """Channels (H, W) side by side again, in the shape of `like`."""
    if len(planes) > _MOST_TOGETHER:
        return np.stack(planes, -1)
    import cv2

    return (planes[0] if len(planes) == 1 else cv2.merge(planes)).reshape(np.shape(like))


def output_dtype(source: np.ndarray) -> np.dtype:
    """The dtype of a filter's result: that of a float source, float32 for integers."""
    dtype = np.asarray(source).dtype
    return dtype if dtype.kind == "f" else np.dtype(np.float32)


def in_range_of(result: np.ndarray, planes: np.ndarray) -> np.ndarray:
    """Limit each channel of (H, W, C) to its source's range: the exact result lies inside, rounding may not."""
    return np.clip(result, planes.min(axis=(0, 1)), planes.max(axis=(0, 1)))


def require_parameters(parameters: object, expected: type) -> None:
    """Raise SettingsError when the filter was given another filter's parameters."""
    if not isinstance(parameters, expected):
        raise SettingsError(f"parameters: expected {expected.__name__}, got {type(parameters).__name__}")
