"""How far grey tells tissue is asked of the whole scan, and decides on one colour for a grey and on support."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from MedColorLib import Settings, Volume
from MedColorLib.matching.usual import FEW_PX, MANY_PX
from MedColorLib.phantom import section
from MedColorLib.progress import Run
from MedColorLib.run.engine import Engine
from MedColorLib.run.prepare import prepare


def engine_of(soft_levels: float, slices=None, **changes) -> Engine:
    """A body of six slices whose grey varies by `soft_levels` of the range; the first two slices hold one grey alone."""
    rows, cols = np.mgrid[-1:1:96j, -1:1:96j]
    body = np.hypot(rows, cols) < 0.85
    grey = 0.5 + soft_levels * (0.5 * rows + 0.3 * np.sin(6 * cols))
    stack = np.stack([np.where(body, 0.5 if k < 2 else grey, -2.0) for k in range(6)]).astype(np.float32)
    settings = Settings(features="embedded", preset="draft", window=(0.0, 1.0), slices=slices, **changes)
    return Engine(prepare(Volume(stack, np.diag([1.0, 1.0, 3.0, 1.0])), [section()], settings), Run(None, None))


def with_trust(engine: Engine, explained: float) -> Engine:
    for reference in engine.references:
        reference.contrast = replace(reference.contrast, explained=explained)
    return engine


def test_mr_looks_for_tissue():
    engine = with_trust(engine_of(0.9), explained=0.0)
    assert engine.grey_tells > 0.4 and engine.one_tissue(1.0) == pytest.approx(engine.grey_tells**2)
    assert engine.smoother_options["support_px"] == pytest.approx(
        FEW_PX + (MANY_PX - FEW_PX) * engine.grey_tells, abs=0.1
    )


def test_matches_that_tell_grey_know_better():
    engine = with_trust(engine_of(0.9), explained=1.0)
    assert engine.one_tissue(0.0) == 0 and engine.smoother_options["support_px"] == FEW_PX


def test_ct_looks_for_the_place_where_matches_know_it():
    engine = with_trust(engine_of(0.05), explained=0.0)
    assert engine.grey_tells == 0
    shares = [engine.transfer_parameters(trusted_fraction=trusted).one_tissue for trusted in (0.2, 0.35, 0.4, 0.5, 1.0)]
    assert shares[0] == 1 > shares[1] > shares[2] > 0 == shares[3] == shares[4]
    assert engine.smoother_options["support_px"] == FEW_PX


@pytest.mark.parametrize(
    "changes", [{"smoother": "fgs"}, {"smoother_options": {"support_px": 9.0}, "smoother": "regression"}]
)
def test_options_that_are_given_stay(changes):
    assert engine_of(0.9, **changes).smoother_options == changes.get("smoother_options")


def test_where_matches_are_not_weighed_nobody_asks():
    engine = engine_of(0.9, smoother="guided")
    assert engine.one_tissue(0.0) == 0 and engine.references[0].usual is None and "grey_tells" not in vars(engine)


def test_slices_asked_for_do_not_change_it():
    """The first two hold one grey, as a CT would; the scan does not."""
    assert engine_of(0.9, slices=(0, 2)).grey_tells == engine_of(0.9).grey_tells
