"""Colour alone, before the gamut step, on pairs with known colours whose contrast is remapped: several seeds, one mean.

chroma_pairs("embedded", data) -> ChromaPairs; give `preset`, `seeds` for others
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..color.difference import ciede2000
from .matched import Matched, Method
from .pairs import Pair, make_pair
from .quality import baselines, color_errors
from .seen import EVERY_SIXTEENTH, best_gain, exposed, section_of

TARGET = 1.6
PAIR_REMAPS = ("as it is", "strong", "extreme", "inverted")
SECTION_NAMES = ("thorax", "head")
SEEDS = (0, 1, 2)


@dataclass(frozen=True)
class ChromaPairs:
    """Mean CIEDE2000 with the true luminance over all pairs and seeds, and of every pair (section, remap) over seeds."""

    mean: float
    pairs: dict[tuple[str, str], float]


def chroma_pairs(
    features: str,
    data: Path,
    preset: str = "balanced",
    seeds: tuple[int, ...] = SEEDS,
    smoother: str = "regression",
    gamma: bool = False,
) -> ChromaPairs:
    """The pipeline's a*, b* of every pair."""

    def chroma(pair: Pair) -> np.ndarray:
        return Matched(pair.volume, pair.section.rgb, Method(features, preset)).chroma(smoother, gamma)

    return over_pairs(chroma, data, seeds)


def looked_up(data: Path, seeds: tuple[int, ...] = SEEDS) -> ChromaPairs:
    """The same of the look-up table from luminance to a*, b*."""
    return over_pairs(lambda pair: baselines(pair)["look-up table"], data, seeds)


def over_pairs(chroma, data: Path, seeds: tuple[int, ...]) -> ChromaPairs:
    """`chroma(pair)` gives a*, b* (256, 256, 2)."""
    sections = [section_of(str(data), name) for name in SECTION_NAMES]
    found = {
        (section.name, remap): float(np.mean([error_of(chroma, make_pair(section, remap, seed)) for seed in seeds]))
        for section in sections
        for remap in PAIR_REMAPS
    }
    return ChromaPairs(float(np.mean(list(found.values()))), found)


def error_of(chroma, pair: Pair) -> float:
    """Mean CIEDE2000 of `chroma(pair)` with the true luminance, one exposure gain free."""
    got = chroma(pair)
    some = pair.mask & EVERY_SIXTEENTH  # enough to choose a gain from

    def measure(gain: float) -> tuple[float, float]:
        errors = color_errors(got, pair if gain == 1.0 else replace(pair, truth=exposed(pair.truth, gain)))
        return errors.mean, errors.worst_patch

    def rough(gain: float) -> float:
        truth = exposed(pair.truth[some], gain)
        return float(ciede2000(np.column_stack([truth[:, 0], got[some]]), truth).mean())

    return best_gain(measure, rough).mean
