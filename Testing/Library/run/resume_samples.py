"""What the tests of resume share: samples and small helpers."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from MedColorLib import Settings, colorize
from MedColorLib.errors import Cancelled


def settings(**changes) -> Settings:
    return Settings(
        **{"preset": "draft", "features": "embedded", "device": "cpu", "batch": 2, "coherence_mm": 20.0, **changes}
    )


def half(picture: np.ndarray) -> np.ndarray:
    """A section of half as many pixels a side: quick to clean, and still finer than the raster of 64 pixels."""
    return cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)


def broken_off(after: int, *arguments, resume) -> None:
    """Cancel before step `after` of the run, not inside one."""
    steps = []

    def step(_fraction, text):
        if len(steps) >= after:
            raise Cancelled
        steps.append(text)

    with pytest.raises(Cancelled):
        colorize(*arguments, progress=step, resume=resume)


def files_of(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())
