"""A first, coarse correspondence that does not depend on contrast: self-similarity and the place in the body.

Two stages ask it: which way up a photograph lies (`orientation`) and what luminance it has where the scan has which grey
(`contrast`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from torch import Tensor

    from .analogy import Match

LAYER = 4


def coarse_match(greys, masks, reference_grey, reference_mask, position_weight: float) -> Match:
    """Match slices with a reference at layer 4.

    Args:
        greys: (S, H, W) 0..1 on the grid, 0 outside the body; masks: (S, H, W) bool.
        reference_grey: (H, W) 0..1; reference_mask: (H, W) bool.
        position_weight: see `analogy.Context`.
    """
    import torch

    from ..features.self_similarity import SelfSimilarity
    from .analogy import Context, deep_image_analogy

    planes = (np.asarray(greys, np.float32)[:, None], reference_grey.astype(np.float32)[None, None])
    target, reference = (SelfSimilarity().extract(torch.from_numpy(values), (5, LAYER)) for values in planes)
    context = Context(position_weight, luminance_weight=0.0, target=None, reference=None)
    masks = torch.from_numpy(masks), torch.from_numpy(reference_mask)
    return deep_image_analogy(target, reference, *masks, LAYER, context)


def mean_inside(similarity: Tensor, masks: Tensor) -> float:
    """Mean of (S, h, w) where more than half is covered by masks (S, H, W); 0 where nothing is."""
    from torch.nn.functional import adaptive_avg_pool2d

    inside = adaptive_avg_pool2d(masks.float(), similarity.shape[1:]) > 0.5
    return float(similarity[inside].mean()) if inside.any() else 0.0
