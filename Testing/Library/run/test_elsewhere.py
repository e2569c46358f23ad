"""What all the scan says of grey and colour, for slices of another level than the photograph's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from MedColorLib import Guard, Settings, Volume, colorize
from MedColorLib.coloring.one_tissue import DEPTHS, layers_of, one_tissue
from MedColorLib.filters.regression import RegressionParameters, solve
from MedColorLib.matching.usual import one_tissue_share
from MedColorLib.progress import Run
from MedColorLib.run.elsewhere import SLICES, relation_elsewhere
from MedColorLib.run.engine import Engine
from MedColorLib.run.prepare import prepare

pytestmark = pytest.mark.usefixtures("small_raster")
DRAFT = Settings(preset="draft", features="embedded", device="cpu")
CELLS = RegressionParameters(cell_px=8.0, bins=8, support_px=4.0, levels=1)


def sums_of(colors: np.ndarray, evidence: float) -> np.ndarray:
    """(12, 12, bins, 2): everywhere in a disc, each grey has its colour, with so much evidence."""
    rows, cols = np.mgrid[:12, :12] - 5.5
    inside = (np.hypot(rows, cols) < 5)[..., None]
    weight = np.broadcast_to(inside * evidence, (12, 12, len(colors)))
    return np.stack([weight * colors, weight], -1).astype(np.float32)


def engine_of(volume, reference, settings=DRAFT, guard=None) -> Engine:
    return Engine(
        prepare(volume, [reference] if isinstance(reference, np.ndarray) else reference, settings, guard=guard),
        Run(None, None),
    )


def test_a_slice_without_evidence_takes_the_colours_of_the_others():
    wrong, right = np.full(8, 70.0), np.linspace(20, 90, 8)
    own = sums_of(wrong, 0.01)
    alone = one_tissue(solve(own, CELLS), own, CELLS, 1.0)
    told = one_tissue(solve(own, CELLS), own, CELLS, 1.0, layers_of(sums_of(right, 1.0)))
    np.testing.assert_allclose(alone[6, 6, :, 0], wrong, atol=1)
    np.testing.assert_allclose(told[6, 6, 1:-1, 0], right[1:-1], atol=6)


def test_a_slice_with_evidence_keeps_its_own():
    own, other = sums_of(np.full(8, 70.0), 100.0), layers_of(sums_of(np.full(8, 20.0), 100.0))
    np.testing.assert_allclose(one_tissue(solve(own, CELLS), own, CELLS, 1.0, other)[6, 6, :, 0], 70, atol=1)
    np.testing.assert_array_equal(one_tissue(solve(own, CELLS), own, CELLS, 0.0, other), solve(own, CELLS))


def test_layers_hold_all_sums():
    sums = sums_of(np.linspace(20, 90, 8), 1.0)
    assert layers_of(sums).shape == (DEPTHS, 8, 2)
    np.testing.assert_allclose(layers_of(sums).sum(0), sums.sum((0, 1)), rtol=1e-5)
    assert not layers_of(np.zeros_like(sums)).any()


def test_slices_all_over_the_body_are_asked_each_matched_once(ct, monkeypatch):
    matched = []  # from the first one on, of which the contrast is learned
    own = Engine._own_match
    monkeypatch.setattr(
        Engine,
        "_own_match",
        lambda self, index, greys, *rest: matched.append(len(greys)) or own(self, index, greys, *rest),
    )
    engine = engine_of(ct.volume, ct.reference)
    monkeypatch.setattr(Engine, "one_tissue", lambda *_, **__: 1.0)
    engine.learn_elsewhere()
    ks = list(engine.choice)
    assert engine.elsewhere is not None and np.isfinite(engine.elsewhere).all() and len(matched) == min(SLICES, len(ks))
    for k in ks:
        engine.match([k], 0)
    assert len(matched) == len(ks) and not engine._found and not engine._ahead  # nothing is kept that has had its turn


def test_the_whole_body_is_asked_whichever_slices_are_wanted(ct, monkeypatch):
    monkeypatch.setattr(Engine, "one_tissue", lambda *_, **__: 1.0)
    asked = []
    engine = engine_of(ct.volume, ct.reference, replace(DRAFT, slices=(4, 7)))
    ahead = engine.match_ahead
    monkeypatch.setattr(engine, "match_ahead", lambda ks, index: asked.append(list(ks)) or ahead(ks, index))
    relation, count = relation_elsewhere(engine)
    assert relation is not None and count == len(asked[1])
    assert asked == [[4, 5, 6], [int(k) for k in engine.prepared.body.slices]] and len(asked[1]) > 3


def test_where_matches_know_better_no_other_slices_are_asked(ct, monkeypatch):
    monkeypatch.setattr(Engine, "one_tissue", lambda _, trusted, told=None: 1.0 if trusted == 0 else 0.0)
    asked = []
    engine = engine_of(ct.volume, ct.reference, replace(DRAFT, slices=(4, 7)))
    ahead = engine.match_ahead
    monkeypatch.setattr(engine, "match_ahead", lambda ks, index: asked.append(list(ks)) or ahead(ks, index))
    assert relation_elsewhere(engine) == (None, 0) and asked == [[4, 5, 6]]


@pytest.mark.parametrize("why", ["grey tells nothing", "tissue groups", "several references", "another smoother"])
def test_nobody_is_asked_where_nothing_would_read_it(ct, monkeypatch, why):
    settings, guard, references = DRAFT, None, [ct.reference]
    if why == "tissue groups":
        guard = Guard(Volume((ct.labels > 2).astype(np.uint8), ct.volume.ijk_to_ras))
    if why == "several references":
        references = [ct.reference, np.ascontiguousarray(ct.reference[:, ::-1])]
    if why == "another smoother":
        settings = replace(settings, smoother="guided")
    engine = engine_of(ct.volume, references, settings, guard)
    if why == "several references":
        engine.choice = {k: k % 2 for k in engine.choice}
    if why != "another smoother":
        monkeypatch.setattr(Engine, "one_tissue", lambda *_, **__: 0.0 if why == "grey tells nothing" else 1.0)
    monkeypatch.setattr(engine, "match_ahead", lambda *_: pytest.fail("asked"))
    engine.learn_elsewhere()
    assert engine.elsewhere is None and engine.asked == 0


def test_report(ct):
    report = colorize(ct.volume, [ct.reference], replace(DRAFT, slices=(4, 7))).report
    assert report["slices_asked_of_grey"] == 12
    assert set(report["one_tissue_fraction"]) == {"4", "5", "6"}
    assert all(0 < share <= 1 for share in report["one_tissue_fraction"].values())
    kept = colorize(ct.volume, [ct.reference], replace(DRAFT, slices=(4, 7), smoother="guided")).report
    assert kept["slices_asked_of_grey"] == 0 and not any(kept["one_tissue_fraction"].values())


def test_lost_slices_are_told_by_the_scan_even_where_grey_and_colour_are_related():
    """Shoulders after a section of the chest; in the chest itself the matches know better."""
    assert one_tissue_share(0.0, 1.0, 0.21, told=True) == 1.0 and one_tissue_share(0.0, 1.0, 0.21) == 0.0
    assert one_tissue_share(0.0, 1.0, 0.31, told=True) == 0.0
    assert one_tissue_share(0.0, 0.0, 0.31, told=True) == one_tissue_share(0.0, 0.0, 0.31) > 0.9
