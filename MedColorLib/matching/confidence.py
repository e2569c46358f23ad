"""Stage *confidence*: how far a match can be trusted: whether the way back leads home, and how alike the two ends look."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from .fields.field import warp

HOME_POSITIONS = 2.0  # a way back that ends two positions of the layer off is trusted by exp(-1/2)
LEAST_TRUST = 0.05  # of a match whose way back leads elsewhere: it still counts where nothing better is near
GREY_BELOW = 0.1  # mean confidence of a slice and its neighbours below which its colour fades to grey

# Likeness (chance = 0, equal = 1) from which a match begins to be trusted, and is trusted in full. Measured, VGG-19, layer 5:
# heads after a head 0.39 to 0.48, self-pairs 0.66 to 0.84; a head after a thorax 0.21; blobs 0.15 to 0.29. The own features,
# means of slices: scans after a photograph of the same region 0.66 to 0.71, of another region 0.64 to 0.69, an angiography
# 0.59: they tell a match from none, not one region from another (see `wrong_reference`).
LIKENESS_RANGE = {"vgg19": (0.12, 0.3), "gray-vgg19": (0.12, 0.3), "embedded": (0.52, 0.735)}


@dataclass(frozen=True)
class Trust:
    """How far a slice's matches can be trusted.

    Attributes:
        confidence: (H, W) float32 0..1 + LEAST_TRUST on the grid, 0 outside the body: `consistency` times `likeness`.
        agreement: correlation -1..1 of the slice's matched grey with the luminance of its matches, weighted by
            confidence: near 1 the photograph's own relation of colour to luminance holds for the slice.
        inverse_curve: (256,) display grey of the scan at the photograph's grey; None: not known, and not to be used.
        monotone: 0..1, how far that is a function at all; see `contrast.Contrast.monotone`.
    """

    confidence: np.ndarray
    agreement: float
    inverse_curve: np.ndarray | None
    monotone: float = 1.0

    @property
    def own_relation_weight(self) -> float:
        """How much the photograph's own relation of colour to luminance counts beside the matched one, 0 or more.

        ((r - 0.6) / (1 - r)) ^ 1.5 of the agreement r: 0 up to 0.6, 0.8 at 0.78, 6 at 0.91 (chosen on the self-pairs).
        """
        if self.inverse_curve is None:
            return 0.0
        agreement = min(self.agreement, 0.99)
        return self.monotone * (max(agreement - 0.6, 0.0) / (1 - agreement)) ** 1.5

    @property
    def trusted_fraction(self) -> float:
        """Share of the body whose matches lead back home within two positions and look alike."""
        body = self.confidence[self.confidence > 0]
        return float((body > 0.6).mean()) if body.size else 0.0

    @property
    def share(self) -> np.ndarray:
        """(H, W) float32 0..1: the confidence without LEAST_TRUST, for people."""
        return np.clip(self.confidence - LEAST_TRUST, 0, 1)

    @property
    def mean(self) -> float:
        """Mean confidence 0..1 inside the body."""
        inside = self.confidence > 0
        return float(self.share[inside].mean()) if inside.any() else 0.0


def saturation(mean_confidence: float) -> float:
    """0..1, how much of its colour a slice keeps: all from GREY_BELOW on, none where nothing is trusted."""
    return min(1.0, max(0.0, mean_confidence) / GREY_BELOW)


def trust_of(
    confidence: np.ndarray, matched_grey: np.ndarray, seen_grey: np.ndarray, inverse_curve, monotone: float = 1.0
) -> Trust:
    """Trust of one slice.

    Args:
        confidence: (H, W) 0 outside the body. matched_grey: (H, W) the slice in the photograph's contrast.
        seen_grey: (H, W) grey of the matched colours.
    """
    inside = confidence > 0
    weights, x, y = confidence[inside].astype(np.float64), matched_grey[inside], seen_grey[inside]
    agreement = 0.0
    if weights.size > 1:
        covariance = np.cov(x, y, aweights=weights)
        spread = np.sqrt(covariance[0, 0] * covariance[1, 1])
        agreement = float(covariance[0, 1] / spread) if spread > 1e-12 else 0.0
    return Trust(confidence, agreement, inverse_curve, monotone)


def consistency(field: Tensor, reverse: Tensor) -> Tensor:
    """Trust (N, h, w) in 0..1 from forward-backward agreement: exp(-d^2 / (2 s^2)), d the distance from home.

    Args:
        field: (N, h, w) into the reference's (h2, w2); reverse: (N, h2, w2) back.
    """
    count, height, width = field.shape
    back = torch.gather(reverse.flatten(1), 1, field.flatten(1)).view(count, height, width)
    rows = torch.arange(height, device=field.device).view(-1, 1)
    cols = torch.arange(width, device=field.device).view(1, -1)
    squared = (back // width - rows).square() + (back % width - cols).square()
    return torch.exp(squared.float() / (-2 * HOME_POSITIONS**2))


def likeness(target: Tensor, reference: Tensor, field: Tensor, target_mask: Tensor, reference_mask: Tensor) -> Tensor:
    """How alike matched positions look, (N, h, w): cosine similarity, 0 for what chance would give, 1 for equal.

    Args:
        target: (N, C, h, w) unit features; reference: (1, C, h2, w2). field: (N, h, w) into the reference.
        target_mask: (N, h, w), reference_mask: (h2, w2) bool: chance is the mean over all pairs inside.
    """
    similarity = (target * warp(reference, field)).sum(1)
    inside = reference_mask.flatten().float()
    mean_reference = (reference[0].flatten(1) @ inside) / inside.sum().clamp_min(1)
    weights = target_mask.float()[:, None]
    mean_target = (target * weights).sum((2, 3)) / weights.sum((2, 3)).clamp_min(1)
    chance = (mean_target @ mean_reference).view(-1, 1, 1)
    return (similarity - chance) / (1 - chance).clamp_min(1e-6)


def in_range(values: Tensor, low: float, high: float) -> Tensor:
    """0 up to `low`, 1 from `high` on, linear between."""
    return ((values - low) / (high - low)).clamp(0, 1)


def on_full_grid(trust: Tensor, shape: tuple[int, int]) -> Tensor:
    """(N, h, w) 0..1 -> (N, H, W), bilinear."""
    return interpolate(trust[:, None], size=shape, mode="bilinear", align_corners=False)[:, 0]
