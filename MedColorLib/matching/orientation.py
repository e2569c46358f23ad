"""Stage *orientation*: which way up a photograph lies. Cryosections are kept face up, face down and mirrored.

The four ways a picture can lie (as it is, upside down, mirrored, turned by half) are matched coarsely with contrast-invariant
features that know their place in the body; the way with the highest similarity is taken, the picture's own way unless
another is clearly better (left and right of a body differ little).
"""

from __future__ import annotations

import numpy as np

from ..scan.intensity import apply_curve, histogram_match_curve
from .coarse import coarse_match, mean_inside

WAYS = {"as it is": (1, 1), "upside down": (-1, 1), "mirrored": (1, -1), "turned by half": (-1, -1)}
CLEARLY = (
    0.01  # of similarity: the scatter between left and right on real heads is 0.005, true differences 0.017 to 0.1
)


def turned(picture: np.ndarray, way: str) -> np.ndarray:
    """The picture (H, W[, c]) lying the given way; a contiguous copy."""
    rows, cols = WAYS[way]
    return np.ascontiguousarray(picture[::rows, ::cols])


def choose_way(greys: np.ndarray, masks: np.ndarray, reference_grey: np.ndarray, reference_mask: np.ndarray) -> str:
    """Key of WAYS in which the reference looks most like the slices.

    Args:
        greys: (S, H, W) 0..1 on the grid; masks: (S, H, W) bool. reference_grey, reference_mask: (H, W) on the grid.
    """
    scores = {
        way: coarse_similarity(greys, masks, turned(reference_grey, way), turned(reference_mask, way)) for way in WAYS
    }
    best = max(scores, key=scores.get)
    return best if scores[best] > scores["as it is"] + CLEARLY else "as it is"


def coarse_similarity(greys, masks, reference_grey, reference_mask) -> float:
    """Mean similarity inside the body of slices and reference at layer 4, whatever their contrasts."""
    import torch

    curve = histogram_match_curve(greys[masks], reference_grey[reference_mask])
    found = coarse_match(apply_curve(greys, curve) * masks, masks, reference_grey, reference_mask, position_weight=1.0)
    return mean_inside(found.similarity, torch.from_numpy(masks))
