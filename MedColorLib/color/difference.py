"""Colour differences between L*a*b* colours, in float64 numpy."""

from __future__ import annotations

import numpy as np

from ..errors import InputError


def _pair(lab1: np.ndarray, lab2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    first, second = np.asarray(lab1, dtype=np.float64), np.asarray(lab2, dtype=np.float64)
    if first.shape[-1:] != (3,) or second.shape[-1:] != (3,):
        raise InputError(f"colours: expected two arrays of shape (..., 3), got {first.shape} and {second.shape}")
    return first, second


def cie76(lab1: np.ndarray, lab2: np.ndarray) -> np.ndarray:
    """Euclidean distance in L*a*b* (CIE 1976). (..., 3) and (..., 3), broadcast -> (...) float64."""
    first, second = _pair(lab1, lab2)
    return np.sqrt(((first - second) ** 2).sum(axis=-1))


def _adjusted(lab1: np.ndarray, lab2: np.ndarray) -> tuple[np.ndarray, ...]:
    """Chroma C' and hue h' (degrees, 0..360; 0 for greys) of both, with a* stretched near grey: equations 2 to 7."""
    chroma_mean = 0.5 * (np.hypot(lab1[..., 1], lab1[..., 2]) + np.hypot(lab2[..., 1], lab2[..., 2]))
    power = chroma_mean**7
    stretch = 1.0 + 0.5 * (1.0 - np.sqrt(power / (power + 25.0**7)))
    adjusted = []
    for lab in (lab1, lab2):
        a, b = lab[..., 1] * stretch, lab[..., 2]
        adjusted += [np.hypot(a, b), np.degrees(np.arctan2(b, a)) % 360.0]
    return tuple(adjusted)


def _hue_terms(c1: np.ndarray, h1: np.ndarray, c2: np.ndarray, h2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Hue difference dH' and mean hue in degrees: equations 10, 11, 14. Greys have no hue: the other's counts."""
    gray = c1 * c2 == 0.0
    step = h2 - h1
    far = np.abs(step) > 180.0 + 1e-9  # opposite hues are not far, whichever way NumPy's arctan2 rounds
    step = np.where(gray, 0.0, np.where(far, step - 360.0 * np.sign(step), step))
    total = h1 + h2
    mean = np.where(far, 0.5 * (total + np.where(total < 360.0, 360.0, -360.0)), 0.5 * total)
    return 2.0 * np.sqrt(c1 * c2) * np.sin(np.radians(0.5 * step)), np.where(gray, total, mean)


def ciede2000(lab1: np.ndarray, lab2: np.ndarray) -> np.ndarray:
    """CIEDE2000 with unit weights: about 1 is just noticeable.

    Source: Sharma, Wu, Dalal: The CIEDE2000 Color-Difference Formula: Implementation Notes, Supplementary Test Data,
    and Mathematical Observations, 2005; its equations are numbered in the helpers.

    Args:
        lab1, lab2: (..., 3) L*a*b*, broadcast against each other.

    Returns:
        (...) float64.

    Raises:
        InputError: last axis not 3.
    """
    first, second = _pair(lab1, lab2)
    c1, h1, c2, h2 = _adjusted(first, second)
    hue_difference, hue = _hue_terms(c1, h1, c2, h2)
    chroma, lightness = 0.5 * (c1 + c2), 0.5 * (first[..., 0] + second[..., 0])
    weight = (
        1.0
        - 0.17 * np.cos(np.radians(hue - 30.0))
        + 0.24 * np.cos(np.radians(2.0 * hue))
        + 0.32 * np.cos(np.radians(3.0 * hue + 6.0))
        - 0.20 * np.cos(np.radians(4.0 * hue - 63.0))
    )
    bow = (lightness - 50.0) ** 2
    lightness_term = (second[..., 0] - first[..., 0]) / (1.0 + 0.015 * bow / np.sqrt(20.0 + bow))
    chroma_term = (c2 - c1) / (1.0 + 0.045 * chroma)
    hue_term = hue_difference / (1.0 + 0.015 * chroma * weight)
    power = chroma**7
    turn = np.radians(60.0 * np.exp(-(((hue - 275.0) / 25.0) ** 2)))
    rotation = -2.0 * np.sqrt(power / (power + 25.0**7)) * np.sin(turn)
    square = lightness_term**2 + chroma_term**2 + hue_term**2 + rotation * chroma_term * hue_term
    return np.sqrt(np.maximum(square, 0.0))
