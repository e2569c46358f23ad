"""sRGB, linear RGB, XYZ and CIE L*a*b* for numpy arrays and torch tensors alike: one set of formulas.

Colours are the last axis, (..., 3). sRGB is uint8 0..255 or floats with 0..1 inside the gamut (IEC 61966-2-1); XYZ has
Y = 1 for white; L* runs 0..100. The white point (D65) is the row sums of the RGB-to-XYZ matrix, so that R = G = B gives
a* = b* = 0 to 1e-13 in float64; published white points, rounded to five digits, leave 0.005. Both curves, sRGB's and
the cube root's, have straight pieces near zero, which carry negative values through and back: no NaN from finite input.
float64 stays float64, float16 and float32 give float32, uint8 gives float32. sRGB to L*a*b* and back returns sRGB to
1e-13 in float64 and 3e-5 in float32, and every byte.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Union

import numpy as np

from ..errors import InputError

if TYPE_CHECKING:
    import torch

    Array = Union[np.ndarray, torch.Tensor]

RGB_TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
XYZ_TO_RGB = np.linalg.inv(RGB_TO_XYZ)
WHITE_XYZ = RGB_TO_XYZ.sum(axis=1)

_SRGB_KNEE, _SRGB_SLOPE = 0.04045, 12.92
_LINEAR_KNEE = _SRGB_KNEE / _SRGB_SLOPE  # the standard's 0.0031308 is this, rounded: values between would not come back
_DELTA = 6.0 / 29.0
_KNEE = _DELTA**3  # of the cube root, about 0.00886
_SLOPE = 1.0 / (3.0 * _DELTA**2)
_LINEAR_OF_BYTE = np.arange(256) / 255.0
_LINEAR_OF_BYTE = np.where(
    _LINEAR_OF_BYTE <= _SRGB_KNEE, _LINEAR_OF_BYTE / _SRGB_SLOPE, ((_LINEAR_OF_BYTE + 0.055) / 1.055) ** 2.4
)


def _namespace(array: Any) -> Any:
    """numpy for arrays, torch for tensors; torch is not loaded for arrays."""
    if isinstance(array, np.ndarray):
        return np
    import torch

    if isinstance(array, torch.Tensor):
        return torch
    raise InputError(f"colours: expected a numpy array or a torch tensor, got {type(array).__name__}")


def _floats(array: Array, channels: int | None = 3) -> tuple[Any, Array]:
    """The module, and the array as float32 or float64, with its last axis checked."""
    xp = _namespace(array)
    if channels is not None and (array.ndim == 0 or array.shape[-1] != channels):
        raise InputError(f"colours: expected shape (..., {channels}), got {tuple(array.shape)}")
    if array.dtype in (xp.float64, xp.float32):
        return xp, array
    if array.dtype == xp.float16 or (xp is not np and array.dtype == xp.bfloat16):
        return xp, array.astype(np.float32) if xp is np else array.float()
    raise InputError(f"colours: expected floats (sRGB: or uint8), got {array.dtype}; convert them first")


def _like(values: np.ndarray, array: Array) -> Array:
    """A constant in the array's kind, dtype and device."""
    if isinstance(array, np.ndarray):
        return values.astype(array.dtype)
    import torch

    return torch.as_tensor(values, dtype=array.dtype, device=array.device)


def _power(xp: Any, base: Array, exponent: float, smallest: float) -> Array:
    """base ** exponent where base is above `smallest`, any finite value elsewhere."""
    return xp.clip(base, smallest, None) ** exponent


def _linear(xp: Any, srgb: Array) -> Array:
    power = _power(xp, (srgb + 0.055) / 1.055, 2.4, 0.0)
    return xp.where(srgb <= _SRGB_KNEE, srgb / _SRGB_SLOPE, power)


def _encoded(xp: Any, linear: Array) -> Array:
    power = 1.055 * _power(xp, linear, 1.0 / 2.4, _LINEAR_KNEE) - 0.055
    return xp.where(linear <= _LINEAR_KNEE, linear * _SRGB_SLOPE, power)


def _lightness_curve(xp: Any, ratio: Array) -> Array:
    """CIE's f: the cube root, straight below 0.00886."""
    root = xp.cbrt(ratio) if xp is np else _power(xp, ratio, 1.0 / 3.0, _KNEE)
    return xp.where(ratio > _KNEE, root, ratio * _SLOPE + 4.0 / 29.0)


def _lightness_curve_inverse(xp: Any, value: Array) -> Array:
    return xp.where(value > _DELTA, value * value * value, (value - 4.0 / 29.0) / _SLOPE)


def srgb_to_linear(srgb: Array) -> Array:
    """sRGB (uint8, or floats in 0..1) to linear RGB in 0..1, any shape. Negative values follow the straight piece."""
    xp = _namespace(srgb)
    if srgb.dtype == xp.uint8:
        table = _like(_LINEAR_OF_BYTE, np.empty(0, np.float32) if xp is np else srgb.new_empty(0, dtype=xp.float32))
        return table[srgb if xp is np else srgb.long()]
    return _linear(*_floats(srgb, None))


def linear_to_srgb(linear: Array) -> Array:
    """Linear RGB to sRGB floats, any shape, not limited to 0..1."""
    return _encoded(*_floats(linear, None))


def linear_to_xyz(linear: Array) -> Array:
    """Linear RGB (..., 3) to XYZ, D65, Y = 1 for white."""
    _, linear = _floats(linear)
    return linear @ _like(RGB_TO_XYZ.T, linear)


def xyz_to_linear(xyz: Array) -> Array:
    """XYZ (..., 3) to linear RGB, not limited to the gamut."""
    _, xyz = _floats(xyz)
    return xyz @ _like(XYZ_TO_RGB.T, xyz)


def xyz_to_lab(xyz: Array) -> Array:
    """XYZ (..., 3), D65, to CIE L*a*b* (CIE 15:2004)."""
    xp, xyz = _floats(xyz)
    curve = _lightness_curve(xp, xyz / _like(WHITE_XYZ, xyz))
    x, y, z = curve[..., 0], curve[..., 1], curve[..., 2]
    return xp.stack([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)], -1)


def lab_to_xyz(lab: Array) -> Array:
    """CIE L*a*b* (..., 3) to XYZ, D65. Colours beyond the gamut of real ones may come out negative."""
    xp, lab = _floats(lab)
    y = (lab[..., 0] + 16.0) / 116.0
    curve = xp.stack([y + lab[..., 1] / 500.0, y, y - lab[..., 2] / 200.0], -1)
    return _lightness_curve_inverse(xp, curve) * _like(WHITE_XYZ, lab)


def srgb_to_lab(srgb: Array) -> Array:
    """sRGB (..., 3), uint8 or floats in 0..1, to L*a*b*."""
    _namespace(srgb)
    if srgb.shape[-1:] != (3,):
        raise InputError(f"colours: expected shape (..., 3), got {tuple(srgb.shape)}")
    return xyz_to_lab(linear_to_xyz(srgb_to_linear(srgb)))


def lab_to_srgb(lab: Array) -> Array:
    """L*a*b* (..., 3) to sRGB floats, not limited to 0..1; for pictures see `gamut.lab_to_srgb_in_gamut`."""
    return linear_to_srgb(lab_to_linear(lab))


def lab_to_linear(lab: Array) -> Array:
    """L*a*b* (..., 3) to linear RGB, not limited to the gamut."""
    return xyz_to_linear(lab_to_xyz(lab))


def gray_to_lightness(gray: Array) -> Array:
    """sRGB grey (uint8, or floats in 0..1), any shape, to L* in 0..100."""
    linear = srgb_to_linear(gray)
    return 116.0 * _lightness_curve(_namespace(linear), linear) - 16.0


def lightness_to_gray(lightness: Array) -> Array:
    """L*, any shape, to sRGB grey floats (0..1 for L* 0..100)."""
    xp, lightness = _floats(lightness, None)
    return _encoded(xp, _lightness_curve_inverse(xp, (lightness + 16.0) / 116.0))
