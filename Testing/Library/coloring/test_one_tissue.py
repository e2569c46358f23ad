"""One tissue, one colour: doubtful matches take the colour that their grey has at their depth, trusted ones keep theirs."""

from __future__ import annotations

import numpy as np
import pytest

from MedColorLib.coloring.one_tissue import DEPTHS, _layers, one_tissue
from MedColorLib.filters.regression import RegressionParameters, solve, splat

PARAMETERS = RegressionParameters()
SIDE, LEVEL = 128, 120.0
MIDDLE, FRONT, RIM = np.s_[60:68, 60:68], np.s_[36:44, 60:68], np.s_[2:6, 60:68]


def relation_and_sums(trust: float):
    """A body of one grey: red, its skin blue, and green at the front of what lies within, where matches went astray."""
    rows, cols = np.mgrid[:SIDE, :SIDE]
    depth = np.minimum(np.minimum(rows, cols), SIDE - 1 - np.maximum(rows, cols))
    lab = np.where((depth < 10)[..., None], (60.0, 0.0, -40.0), (40.0, 30.0, 20.0))
    lab[30:50, 30:98] = (40.0, -30.0, 20.0)
    sums = splat(lab, np.full((SIDE, SIDE), LEVEL), np.full((SIDE, SIDE), trust, np.float32), PARAMETERS)
    return solve(sums, PARAMETERS), sums


def color_at(relation, where):
    """Mean colour of pixels `where`, at the body's grey."""
    rows, cols = (np.arange(SIDE)[part] for part in where)
    count = relation.shape[0] - 2
    cells = np.ix_(*(np.unique((0.5 + (at + 0.5) / SIDE * count).round().astype(int)) for at in (rows, cols)))
    return relation[cells][:, :, round(LEVEL / 255 * (PARAMETERS.bins - 1))].mean((0, 1))


def test_astray_matches_that_nobody_trusts_take_the_colour_of_their_depth():
    relation, sums = relation_and_sums(0.2)
    got = one_tissue(relation, sums, PARAMETERS, 1.0)
    before, after, middle = color_at(relation, FRONT), color_at(got, FRONT), color_at(got, MIDDLE)
    assert before[1] < -5, "the neighbourhood alone is green"
    assert np.abs(after - middle).max() < 1 and after[1] > 15


def test_skin_keeps_its_colour():
    """It has the same grey, but lies less deep."""
    relation, sums = relation_and_sums(0.2)
    got = one_tissue(relation, sums, PARAMETERS, 1.0)
    assert color_at(relation, RIM)[2] < -12 and color_at(got, RIM)[2] < -12


def test_trusted_matches_keep_their_colour():
    relation, sums = relation_and_sums(1.05)
    got = one_tissue(relation, sums, PARAMETERS, 1.0)
    assert np.abs(color_at(got, FRONT) - color_at(relation, FRONT)).max() < 3


def test_where_grey_tells_no_tissue_nothing_changes():
    relation, sums = relation_and_sums(0.2)
    assert one_tissue(relation, sums, PARAMETERS, 0.0) is relation


def test_it_comes_softly():
    relation, sums = relation_and_sums(0.2)
    reds = [color_at(one_tissue(relation, sums, PARAMETERS, share), FRONT)[1] for share in (0, 0.25, 0.5, 0.75, 1)]
    np.testing.assert_allclose(np.diff(reds), np.diff(reds)[0], rtol=1e-3)
    assert reds[0] < reds[-1]


@pytest.mark.parametrize("shape", [(18, 18, 32, 4), (2, 2, 2, 3)])
def test_without_evidence_the_relation_stays(shape):
    relation = np.ones((*shape[:3], shape[3] - 1), np.float32)
    assert one_tissue(relation, np.zeros(shape, np.float32), PARAMETERS, 1.0) is relation


def test_every_cell_belongs_to_its_layers_in_all_once():
    inside = np.zeros((20, 24), bool)
    inside[3:17, 2:22] = True
    shares = _layers(inside)
    assert shares.shape == (DEPTHS, inside.size) and shares.min() >= 0
    np.testing.assert_allclose(shares.sum(0), 1, atol=1e-6)
    rim, centre = shares[:, inside.shape[1] * 3 + 10], shares[:, inside.shape[1] * 10 + 12]
    assert rim @ np.arange(DEPTHS) < 2
    assert centre @ np.arange(DEPTHS) > 3
