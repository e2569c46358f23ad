"""What the tests of pipeline share: samples and small helpers."""

from __future__ import annotations

import numpy as np

from MedColorLib import Settings, Volume

DRAFT = Settings(preset="draft", features="embedded", device="cpu")


MIDDLE = np.s_[2:7]  # slices around eye level, where the phantom's section was cut; in the lowest the sinuses are wide


def settings(**changes) -> Settings:
    return Settings(**{"preset": "draft", "features": "embedded", "device": "cpu", **changes})


def part(phantom, slices=MIDDLE) -> Volume:
    return Volume(phantom.volume.array[slices], phantom.volume.ijk_to_ras, name=phantom.volume.name)


def with_spacing(array, *spacing_mm) -> Volume:
    """Slices as in most files: i to the left, j to the back, k up."""
    return Volume(array, np.diag([-spacing_mm[0], -spacing_mm[1], spacing_mm[2], 1.0]), name="scan")
