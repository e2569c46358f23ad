"""Fixtures of the tests of `Library/`."""

from __future__ import annotations

import pytest
from pipeline_samples import DRAFT, part

from MedColorLib import ColorVolume, colorize


@pytest.fixture(scope="module")
def colored(ct, small_raster) -> ColorVolume:
    return colorize(part(ct), [ct.reference], DRAFT)
