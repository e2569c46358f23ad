"""Fixtures of the tests of `cohort/`."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest
from batch_samples import GOOD
from volume_samples import save_nrrd


@pytest.fixture
def cohort(ct, tmp_path, monkeypatch) -> Path:
    """Working folder with section.png and `in`: four volumes of four slices, one broken, a text and a hidden file."""
    monkeypatch.chdir(tmp_path)
    small = cv2.resize(ct.reference, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)  # quick to clean
    cv2.imwrite("section.png", small[..., ::-1])
    Path("in/b").mkdir(parents=True)
    for number, name in enumerate(GOOD):
        save_nrrd(Path("in", name), ct.volume.array[number + 2 : number + 6], ct.volume.ijk_to_ras)
    data = Path("in/a.nrrd").read_bytes()
    Path("in/broken.nrrd").write_bytes(data[: len(data) // 2])
    Path("in/notes.txt").write_text("no volume")
    Path("in/.hidden.nrrd").write_bytes(data)
    return tmp_path
