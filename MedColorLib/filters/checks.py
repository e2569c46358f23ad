"""Checks that all smoothing filters share: parameter ranges, shapes, finite values. One wording, with the remedy."""

from __future__ import annotations

import numbers

import numpy as np

from ..errors import InputError, SettingsError

_LARGEST = 1e100  # squares and sums of values beyond this leave float64


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


def _real_float64(name: str, array: object) -> np.ndarray:
    values = np.asarray(array)
    if values.dtype.kind not in "buif":
        raise InputError(f"{name}: expected an array of real numbers, got dtype {values.dtype}")
    return values.astype(np.float64)


def float64_pair(source: np.ndarray, guide: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Source as (H, W, C) and guide as (H, W), both new float64 arrays.

    Args:
        source: (H, W) or (H, W, C), any real dtype.
        guide: (H, W), any real dtype.

    Raises:
        InputError: shapes that do not fit each other, empty, not real, NaN, infinite or beyond 1e100.
    """
    planes, guide64 = _real_float64("source", source), _real_float64("guide", guide)
    if planes.ndim == 2:
        planes = planes[..., None]
    if planes.ndim != 3 or guide64.ndim != 2 or planes.shape[:2] != guide64.shape or planes.size == 0:
        raise InputError(
            f"source and guide: expected (H, W, C) and (H, W) of the same height and width, not empty, got "
            f"{np.shape(source)} and {np.shape(guide)}"
        )
    for name, values in (("source", planes), ("guide", guide64)):
        require_finite(name, values)
        if np.abs(values).max() > _LARGEST:
            raise InputError(f"{name}: magnitude {np.abs(values).max():g}; this filter takes up to 1e100; scale it")
    return planes, guide64


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
