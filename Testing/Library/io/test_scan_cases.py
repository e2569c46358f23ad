"""The cases that are kept beside the project: each is written by its own script and read; skipped where they are not there."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from MedColorLib.io.files import read_volume

CASES = Path(__file__).resolve().parents[4] / "shared" / "cases"
RISE = {n: np.round(np.linspace(300, 800, n)).astype(int).tolist() for n in (5, 6, 10, 12, 24)}
# case -> {path below its folder: (centre values in order, spacing or None, words of the notes)}
EXPECTED: dict[str, dict[str, tuple]] = {
    "enhanced_frame_order": {"": (RISE[12], (2, 2, 3), [])},
    "enhanced_gap": {"": (None, (2, 2, 3), ["1 gaps between slices", "12 mm after 15 mm"])},
    "enhanced_two_contrasts": {"": (RISE[10], (2, 2, 3), ["left out: 2: ", "--volume"])},
    "folder_of_multipage_tiffs": {"three": (RISE[24], None, ["3 TIFFs of 8, 8, 8 pages"]), "one": (RISE[24], None, [])},
    "grey_saved_as_rgb": {kind: ([37, 58, 79, 100], None, ["grey saved as"]) for kind in ("rgb", "palette", "alpha")},
    "medium_with_dicomdir": {
        kind: (RISE[5], (2, 2, 3), []) for kind in ("dicomdir", "logo", "report", "dicomdir/DICOMDIR")
    },
    "monochrome1_window": {"": (RISE[12], (2, 2, 3), ["MONOCHROME1", "turned round"])},
    "mosaic": {"": (RISE[6], (2, 2, 3), ["mosaic"])},
    "nifti_sform_and_qform": {
        "differ.nii.gz": (RISE[12], (2, 2, 3), ["sform and qform", "90 degrees", "the qform is used"])
    },
    "no_preamble": {"": (RISE[12], (2, 2, 3), [])},
    "nrrd_axis_mins": {
        "axis_mins.nrrd": (RISE[12], (2, 2, 3), ["axis mins"]),
        "metres.nrrd": (RISE[12], (2, 2, 3), ["unit is not millimetres"]),
    },
    "path_not_utf8": {"M*": (RISE[12], (2, 2, 3), [])},
    "png_negative_positions": {kind: (None, None, ["minus"]) for kind in ("whole", "half")},
    "tiff_white_is_zero": {"16bit.tif": (RISE[12], None, ["65535 minus"]), "8bit.tif": (None, None, ["255 minus"])},
    "two_acquisitions": {"": (RISE[10], (2, 2, 3), ["left out: 2: ", "acquisition 2"])},
    "two_contrasts_same_numbers": {"": (RISE[10], (2, 2, 3), ["left out: 2: ", "echo time 90 ms"])},
}


@pytest.mark.parametrize("case", EXPECTED)
def test_case(case: str, tmp_path: Path) -> None:
    script = CASES / case / "make.py"
    if not script.is_file():
        pytest.skip("the cases are not here")
    if "import classic" in (source := script.read_text(encoding="utf-8")) or "import enhanced" in source:
        pytest.importorskip("pydicom", minversion="3", reason="the scripts write DICOM as pydicom 3 does")
    subprocess.run(
        [sys.executable, str(script), str(tmp_path)], check=True, env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}
    )
    for name, (centres, spacing, words) in EXPECTED[case].items():
        found = sorted(tmp_path.glob(name)) if "*" in name else [tmp_path / name]
        for path in found:
            volume = read_volume(path)
            seen = (
                np.round(volume.array[:, volume.array.shape[1] // 2, volume.array.shape[2] // 2]).astype(int).tolist()
            )
            assert (seen == centres) if centres else seen == sorted(seen)
            if spacing:
                np.testing.assert_allclose(volume.spacing_mm, spacing, rtol=1e-6)
            for word in words:
                assert word in " ".join(volume.notes), (word, volume.notes)
