"""Stage *orientation*: which way up a photograph lies. Cryosections are kept face up, face down and mirrored.

The four ways a picture can lie (as it is, upside down, mirrored, turned by half) are matched coarsely with contrast-invariant
features that know their place in the body; the way with the highest similarity is taken, the picture's own way unless
another is clearly better (left and right of a body differ little).
"""

from __future__ import annotations

import numpy as np

from .intensity import apply_curve, histogram_match_curve

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
    from torch.nn.functional import adaptive_avg_pool2d

    from .analogy import Context, deep_image_analogy
    from .features.embedded import Embedded

    curve = histogram_match_curve(greys[masks], reference_grey[reference_mask])
    slices = torch.from_numpy((apply_curve(greys, curve) * masks).astype(np.float32))[:, None]
    target = Embedded().extract(slices, (5, 4))
    reference = Embedded().extract(torch.from_numpy(reference_grey.astype(np.float32))[None, None], (5, 4))
    body = torch.from_numpy(masks)
    context = Context(position_weight=1.0, luminance_weight=0.0, target=None, reference=None)
    found = deep_image_analogy(target, reference, body, torch.from_numpy(reference_mask), 4, context)
    inside = adaptive_avg_pool2d(body.float(), found.similarity.shape[1:]) > 0.5
    return float(found.similarity[inside].mean()) if inside.any() else 0.0
