"""What slices all over the scan say of colour and grey, for those that their own matches tell little about.

A photograph shows one level. Shoulders after a section of the chest find no shoulders there, and in such slices muscle took
the colour of fat. In the chest of the same scan the matches know fat from muscle, and grey means the same in both.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..scan.slices import sample_slices

if TYPE_CHECKING:
    from .engine import Engine

FEW = 4  # of the slices that are to be coloured; where these can trust their matches, no others are asked
SLICES = 16  # spread over the body that are asked
POWER = 4  # of a slice's share of trusted matches: 0.35 counts eight times as much as 0.2


def relation_elsewhere(engine: Engine, count: int = SLICES) -> tuple[np.ndarray | None, int]:
    """Sums as `coloring.one_tissue.layers_of` gives them, the mean of slices by how far their matches can be trusted.

    Of the whole body, whichever slices are to be coloured. None where nothing would read it: without the own features and the
    regression, where the slices' matches know better (`usual.one_tissue_share`), with tissue groups, and with several references
    in use. And of how many slices.
    """
    from ..coloring.one_tissue import layers_of
    from ..coloring.transfer import SliceMatch, relation_sums

    used = set(engine.choice.values())
    if engine.one_tissue(0.0, told=True) == 0 or engine.prepared.groups is not None or len(used) > 1:
        return None, 0
    prepared = engine.prepared
    few = engine.match_ahead(list(_asked(engine, prepared.plan.slices, min(FEW, count))), *used)
    if not any(engine.one_tissue(trust.trusted_fraction, told=True) for *_, (trust,) in few):
        return None, 0
    parameters = engine.transfer_parameters()
    others = _asked(engine, prepared.body.slices, count)

    def told(matched: tuple, times: int) -> tuple[np.float32, np.ndarray]:
        grey, mask, lab, (trust,) = matched
        share = np.float32(times * trust.trusted_fraction**POWER)
        return share, share * layers_of(relation_sums(SliceMatch(lab[0], grey[0], mask[0], trust), parameters))

    shares, sums = zip(*engine.each(told, engine.match_ahead(list(others), *used), others.values()))
    return (sum(sums) / sum(shares), len(others)) if sum(shares) > 0 else (None, 0)


def _asked(engine: Engine, slices: Sequence[int], count: int) -> dict[int, int]:
    """Slice -> how often it counts, of at most so many, evenly spread: a slice that repeats another is not matched again."""
    repeats = engine.prepared.repeats
    return Counter(repeats.get(int(k), int(k)) for k in sample_slices(list(slices), count))
