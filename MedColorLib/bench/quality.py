"""How far colours are from the truth, for the pipeline and for the trivial methods that it has to beat."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..color.difference import ciede2000
from ..color.lab import gray_to_lightness, lightness_to_gray
from ..scan.intensity import apply_curve, histogram_match_curve
from .pairs import Pair

_PATCH = 16
_EDGE_STEP = 15.0  # in a*, b*: what counts as a true edge of colour
_APART_PX = 4  # the two sides of an edge are looked at two pixels off it, each as a mean over 3 x 3
_FEWEST_EDGES = 50
DARKER = 15.0  # L* below the scan's from which a pixel counts as a dark one


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
    return Errors(float(inside.mean()), float(np.percentile(inside, 95)), worst_patch(difference, pair.mask))


def worst_patch(difference: np.ndarray, mask: np.ndarray) -> float:
    """Mean of the worst patch of 16 x 16 pixels of (256, 256), of those at least half inside the mask."""
    sums = _tiles(difference * mask)
    counts = _tiles(mask.astype(np.float64))
    half = counts >= _PATCH**2 / 2  # patches with a corner of body would be ruled by single pixels
    return float((sums[half] / counts[half]).max())


def _tiles(values: np.ndarray) -> np.ndarray:
    rows, cols = values.shape
    return values.reshape(rows // _PATCH, _PATCH, cols // _PATCH, _PATCH).sum((1, 3))


def color_spill(chroma: np.ndarray, pair: Pair) -> float | None:
    """Share of the true steps of colour that is missing in a*, b* (256, 256, 2): 0 for sharp edges, 1 for no edge at all.

    1 - sum <result's step, true step> / sum |true step|^2 over all places inside the body where the true a*, b* differ by
    more than 15 between two points 4 pixels apart in a row or a column, each point a mean over 3 x 3 pixels. Colours that are
    wrong alike on both sides do not count; colours that ran across the edge do.

    Returns:
        None where the truth has fewer than 50 such places.
    """
    wanted = missing = places = 0.0
    for axis in (0, 1):
        true, got = (_steps(_mean_3x3(values), axis) for values in (pair.truth[..., 1:], chroma))
        inside = np.logical_and(*_ends(pair.mask, axis))
        edge = inside & (np.hypot(*np.moveaxis(true, -1, 0)) > _EDGE_STEP)
        wanted += (true[edge] ** 2).sum()
        missing += ((true - got)[edge] * true[edge]).sum()
        places += edge.sum()
    return float(missing / wanted) if places >= _FEWEST_EDGES else None


def _mean_3x3(values: np.ndarray) -> np.ndarray:
    from scipy.ndimage import uniform_filter

    return uniform_filter(np.asarray(values, np.float64), (3, 3, 1), mode="nearest")


def _ends(values: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    turned = np.moveaxis(values, axis, 0)
    return turned[:-_APART_PX], turned[_APART_PX:]


def _steps(values: np.ndarray, axis: int) -> np.ndarray:
    before, after = _ends(values, axis)
    return after - before


def dark_share(lightness: np.ndarray, pair: Pair, body: np.ndarray) -> float:
    """Share of the pixels of `body` (256, 256) bool whose L* (256, 256) lies more than 15 below the scan's."""
    scan = gray_to_lightness(pair.grey)
    return float((lightness < scan - DARKER)[body & pair.mask].mean())


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
