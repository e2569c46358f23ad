"""How far grey tells tissue is asked of the whole scan, and decides on place in the features and on one colour for a grey."""

from __future__ import annotations

import numpy as np
import pytest

from MedColorLib import Settings, Volume
from MedColorLib.features import OWN_CONTEXT
from MedColorLib.phantom import section
from MedColorLib.progress import Run
from MedColorLib.run.engine import Engine
from MedColorLib.run.prepare import prepare


def engine_of(soft_levels: float, slices=None) -> Engine:
    """A body of six slices whose grey varies by `soft_levels` of the range; the first two slices hold one grey alone."""
    rows, cols = np.mgrid[-1:1:96j, -1:1:96j]
    body = np.hypot(rows, cols) < 0.85
    grey = 0.5 + soft_levels * (0.5 * rows + 0.3 * np.sin(6 * cols))
    stack = np.stack([np.where(body, 0.5 if k < 2 else grey, -2.0) for k in range(6)]).astype(np.float32)
    settings = Settings(features="embedded", preset="draft", window=(0.0, 1.0), slices=slices)
    return Engine(prepare(Volume(stack, np.diag([1.0, 1.0, 3.0, 1.0])), [section()], settings), Run(None, None))


def test_mr_looks_for_tissue_alone():
    engine = engine_of(0.9)
    assert engine.grey_tells > 0.4 and engine.one_tissue == pytest.approx(engine.grey_tells**2)
    assert engine.extractor.context == pytest.approx(OWN_CONTEXT * (1 - engine.grey_tells))


def test_ct_looks_for_the_place_as_well():
    engine = engine_of(0.05)
    assert engine.grey_tells == 0 == engine.one_tissue
    assert engine.extractor.context == OWN_CONTEXT


def test_slices_asked_for_do_not_change_it():
    """The first two hold one grey, as a CT would; the scan does not."""
    assert engine_of(0.9, slices=(0, 2)).grey_tells == engine_of(0.9).grey_tells
