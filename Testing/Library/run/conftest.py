"""Fixtures of the tests of `run/`."""

from __future__ import annotations

import numpy as np
import pytest
from resume_samples import half

from MedColorLib import Volume
from MedColorLib.phantom import section


@pytest.fixture
def volume(ct) -> Volume:
    """Nine slices of 16 mm; the sixth repeats the fifth."""
    array = np.insert(ct.volume.array[2:10], 5, ct.volume.array[6], 0)
    return Volume(array, ct.volume.ijk_to_ras, name="Doe^Jane")


@pytest.fixture
def references() -> list[np.ndarray]:
    return [half(section(-0.45)), half(section(0.3))]
