"""Colour science: sRGB, XYZ and L*a*b* (`lab`), the way back into the gamut (`gamut`), differences (`difference`)."""

from __future__ import annotations

from .difference import cie76, ciede2000
from .gamut import gamma_decode, gamma_encode, lab_to_srgb_in_gamut
from .lab import (
    gray_to_lightness,
    lab_to_srgb,
    lab_to_xyz,
    lightness_to_gray,
    linear_to_srgb,
    linear_to_xyz,
    srgb_to_lab,
    srgb_to_linear,
    xyz_to_lab,
    xyz_to_linear,
)

__all__ = [
    "cie76",
    "ciede2000",
    "gamma_decode",
    "gamma_encode",
    "gray_to_lightness",
    "lab_to_srgb",
    "lab_to_srgb_in_gamut",
    "lab_to_xyz",
    "lightness_to_gray",
    "linear_to_srgb",
    "linear_to_xyz",
    "srgb_to_lab",
    "srgb_to_linear",
    "xyz_to_lab",
    "xyz_to_linear",
]
