"""Benchmark: what a deconvolution does to matches. A file of its own: the smaller raster of other files lasts for a file."""

from __future__ import annotations

import pytest

from MedColorLib.bench import deconvolution
from MedColorLib.bench.tables import Table


@pytest.mark.slow
def test_deconvolution_lowers_its_loss(phantom, shared_weights, monkeypatch):
    monkeypatch.setenv("MEDCOLOR_WEIGHTS", str(shared_weights))
    table = Table(deconvolution.COLUMNS)
    for iterations in (0, 8):
        deconvolution.add_row(table, phantom, "as it is", iterations, 0, stop_layer=4)
    warped, solved = table.where()
    assert warped["loss_before"] is None and (warped["of"], solved["of"]) == (0, 2)
    assert solved["loss_after"] < 0.8 * solved["loss_before"] and solved["evaluations"] >= 18
    assert solved["mean_matched"] != warped["mean_matched"] and solved["mean_matched"] < 1.5 * warped["mean_matched"]
