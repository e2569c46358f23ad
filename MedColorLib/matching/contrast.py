"""Stage *contrast*: bring the scan's grey values into the photograph's contrast, for matching only.

A histogram match assumes that brighter stays brighter. Between modalities it does not: fat is dark in CT and bright in a
photograph, T1 and T2 invert each other. So a first, coarse correspondence is made with features that do not depend on
contrast; it shows which reference luminance lies where each grey value lies, E[reference luminance | grey], and that curve,
monotone or not, replaces the histogram match when the evidence is strong enough.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..scan.intensity import apply_curve, histogram_match_curve
from .coarse import coarse_match

LEAST_EXPLAINED = 0.2  # share of the luminance variance that the curve must explain; below it is noise of bad matches


@dataclass(frozen=True)
class Contrast:
    """The curve chosen for a volume and the evidence for it.

    Attributes:
        curve: (256,) matched grey 0..1 at display grey index / 255.
        kind: "histogram match" or "learned from a coarse correspondence".
        explained: share of the reference's luminance variance explained by the learned curve, 0..1.
        gain: rise of the mean similarity at the coarsest layer by the learned curve.
    """

    curve: np.ndarray
    kind: str
    explained: float
    gain: float

    @property
    def trust(self) -> float:
        """0..1, how far grey may help the matching: nothing where it explains a tenth of the luminance or less."""
        return float(np.clip((self.explained - 0.1) / 0.2, 0, 1))

    @property
    def inverse(self) -> np.ndarray | None:
        """(256,) display grey at matched grey index / 255; None where the curve both rises and falls.

        Ripples of up to a tenth of the way, which a learned curve has where grey values are rare, are levelled.
        """
        steps = np.diff(self.curve)
        rises, falls = steps[steps > 0].sum(), -steps[steps < 0].sum()
        if min(rises, falls) > 0.1 * (rises + falls):
            return None
        nodes = np.linspace(0, 1, len(self.curve))
        if rises >= falls:
            return np.interp(nodes, np.maximum.accumulate(self.curve), nodes)
        return np.interp(nodes, np.maximum.accumulate(self.curve[::-1]), nodes[::-1])

    def describe(self) -> str:
        """One line for plan, log and report."""
        return f"{self.kind} (grey explains {100 * self.explained:.0f} % of the reference's luminance)"


def match_contrast(greys, masks, reference_grey, reference_mask, coarse_similarity) -> Contrast:
    """Choose the curve from some slices of the volume.

    Args:
        greys: (S, H, W) display grey 0..1 on the grid; masks: (S, H, W) bool body.
        reference_grey: (H, W) 0..1; reference_mask: (H, W) bool tissue.
        coarse_similarity: `f(greys) -> float`, mean similarity of the chosen features to the reference at layer 5.
    """
    inside = greys[masks]
    matched = histogram_match_curve(inside, reference_grey[reference_mask])
    seen = coarse_luminance(apply_curve(greys, matched) * masks, masks, reference_grey, reference_mask)[masks]
    regression = regression_curve(inside, seen)
    regressed = apply_curve(inside, regression)
    variance = float(np.var(seen))
    explained = float(np.var(regressed)) / variance if variance > 0 else 0.0
    if explained < LEAST_EXPLAINED:
        return Contrast(matched, "histogram match", explained, 0.0)
    spread = histogram_match_curve(regressed, reference_grey[reference_mask])
    learned = apply_curve(regression, spread).astype(np.float64)
    gain = coarse_similarity(apply_curve(greys, learned) * masks) - coarse_similarity(
        apply_curve(greys, matched) * masks
    )
    if gain <= 0:
        return Contrast(matched, "histogram match", explained, gain)
    return Contrast(learned, "learned from a coarse correspondence", explained, gain)


def coarse_luminance(greys, masks, reference_grey, reference_mask) -> np.ndarray:
    """Reference luminance seen through a coarse, contrast-invariant correspondence; (S, H, W)."""
    import torch

    from .fields.field import average_vote

    match = coarse_match(greys, masks, reference_grey, reference_mask, position_weight=2.0)
    planes = torch.from_numpy(reference_grey.astype(np.float32))[None, None]
    return average_vote(planes, match.field, scale=2 ** (match.layer - 1))[:, 0].numpy()


def regression_curve(grey: np.ndarray, seen: np.ndarray, bins: int = 32) -> np.ndarray:
    """E[seen | grey] at 256 grey levels: a kernel regression (Gaussian, 1.2 bins of 32); empty levels interpolated."""
    from scipy.ndimage import gaussian_filter1d

    index = np.rint(np.clip(grey, 0, 1) * (bins - 1)).astype(np.int64)
    counts = np.bincount(index, minlength=bins).astype(np.float64)
    sums = np.bincount(index, seen, minlength=bins)
    counts, sums = (gaussian_filter1d(v, 1.2, mode="constant", truncate=4) for v in (counts, sums))
    known = counts > max(1e-6 * counts.sum(), 1e-9)
    nodes = np.linspace(0, 1, bins)
    return np.interp(np.linspace(0, 1, 256), nodes[known], sums[known] / counts[known])
