"""Stage *confidence*: how far a match can be trusted, from whether the way back leads home."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

HOME_POSITIONS = 2.0  # a way back that ends two positions of the layer off is trusted by exp(-1/2)


LEAST_TRUST = (
    0.05  # of a match whose way back leads elsewhere: where nothing is trusted, it is still better than nothing
)


@dataclass(frozen=True)
class Trust:
    """How far a slice's matches can be trusted.

    Attributes:
        confidence: (H, W) float32 0..1 on the grid, see `consistency`.
        agreement: correlation -1..1 of the slice's matched grey with the luminance of its matches, weighted by
            confidence: near 1 the photograph's own relation of colour to luminance holds for the slice.
        inverse_curve: (256,) display grey of the scan at the photograph's grey, or None where there is no such function.
    """

    confidence: np.ndarray
    agreement: float
    inverse_curve: np.ndarray | None

    @property
    def own_relation_weight(self) -> float:
        """How much the photograph's own relation of colour to luminance counts beside the matched one, 0 or more.

        ((r - 0.6) / (1 - r)) ^ 1.5 of the agreement r: 0 up to 0.6, 0.8 at 0.78, 6 at 0.91 (chosen on the self-pairs).
        """
        if self.inverse_curve is None:
            return 0.0
        agreement = min(self.agreement, 0.99)
        return (max(agreement - 0.6, 0.0) / (1 - agreement)) ** 1.5

    @property
    def trusted_fraction(self) -> float:
        """Share of the body whose matches lead back home within two positions."""
        body = self.confidence[self.confidence > 0]
        return float((body > 0.6).mean()) if body.size else 0.0


def trust_of(confidence: np.ndarray, matched_grey: np.ndarray, seen_grey: np.ndarray, inverse_curve) -> Trust:
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
    return Trust(confidence, agreement, inverse_curve)


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


def on_full_grid(trust: Tensor, shape: tuple[int, int]) -> Tensor:
    """(N, h, w) 0..1 -> (N, H, W), bilinear, raised to LEAST_TRUST .. 1 + LEAST_TRUST."""
    return interpolate(trust[:, None], size=shape, mode="bilinear", align_corners=False)[:, 0] + LEAST_TRUST
