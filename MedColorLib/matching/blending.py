"""Stage *blending*: where a series of references is assigned along the stack, colours pass from one to the next gradually.

Photographs of one series differ in light, film and cut, so colours would jump where one reference takes over from another.
A slice between the middles of two neighbouring references' slices is matched with both; the share of the second rises
linearly from the one middle to the other, and per pixel each counts as far as its match can be trusted.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from .confidence import Trust


@dataclass(frozen=True)
class Neighbour:
    """The other reference of a slice and its share 0..1."""

    index: int
    share: float


def neighbours(choice: Mapping[int, int]) -> dict[int, Neighbour]:
    """Slice -> the reference that shares in its colour beside its own; slices without one are left out.

    Args:
        choice: slice -> index of its reference, in an assignment along a series.

    >>> {k: round(n.share, 2) for k, n in neighbours({0: 5, 1: 5, 2: 5, 3: 6, 4: 6, 5: 6}).items()}
    {2: 0.33, 3: 0.33}
    """
    slices = sorted(choice)
    starts = [n for n, k in enumerate(slices) if n == 0 or choice[k] != choice[slices[n - 1]]]
    runs = [slices[a:b] for a, b in zip(starts, [*starts[1:], len(slices)])]
    middles = [(run[0] + run[-1]) / 2 for run in runs]
    found = {}
    for n, run in enumerate(runs):
        for k in run:
            other = n + 1 if k > middles[n] else n - 1
            if k != middles[n] and 0 <= other < len(runs):
                share = (k - middles[n]) / (middles[other] - middles[n])
                found[k] = Neighbour(choice[runs[other][0]], float(share))
    return found


def blended(first, second, share: np.ndarray):
    """Mix the matches of the same slices with two references, as `Engine.match` gives them.

    Args:
        share: (N,) of the second, 0..1.
    """
    greys, masks, labs, trusts = first
    mixed = [
        _mixed(lab, other_lab, trust, other_trust, float(one))
        for lab, other_lab, trust, other_trust, one in zip(labs, second[2], trusts, second[3], share)
    ]
    return greys, masks, np.stack([lab for lab, _ in mixed]), [trust for _, trust in mixed]


def _mixed(lab, other_lab, trust: Trust | None, other: Trust | None, share: float):
    if trust is None or other is None:
        return (1 - share) * lab + share * other_lab, None
    own_weight, other_weight = (1 - share) * trust.confidence, share * other.confidence
    confidence = own_weight + other_weight
    per_pixel = np.where(confidence > 0, other_weight / np.maximum(confidence, 1e-6), share)[..., None]
    agreement = (1 - share) * trust.agreement + share * other.agreement
    lab = ((1 - per_pixel) * lab + per_pixel * other_lab).astype(lab.dtype)
    return lab, Trust(confidence.astype(np.float32), agreement, *_relation(trust, other, share))


def _relation(trust: Trust, other: Trust, share: float) -> tuple[np.ndarray | None, float]:
    """Inverse curve and how far it is a function at all; a curve counts as far as it is one."""
    weights = (1 - share) * trust.monotone, share * other.monotone
    monotone = sum(weights)
    if monotone == 0:
        return trust.inverse_curve, 0.0
    curves = [(w / monotone, t.inverse_curve) for w, t in zip(weights, (trust, other)) if w > 0]
    return sum(w * curve for w, curve in curves), monotone
