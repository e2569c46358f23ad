"""The benchmark's rule for the outline: it sees tissue left black, a table that is coloured, and nothing where all is well."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import binary_fill_holes

from MedColorLib.bench import outline
from MedColorLib.bench.tables import Suite
from MedColorLib.phantom import labels, sample

PIXEL_MM = (1.6, 1.6)
LEVEL = outline.Level(-200, -500, is_ct=True)


@pytest.fixture(scope="module")
def scan():
    values = sample("ct")[0].array[16:32].copy()
    body = np.stack([binary_fill_holes(plane > 0) for plane in labels()[16:32]])
    values[:, 125:127, 10:100] = 100  # a table
    return values, body


def test_nothing_is_wrong_with_the_true_body(scan):
    values, body = scan
    clear = outline.clear_tissue(values, LEVEL, PIXEL_MM)
    assert clear.sum() > 0.7 * body.sum() and not clear[:, 124:].any()
    assert outline.left_black(clear, body) == (0, 0)
    assert outline.beside_body(values, clear, body, LEVEL, PIXEL_MM) == 0


def test_lost_tissue_is_seen_in_all_and_in_the_worst_slice(scan):
    values, body = scan
    clear = outline.clear_tissue(values, LEVEL, PIXEL_MM)
    lost = body.copy()
    lost[3, :, :56] = False
    share, worst = outline.left_black(clear, lost)
    assert worst == pytest.approx(clear[3, :, :56].sum() / clear[3].sum()) and 0.4 < worst < 0.6
    assert share == pytest.approx(clear[3, :, :56].sum() / clear.sum())


def test_a_coloured_table_is_seen_and_dark_air_is_not(scan):
    values, body = scan
    clear = outline.clear_tissue(values, LEVEL, PIXEL_MM)
    painted = body.copy()
    painted[:, 125:127, 10:100] = True
    expected = 16 * 2 * 90 / painted.sum()
    assert outline.beside_body(values, clear, painted, LEVEL, PIXEL_MM) == pytest.approx(expected, rel=0.2)
    everything = np.ones_like(body)
    assert outline.beside_body(values, clear, everything, LEVEL, PIXEL_MM) == pytest.approx(
        16 * 180 / body.size, rel=0.2
    )


def test_the_phantoms_meet_the_targets():
    suite = Suite()
    outline.run(suite, None, True, lambda fraction, text: None)
    rows = suite.tables["outline"].where()
    assert [row["volume"] for row in rows] == ["phantom CT", "phantom MR"] and not suite.failures
    for row in rows:
        assert row["left_black"] <= outline.LEFT_BLACK_TARGET and row["worst"] <= outline.WORST_TARGET
        assert row["beside_body"] <= outline.BESIDE_TARGET


@pytest.mark.slow
def test_the_real_volumes_meet_the_targets(shared_data):
    """All but the heart MR, whose ghosts beside the chest are as bright as its own muscle: they stay, in doubt."""
    suite = Suite()
    outline.run(suite, shared_data, False, lambda fraction, text: None)
    rows = suite.tables["outline"].where()
    assert len(rows) == 2 + len(outline.REAL)
    for row in rows:
        assert row["left_black"] <= outline.LEFT_BLACK_TARGET and row["worst"] <= outline.WORST_TARGET, row
        assert row["beside_body"] <= (0.08 if row["volume"] == "heart_mr" else outline.BESIDE_TARGET), row
