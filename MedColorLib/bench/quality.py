"""How far colours are from the truth, for the pipeline and for the trivial methods that it has to beat."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..color.difference import ciede2000
from ..color.lab import gray_to_lightness, lightness_to_gray
from ..intensity import apply_curve, histogram_match_curve
from .pairs import Pair

_PATCH = 16


@dataclass(frozen=True)
class Errors:
    """CIEDE2000 inside the body with the true luminance: mean, 95th percentile, mean of the worst patch of 16 x 16."""

    mean: float
    p95: float
    worst_patch: float


def color_errors(chroma: np.ndarray, pair: Pair) -> Errors:
    """Errors of a*, b* (256, 256, 2) against the pair's truth."""
    lab = pair.truth.copy()
    lab[..., 1:] = chroma
    difference = ciede2000(lab, pair.truth)
    inside = difference[pair.mask]
    sums = _tiles(difference * pair.mask)
    counts = _tiles(pair.mask.astype(np.float64))
    half = counts >= _PATCH**2 / 2  # patches with a corner of body would be ruled by single pixels
    return Errors(float(inside.mean()), float(np.percentile(inside, 95)), float((sums[half] / counts[half]).max()))


def _tiles(values: np.ndarray) -> np.ndarray:
    rows, cols = values.shape
    return values.reshape(rows // _PATCH, _PATCH, cols // _PATCH, _PATCH).sum((1, 3))


def baselines(pair: Pair) -> dict[str, np.ndarray]:
    """a*, b* (256, 256, 2) of the trivial methods."""
    section = pair.section
    return {
        "grey": np.zeros((*pair.mask.shape, 2)),
        "mean colour": np.broadcast_to(section.lab[section.mask, 1:].mean(0), (*pair.mask.shape, 2)),
        "same position": section.lab[..., 1:],
        "look-up table": _looked_up(pair),
    }


def _looked_up(pair: Pair) -> np.ndarray:
    """Mean a*, b* of the reference at each L*, read at the target's L* after a histogram match inside the masks."""
    inside = pair.section.lab[pair.section.mask]
    curve = histogram_match_curve(pair.grey[pair.mask], lightness_to_gray(inside[:, 0]))
    lightness = gray_to_lightness(apply_curve(pair.grey, curve))
    level = np.clip(np.rint(inside[:, 0]), 0, 100).astype(np.int64)
    counts = np.bincount(level, minlength=101)
    known = np.flatnonzero(counts)
    planes = [np.bincount(level, inside[:, c], minlength=101)[known] / counts[known] for c in (1, 2)]
    return np.stack([np.interp(lightness, known, plane) for plane in planes], -1)
