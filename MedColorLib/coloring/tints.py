"""Stage *tints*: detail that makes a pixel lighter or darker moves its hue, too, as it does in the photograph.

In photographs of sections hue goes with lightness: what holds much blood is dark and red, what holds much fat is light and
yellow. Around one L* the Visible Human's head and thorax follow the same line, b* by +0.3 and a* by -0.2 for each L*. Matches
are too coarse to see this within a brain: at their scale white matter and cortex have one hue. The scan's own detail tells them
apart, and the photograph's relation gives it the hue.

    (a*, b*) += 0.6 (f(R + d) - f(R)),    f = E[a*, b* of the photograph | L*]

with R and d as in `natural`. At the lightness that the matches give nothing changes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

# Of the photograph's slope: some detail is noise and shading. Slider at 1, CT 122 and chest CT: 3.7 and 7.8 with none of it,
# 3.9 and 6.8 with 0.6, 3.9 and 6.6 with 0.75, 4.1 and 6.2 with all.
SHARE = 0.6
PER_LIGHTNESS = 8  # entries of the table for each L*
_SIGMA = 4.0  # L* around each level in which a line is laid
_STEEPEST = 1.0  # of a* or b* for each L*; more is two colours side by side
_LEAST_YELLOW = 0.25  # of b*
_LEAST_SEEN = 0.05  # of the most frequent lightness; beyond, the last known slope goes on
_LEAST_VARIANCE = _SIGMA**2 / 3  # L* squared, within the window of a line


def tints_of(labs: Sequence[np.ndarray]) -> np.ndarray:
    """0.6 f of photographs: (100 PER_LIGHTNESS + 1, 2) float32, a* and b* at L* 0 to 100.

    The sum of the slopes of local lines, by weighted least squares on a histogram of L*. Only its differences are of use.

    Args:
        labs: (n, 3) L* a* b* of their tissue; each photograph counts alike.
    """
    levels = np.arange(101.0)
    counts, sums = np.zeros(101), np.zeros((101, 2))
    for lab in labs:
        level = np.clip(np.rint(lab[:, 0]), 0, 100).astype(np.intp)
        counts += np.bincount(level, minlength=101) / max(len(lab), 1)
        for channel in (0, 1):
            sums[:, channel] += np.bincount(level, lab[:, 1 + channel], 101) / max(len(lab), 1)
    near = np.exp(-0.5 * np.square((levels[:, None] - levels) / _SIGMA)) * counts
    seen = near.sum(1)
    near /= np.maximum(seen, 1e-12)[:, None]
    colors = sums / np.maximum(counts, 1e-12)[:, None]
    away = levels - (near @ levels)[:, None]
    variance = (near * away**2).sum(1)
    slope = (near * away) @ colors / np.maximum(variance, 1e-12)[:, None]
    known = np.flatnonzero((seen > _LEAST_SEEN * seen.max()) & (variance > _LEAST_VARIANCE))
    if not known.size:  # of one lightness, or of two far apart
        return np.zeros((100 * PER_LIGHTNESS + 1, 2), np.float32)
    slope = np.stack(
        [np.interp(levels, known, np.clip(channel[known], -_STEEPEST, _STEEPEST)) for channel in slope.T], -1
    )
    table = np.concatenate([np.zeros((1, 2)), np.cumsum(SHARE / 2 * (slope[1:] + slope[:-1]), 0)])
    fine = np.linspace(0, 100, 100 * PER_LIGHTNESS + 1)
    return np.stack([np.interp(fine, levels, channel) for channel in table.T], -1).astype(np.float32)


def tinted(tints: np.ndarray, colors: np.ndarray, told: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """a*, b* (n, 2) float32 with 0.6 (f(seen) - f(told)). told: (n,) R; seen: (n,) R + d.

    Of what is yellow a share stays, so that nothing dark turns blue.
    """
    out = colors + (tints[_entry(seen)] - tints[_entry(told)])
    np.maximum(out[:, 1], np.minimum(colors[:, 1], np.float32(_LEAST_YELLOW) * colors[:, 1]), out=out[:, 1])
    return out


def _entry(lightness: np.ndarray) -> np.ndarray:
    entry = np.rint(lightness * np.float32(PER_LIGHTNESS))
    return np.clip(entry, 0, 100 * PER_LIGHTNESS, out=entry).astype(np.int32)
