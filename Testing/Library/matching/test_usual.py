"""Usual colours: a rare colour of a grey counts less where grey tells tissue, and not at all where it does not."""

from __future__ import annotations

import numpy as np
import pytest

from MedColorLib.matching.usual import FEW_PX, MANY_PX, grey_tells_tissue, support_px, usual_colors

RNG = np.random.default_rng(0)
BRAIN, ORBIT = np.array([55.0, 15.0, 25.0]), np.array([25.0, 1.0, 3.0])


def learned(grey: np.ndarray, lab: np.ndarray):
    """From a scan that is these pixels alone."""
    return usual_colors(grey, lab, grey_tells_tissue(grey))


def body(grey: np.ndarray, rare_share: float) -> np.ndarray:
    lab = np.tile(BRAIN, (grey.size, 1))
    lab[: int(rare_share * grey.size)] = ORBIT
    return lab + RNG.normal(0, 1, lab.shape)


def test_mr_a_rare_colour_counts_less_and_a_frequent_one_in_full():
    grey = RNG.uniform(0, 1, 40_000)
    usual = learned(grey, body(RNG.permutation(grey), 0.02))
    few = np.full(3, 0.5)
    assert usual.share(few, np.tile(BRAIN, (3, 1))).min() == 1
    assert usual.share(few, np.tile(ORBIT, (3, 1))).max() < 0.5
    half = learned(grey, body(grey, 0.0))
    assert half.share(few, np.tile(ORBIT, (3, 1))).max() < 0.05


def test_two_tissues_of_one_grey_that_are_both_frequent_both_count():
    grey = RNG.uniform(0, 1, 40_000)
    order = RNG.permutation(grey.size)
    usual = learned(grey[order], body(grey, 0.4))
    assert usual.share(np.array([0.5]), ORBIT[None])[0] > 0.9


def test_ct_says_nothing():
    """Nearly all soft tissue in two of sixteen levels of grey."""
    grey = np.concatenate([RNG.normal(0.28, 0.01, 9000), RNG.uniform(0, 1, 1000)]).clip(0, 1)
    assert grey_tells_tissue(grey) == 0
    assert learned(grey, body(grey, 0.02)) is None


def test_it_is_soft_between():
    shares = []
    for narrow in (0.4, 0.5, 0.55, 0.6, 0.7):
        count = int(narrow * 10_000)
        grey = np.concatenate([np.full(count, 0.28), RNG.uniform(0, 1, 10_000 - count)])
        shares.append(grey_tells_tissue(grey))
    assert shares[0] == pytest.approx(1, abs=0.2) and shares[-1] == 0
    assert (np.diff(shares) <= 0).all() and len({round(s, 2) for s in shares}) > 2


def test_neighbourhoods_need_much_evidence_where_grey_tells_tissue_and_matches_do_not_tell_grey():
    assert support_px(1.0, 0.0) == MANY_PX
    assert support_px(1.0, 1.0) == support_px(0.0, 0.0) == FEW_PX
