"""A short run of the fuzz: the same damaged headers in every run; `headers.py` goes on from there."""

from __future__ import annotations

from pathlib import Path

import pytest
from headers import KINDS, MAX_GROWTH, _peak_bytes, run_case

FAULTS_OF_LONG_RUNS = {
    "nrrd": (1000805, 1002864),
    "nifti": (249, 263, 1329, 1479, 1952),
    "png": (405, 1085, 1140, 2020091),
    "photograph": (328, 1268, 32234),
    "tiff": (245, 2361, 2010277),
    "metaimage": (1000127, 1005521),
    "colors": (7000095, 7000638, 7000839, 7000883, 7001686),
    "library": (2007525, 2011007, 2017257, 2024127),
    "labels": (1014617, 1021286),
}


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_headers_are_read_or_refused(kind: str, tmp_path: Path) -> None:
    KINDS[kind][0](tmp_path)
    outcomes = set()
    before = _peak_bytes(reset=True)
    for seed in (*range(60), *FAULTS_OF_LONG_RUNS.get(kind, ())):
        outcomes.add(run_case(kind, seed, tmp_path))
    assert outcomes == {"read", "refused"}
    assert _peak_bytes(reset=False) - before < MAX_GROWTH
