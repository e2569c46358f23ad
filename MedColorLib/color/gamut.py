"""From L*a*b* to sRGB bytes without false hues or bleached lights, and the power-law gamma of the colour transfer."""

from __future__ import annotations

from functools import lru_cache
from numbers import Real
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError, SettingsError
from .lab import _namespace, lab_to_linear, lab_to_srgb, linear_to_srgb, srgb_to_linear

if TYPE_CHECKING:
    from .lab import Array

HALF_LEVEL = 0.5 / 255.0  # components this far outside 0..1 still round to 0 or 255
_LARGEST = 1e6
_KNEE_L = 15.0  # L* below the highest lightness of a chroma at which lightness begins to bend
_CHROMA_LIMIT = 128  # a*, b* of every sRGB colour lie within it
_SRGB_LARGEST_AB = 99.0, 108.0  # |a*|, |b*| of pure red, green, blue and their mixtures stay below
_HALVINGS = 12  # chroma to 1/4096 of the wish: below the rounding to bytes


def _require_usable(lab: Array) -> None:
    """Refuse NaN, infinity, and magnitudes whose cubes would leave float32."""
    xp = _namespace(lab)
    bad = int((~(xp.abs(lab) <= _LARGEST)).sum())
    if bad:
        size = int(np.prod(lab.shape))
        raise InputError(f"L*a*b*: {bad} of {size} values are NaN, infinite or beyond {_LARGEST:g}; replace them first")


_LINEAR_LOW, _LINEAR_HIGH = srgb_to_linear(np.array([-HALF_LEVEL, 1.0 + HALF_LEVEL]))


def _outside(linear: Array) -> Array:
    """Whether any component of linear RGB (..., 3) is, as sRGB, more than half a level outside 0..1."""
    return _any((linear < float(_LINEAR_LOW)) | (linear > float(_LINEAR_HIGH)))


def _any(flags: Array) -> Array:
    """(..., 3) bool -> (...): any(-1), but several times as fast as a reduction along three values."""
    return flags[..., 0] | flags[..., 1] | flags[..., 2]


def _reduced_chroma(lab: Array) -> Array:
    """sRGB floats (M, 3) of the largest share of each colour's chroma that fits the gamut; L* and hue stay."""
    xp = _namespace(lab)
    low, high = lab[:, :1] * 0.0, lab[:, :1] * 0.0 + 1.0
    for _ in range(_HALVINGS):
        share = 0.5 * (low + high)
        outside = _outside(lab_to_linear(xp.concatenate([lab[:, :1], lab[:, 1:] * share], -1)))[:, None]
        low, high = xp.where(outside, low, share), xp.where(outside, share, high)
    return lab_to_srgb(xp.concatenate([lab[:, :1], lab[:, 1:] * low], -1))


def lab_to_srgb_in_gamut(lab: Array) -> tuple[Array, int]:
    """L*a*b* to sRGB bytes; colours outside the gamut keep L* and hue and lose chroma.

    Clipping each of R, G, B would shift the hue instead. L* is first limited to 0..100; L* = 0 is black, whatever its
    chroma. Rounded, not truncated.

    Args:
        lab: (..., 3) floats, numpy or torch.

    Returns:
        sRGB (..., 3) uint8 of the same kind and device, and the number of colours changed: those with a component more
        than half a level (0.5/255) outside 0..1, which rounding alone would not bring back, and coloured blacks.

    Raises:
        InputError: wrong shape or dtype; NaN, infinite values or values beyond 1e6 (counted).
    """
    xp = _namespace(lab)
    _require_usable(lab)
    wanted = lab.reshape(-1, 3)
    linear = lab_to_linear(wanted)
    flat = linear_to_srgb(linear)
    black = wanted[:, 0] <= 0.0
    outside = _outside(linear) | (black & _any(flat > HALF_LEVEL))
    changed = int(outside.sum())
    if changed:
        outside &= ~black  # black needs no search
        wanted = wanted[outside]
        flat[outside] = _reduced_chroma(xp.concatenate([xp.clip(wanted[:, :1], 0.0, 100.0), wanted[:, 1:]], -1))
        flat[black] = 0.0
    rounded = xp.round(xp.clip(flat.reshape(lab.shape), 0.0, 1.0) * 255.0)
    return (rounded.astype(np.uint8) if xp is np else rounded.to(xp.uint8)), changed


def _checked_gamma(gamma: float) -> float:
    if isinstance(gamma, bool) or not isinstance(gamma, Real) or not 0.01 <= gamma <= 100.0:
        raise SettingsError(f"gamma: expected a number from 0.01 to 100, got {gamma!r}")
    return float(gamma)


def gamma_encode(values: Array, gamma: float = 0.5) -> Array:
    """max(values, 0) ** gamma, any shape, values in 0..1. Negative values, which have no real power, count as 0.

    Raises:
        SettingsError: gamma not a number from 0.01 to 100.
    """
    gamma = _checked_gamma(gamma)
    return _namespace(values).clip(values, 0.0, None) ** gamma


def gamma_decode(values: Array, gamma: float = 0.5) -> Array:
    """The inverse of `gamma_encode` with the same gamma: max(values, 0) ** (1 / gamma)."""
    return gamma_encode(values, 1.0 / _checked_gamma(gamma))


@lru_cache(maxsize=1)
def _highest_lightness() -> np.ndarray:
    """(257, 257) float32, at [b* + 128, a* + 128]: highest L* at which sRGB holds that chroma.

    Where it holds it at no L*, that of the largest chroma of the same hue that it does hold.
    """
    axis = np.arange(-_CHROMA_LIMIT, _CHROMA_LIMIT + 1, dtype=np.float32)
    b, a = (values.ravel() for values in np.meshgrid(axis, axis, indexing="ij"))
    highest = np.full(a.size, np.nan, np.float32)
    left = np.flatnonzero((np.abs(a) < _SRGB_LARGEST_AB[0]) & (np.abs(b) < _SRGB_LARGEST_AB[1]))
    for lightness in np.arange(100.0, -0.01, -0.5, dtype=np.float32):  # from above: what is found needs no second look
        colors = np.stack([np.full(left.size, lightness), a[left], b[left]], -1)
        held = ~_outside(lab_to_linear(colors))
        highest[left[held]] = lightness
        left = left[~held]
    return _continued_inwards(highest, a, b).reshape(len(axis), len(axis))


def _continued_inwards(highest: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Fill NaN with the value of the nearest known point on the way to grey."""
    left = np.flatnonzero(np.isnan(highest))
    for share in np.linspace(1.0, 0.0, 257)[1:]:
        rows, cols = (np.rint(values[left] * share).astype(int) + _CHROMA_LIMIT for values in (b, a))
        found = highest[rows * (2 * _CHROMA_LIMIT + 1) + cols]
        known = ~np.isnan(found)
        highest[left[known]] = found[known]
        left = left[~known]
    return highest


def bend_lightness(lab: np.ndarray) -> tuple[np.ndarray, int]:
    """Lower L* where sRGB could not hold the chroma at it: lightness gives way, not colour.

    A knee: from 15 below the highest L* that holds a chroma, the rest up to 100 is pressed together, so that order and
    detail of the lights stay. Greys and whatever lies below its knee stay as they are.

    Args:
        lab: (n, 3) floats.

    Returns:
        (n, 3) float32, and the number of colours whose L* fell by more than 0.5.
    """
    import cv2

    out = lab.astype(np.float32)
    if not len(out):
        return out, 0
    width = 1024  # cv2.remap takes pictures of at most 32767 rows
    rows = -(-len(out) // width)
    place = np.zeros((2, rows * width), np.float32)
    place[:, : len(out)] = np.clip(out[:, 1:].T, -_CHROMA_LIMIT, _CHROMA_LIMIT) + _CHROMA_LIMIT
    a, b = place.reshape(2, rows, width)
    top = cv2.remap(_highest_lightness(), a, b, cv2.INTER_LINEAR).ravel()[: len(out)]
    knee = top - np.minimum(np.float32(_KNEE_L), 100 - top)
    above = np.minimum(out[:, 0], 100) - knee
    bent = np.where(above > 0, knee + above * ((top - knee) / np.maximum(100 - knee, 1e-3)), out[:, 0])
    lower = np.minimum(bent, out[:, 0])
    count = int(np.count_nonzero(out[:, 0] - lower > 0.5))
    out[:, 0] = lower
    return out, count
