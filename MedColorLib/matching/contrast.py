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

EXPLAINED_RANGE = (
    0.1,
    0.3,
)  # share of the luminance variance explained from which the learned curve counts, and counts in full
GAIN_RANGE = (0.0, 0.02)  # likewise of the similarity that it gains


@dataclass(frozen=True)
class Contrast:
    """The curve chosen for a volume and the evidence for it.

    Attributes:
        curve: (256,) matched grey 0..1 at display grey index / 255.
        kind: which curve it is, in words.
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
    def monotone(self) -> float:
        """1 where the curve only rises or only falls, but for ripples of a tenth of the way; 0 from a fifth on."""
        rises, falls = self._ways
        return float(np.clip(2 - 10 * min(rises, falls) / max(rises + falls, 1e-12), 0, 1))

    @property
    def _ways(self) -> tuple[float, float]:
        steps = np.diff(self.curve)
        return float(steps[steps > 0].sum()), float(-steps[steps < 0].sum())

    @property
    def inverse(self) -> np.ndarray:
        """(256,) display grey at matched grey index / 255; see `monotone` for how much it means. Ripples are levelled."""
        rises, falls = self._ways
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
    if explained <= EXPLAINED_RANGE[0]:
        return Contrast(matched, "histogram match", explained, 0.0)
    spread = histogram_match_curve(regressed, reference_grey[reference_mask])
    learned = apply_curve(regression, spread).astype(np.float64)
    gain = coarse_similarity(apply_curve(greys, learned) * masks) - coarse_similarity(
        apply_curve(greys, matched) * masks
    )
    share = _from_0_to_1(explained, EXPLAINED_RANGE) * _from_0_to_1(gain, GAIN_RANGE)
    mixed = f"{100 * share:.0f} % learned from a coarse correspondence, the rest histogram match"
    kinds = {0.0: "histogram match", 1.0: "learned from a coarse correspondence"}
    return Contrast(matched + share * (learned - matched), kinds.get(share, mixed), explained, gain)


def _from_0_to_1(value: float, limits: tuple[float, float]) -> float:
    """Softly, so that one slice more or less cannot turn a volume's colours."""
    return float(np.clip((value - limits[0]) / (limits[1] - limits[0]), 0, 1))


def seen_contrast(greys: np.ndarray, masks: np.ndarray, seen: np.ndarray) -> Contrast:
    """The scan's relation of grey to the photograph's luminance, as matches show it that do not depend on contrast.

    Args:
        greys: (S, H, W) display grey 0..1; masks: (S, H, W) bool body; seen: (S, H, W) of `seen_luminance`.
    """
    inside, seen = greys[masks], seen[masks]
    curve = regression_curve(inside, seen)
    variance = float(np.var(seen))
    explained = float(np.var(apply_curve(inside, curve))) / variance if variance > 0 else 0.0
    return Contrast(curve, "as the matches show it", explained, 0.0)


def seen_luminance(reference_grey: np.ndarray, field, layer: int) -> np.ndarray:
    """The reference's luminance (H, W) at the places a field (S, h, w) of `layer` points to: (S, H, W)."""
    import torch

    from .fields.field import average_vote

    planes = torch.from_numpy(reference_grey.astype(np.float32))[None, None].to(field.device)
    return average_vote(planes, field, scale=2 ** (layer - 1))[:, 0].cpu().numpy()


def coarse_luminance(greys, masks, reference_grey, reference_mask) -> np.ndarray:
    """Reference luminance seen through a coarse, contrast-invariant correspondence; (S, H, W)."""
    match = coarse_match(greys, masks, reference_grey, reference_mask, position_weight=2.0)
    return seen_luminance(reference_grey, match.field, match.layer)


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
