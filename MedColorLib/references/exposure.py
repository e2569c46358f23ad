"""Stage *exposure*: photographs are dark or bright, warm or cold; before anything else their tissue is brought to one
brightness, and, where something neutral beside the tissue tells the light's colour, to neutral light.

Everything is a factor on linear light. Lights that would be too bright are rolled off, never clipped. Pictures of one series
(a folder, a library, a colour volume) get one exposure together, so that nothing flickers along it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np

from ..color.lab import RGB_TO_XYZ, linear_to_srgb, linear_to_xyz, srgb_to_linear, xyz_to_lab

if TYPE_CHECKING:
    from .photograph import Reference

BRIGHTEST = 0.75  # linear luminance of the brightest tissue where that is fat, bone or skin: L* 89
BRIGHTEST_RED = 0.3  # where it is muscle or an organ: L* 62
PERCENTILE = 99.5  # of the tissue's luminance, without specular lights
GAIN_RANGE = (0.4, 6.0)  # beyond, noise and steps of the darkest tones show
UNCHANGED = 0.06  # a gain that near to 1 is none
SERIES_SIZE = 4  # so many single pictures are taken for a series along the body
_HUES = (35.0, 60.0)  # degrees: muscle, fat
_KNEE = 0.8  # of luminance, from where lights are rolled off
_TABLE_SIZE = 4096
_LEAST_BALANCE = 0.04  # a photograph's own scatter
_TINT = 0.25  # of log(red blue / green^2) / 2
_MOST_CAST = 0.6  # of log(red / green) and log(blue / green): what is less neutral is no grey scale
_MOST_CAST_OF_WHITE = 0.25
_CELL = 0.06  # of chromaticity
_DARKEST_STEP, _BRIGHT_STEP = 0.03, 0.25  # luminance
_STEPS = 6
_LUMINANCE = RGB_TO_XYZ[1].astype(np.float32)


@dataclass(frozen=True)
class Exposure:
    """What a reference's linear light was multiplied with.

    Attributes:
        gain: for all channels. white: (red, green, blue) factors of the white balance, of luminance 1.
    """

    gain: float = 1.0
    white: tuple[float, float, float] = (1.0, 1.0, 1.0)

    @property
    def changes(self) -> bool:
        """Whether it changes anything."""
        return self.gain != 1.0 or self.white != (1.0, 1.0, 1.0)

    def describe(self) -> str:
        """For people, such as "gain 2.2, white balance 1.08 0.99 0.86"; empty where nothing changes."""
        parts = [f"gain {self.gain:.2f}"] if self.gain != 1.0 else []
        if self.white != (1.0, 1.0, 1.0):
            parts.append("white balance " + " ".join(f"{factor:.2f}" for factor in self.white))
        return ", ".join(parts)


def expose(references: Sequence[Reference], setting: str | float) -> list[Reference]:
    """The references in their usual brightness.

    Args:
        references: prepared; their `white` is the balance that the picture round the tissue asks for.
        setting: "auto", "off", or a gain, which then is all that happens.
    """
    if setting == "off":
        return list(references)
    if setting != "auto":
        return [_with(reference, Exposure(float(setting))) for reference in references]
    found: list[Reference] = []
    singles = len([r for r in references if not r.group]) >= SERIES_SIZE
    for group, of_group in groupby(references, key=lambda reference: reference.group):
        members = list(of_group)
        for series in [members] if group or singles else [[one] for one in members]:
            exposure = _of_series(series)
            found += [_with(reference, exposure) for reference in series]
    return found


def exposed(rgb: np.ndarray, exposure: Exposure) -> np.ndarray:
    """(h, w, 3) uint8 sRGB in that exposure; the array itself where nothing changes.

    Luminance above 0.8 is rolled off towards 1; a colour that is then outside sRGB loses chroma, not hue.
    """
    if not exposure.changes:
        return rgb
    factors = np.float32(exposure.gain) * np.array(exposure.white, np.float32)
    # the steps of a table even in linear light are too coarse in the dark, so that it is entered with the square root
    table = np.rint(linear_to_srgb(np.linspace(0, 1, _TABLE_SIZE) ** 2) * 255).astype(np.uint8)
    out = np.empty_like(rgb)
    rows = max(1, (1 << 20) // max(rgb.shape[1], 1))
    for start in range(0, len(rgb), rows):
        linear = srgb_to_linear(rgb[start : start + rows]) * factors
        linear = _into_range(linear)
        out[start : start + rows] = table[np.rint(np.sqrt(linear) * (_TABLE_SIZE - 1)).astype(np.int32)]
    return out


def neutral_balance(rgb: np.ndarray, tissue: np.ndarray) -> tuple[float, float, float]:
    """White balance (red, green, blue) that a grey scale or a white beside the tissue asks for; (1, 1, 1) without one.

    A grey scale is one chromaticity in at least six steps of luminance half a stop wide, up to a bright one, in flat places;
    a white, one nearly neutral colour that is bright over a fiftieth of the picture. Warm and cold light is corrected. A
    tint to green or magenta is what film and dyes do to grey, too, and stays up to _TINT (the Visible Human's scale is green
    by 0.25 while its fat is cream).

    Args:
        rgb: (h, w, 3) uint8 sRGB, the whole picture. tissue: (h, w) bool.
    """
    cast = _cast(*_flat_places(rgb, tissue))
    if cast is None:
        return (1.0, 1.0, 1.0)
    warmth, tint = (cast[0] - cast[1]) / 2, (cast[0] + cast[1]) / 2
    tint = np.sign(tint) * max(abs(tint) - _TINT, 0.0)
    factors = np.exp([-(tint + warmth), 0.0, -(tint - warmth)])
    if np.abs(factors - 1).max() < _LEAST_BALANCE:
        return (1.0, 1.0, 1.0)
    return tuple(float(factor) for factor in factors / (factors @ _LUMINANCE))


def _flat_places(rgb: np.ndarray, tissue: np.ndarray) -> tuple[np.ndarray, int]:
    """(n, 3) linear colours of flat places beside the tissue, and the number of pixels of the reduced picture."""
    import cv2

    scale = min(1.0, 640 / max(tissue.shape))
    size = tuple(max(1, round(n * scale)) for n in tissue.shape[::-1])
    small = cv2.medianBlur(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), 3)
    near = cv2.dilate(cv2.resize(tissue.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST), np.ones((7, 7))) > 0
    box = np.ones((3, 3), np.uint8)
    varies = (cv2.dilate(small, box).astype(np.int16) - cv2.erode(small, box)).max(axis=2)
    usable = (varies < 14) & ~near & (small.max(axis=2) < 252) & (small.min(axis=2) > 12)
    return srgb_to_linear(small[usable]), usable.size


def _cast(linear: np.ndarray, pixels: int) -> tuple[float, float] | None:
    """log(red / green) and log(blue / green) of what is neutral among the colours, or None."""
    luminance = linear @ _LUMINANCE
    linear = linear[luminance > _DARKEST_STEP]
    if len(linear) < 50:
        return None
    chromaticity = np.log(linear[:, [0, 2]] / linear[:, 1:2])
    luminance = linear @ _LUMINANCE
    return _of_grey_scale(chromaticity, luminance, pixels) or _of_white(chromaticity, luminance, pixels)


def _of_grey_scale(chromaticity: np.ndarray, luminance: np.ndarray, pixels: int) -> tuple[float, float] | None:
    import cv2

    plausible = (np.abs(chromaticity) < _MOST_CAST).all(axis=1)
    chromaticity, luminance = chromaticity[plausible], luminance[plausible]
    step = (2 * np.log2(luminance / _DARKEST_STEP)).astype(int)
    cells = ((chromaticity + _MOST_CAST) / _CELL).astype(int)
    side, bright = int(2 * _MOST_CAST / _CELL) + 1, int(2 * np.log2(_BRIGHT_STEP / _DARKEST_STEP))
    counts = np.zeros((int(2 * np.log2(1 / _DARKEST_STEP)) + 1, side, side))
    np.add.at(counts, (step, *cells.T), 1)
    counts = np.stack([9 * cv2.blur(plane, (3, 3), borderType=cv2.BORDER_CONSTANT) for plane in counts])
    filled = counts >= max(12, 3e-4 * pixels)
    steps = filled.sum(axis=0) * filled[bright:].any(axis=0)
    if steps.max(initial=0) < _STEPS:
        return None
    evenly = np.minimum(counts, 1.2e-3 * pixels).sum(axis=0) * (steps == steps.max())
    row, col = np.unravel_index(evenly.argmax(), evenly.shape)
    own = (np.abs(cells - (row, col)) <= 1).all(axis=1)
    means = [np.median(chromaticity[own & (step == n)], axis=0) for n in np.flatnonzero(filled[:, row, col])]
    return tuple(np.median(means, axis=0))


def _of_white(chromaticity: np.ndarray, luminance: np.ndarray, pixels: int) -> tuple[float, float] | None:
    white = (np.abs(chromaticity) < _MOST_CAST_OF_WHITE).all(axis=1) & (luminance > 0.5)
    if (
        np.count_nonzero(white) < pixels / 50
        or (np.ptp(np.quantile(chromaticity[white], (0.1, 0.9), axis=0), 0) > _CELL).any()
    ):
        return None
    return tuple(np.median(chromaticity[white], axis=0))


def _of_series(series: Sequence[Reference]) -> Exposure:
    white = np.median(np.log([reference.white for reference in series]), axis=0)
    white = (
        tuple(float(factor) for factor in np.exp(white) / (np.exp(white) @ _LUMINANCE)) if white.any() else (1.0,) * 3
    )
    gains = [_gain(*_brightest(reference, white)) for reference in series]
    gain = float(np.clip(np.exp(np.median(np.log(gains))), *GAIN_RANGE))
    return Exposure(1.0 if abs(gain - 1) < UNCHANGED else gain, white)


def _gain(luminance: float, hue: float) -> float:
    red = np.clip((_HUES[1] - hue) / (_HUES[1] - _HUES[0]), 0, 1)
    return float(BRIGHTEST ** (1 - red) * BRIGHTEST_RED**red / max(luminance, 1e-4))


def _brightest(reference: Reference, white: tuple[float, float, float]) -> tuple[float, float]:
    """Luminance of the brightest tissue, and its hue in degrees (red 0, yellow 90)."""
    import cv2

    scale = min(1.0, 512 / max(reference.mask.shape))
    size = tuple(max(1, round(n * scale)) for n in reference.mask.shape[::-1])
    tissue = reference.mask.astype(np.float32)
    linear = srgb_to_linear(reference.rgb) * np.array(white, np.float32)
    if scale < 1:  # colours of tissue alone are averaged
        linear, tissue = (
            cv2.resize(v, size, interpolation=cv2.INTER_AREA) for v in (linear * tissue[..., None], tissue)
        )
        linear /= np.maximum(tissue, 1e-6)[..., None]
    inside = tissue > 0.9 if (tissue > 0.9).any() else tissue > 0
    luminance = np.where(inside, linear @ _LUMINANCE, 0).astype(np.float32)
    if min(luminance.shape) >= 3:
        luminance = cv2.medianBlur(luminance, 3)
    brightest = float(np.percentile(luminance[inside], PERCENTILE))
    lab = xyz_to_lab(linear_to_xyz(linear[inside & (luminance >= 0.9 * brightest)].mean(axis=0)))
    return brightest, float(np.degrees(np.arctan2(lab[2], lab[1])))


def _with(reference: Reference, exposure: Exposure) -> Reference:
    return replace(reference, rgb=exposed(reference.rgb, exposure), exposure=exposure)


def _into_range(linear: np.ndarray) -> np.ndarray:
    """(..., 3) linear light of 0 or more, with luminance and channels brought below 1."""
    luminance = linear @ _LUMINANCE
    high = luminance > _KNEE
    if not high.any() and linear.max(initial=0) <= 1:
        return linear
    over = np.maximum(luminance - _KNEE, 0) / (1 - _KNEE)
    rolled = np.where(high, 1 - (1 - _KNEE) * np.exp(-over), luminance)
    linear = linear * (rolled / np.maximum(luminance, 1e-9))[..., None]
    top = linear.max(axis=-1)
    kept = np.where(top > 1, (1 - rolled) / np.maximum(top - rolled, 1e-9), 1)[..., None]
    return np.clip(rolled[..., None] + kept * (linear - rolled[..., None]), 0, 1)
