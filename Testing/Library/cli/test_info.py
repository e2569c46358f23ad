"""`medcolor info`, and `--volume` with what it counts."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import cv2
import nibabel as nib
import numpy as np
import pytest

from MedColorLib.cli.main import main


@pytest.fixture
def two_points(tmp_path: Path) -> Path:
    """A NIfTI of two time points."""
    array = np.zeros((8, 9, 10, 2), np.int16)
    array[2:6, 2:7, 2:8, 1] = 900
    nib.save(nib.Nifti1Image(array, np.diag([-1.0, -1, 2, 1])), tmp_path / "two.nii.gz")
    return tmp_path / "two.nii.gz"


def test_table(two_points: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["info", str(two_points)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines == [
        "volume  size        spacing (mm)  what",
        "1       8 x 9 x 10  1 x 1 x 2     time point 1",
        "2       8 x 9 x 10  1 x 1 x 2     time point 2",
        "Number 1 is read unless --volume N says otherwise.",
    ]


def test_one_volume(two_points: Path, capsys: pytest.CaptureFixture) -> None:
    nib.save(nib.load(two_points).slicer[..., 0], two_points.with_name("one.nii"))
    assert main(["info", str(two_points.with_name("one.nii"))]) == 0
    assert capsys.readouterr().out.splitlines()[1:] == ["1       8 x 9 x 10  1 x 1 x 2     one"]


def test_volume_is_chosen_and_its_notes_are_said(two_points: Path, ct, capsys: pytest.CaptureFixture) -> None:
    reference = two_points.with_name("r.png")
    cv2.imwrite(str(reference), ct.reference[..., ::-1])
    nib.save(nib.Nifti1Image(np.stack([ct.volume.array.T] * 2, axis=3), ct.volume.ijk_to_ras), two_points)
    command = ["colorize", str(two_points), "-r", str(reference), "--plan"]
    assert main([*command, "--volume", "2"]) == 0
    assert "time point 2 (56 x 64 x 12) was read, as asked for; left out: 1: time point 1" in capsys.readouterr().err
    assert main(command) == 2
    assert "choose one with --volume N" in capsys.readouterr().err
    assert main([*command, "--volume", "3"]) == 2
    assert "volume 3 is not there: there are volumes 1 to 2; `medcolor info` lists them" in capsys.readouterr().err


def test_missing_input(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["info", str(tmp_path / "nothing")]) == 2
    assert "does not exist" in capsys.readouterr().err


@pytest.mark.parametrize("encoding", ["utf-8:strict", "ascii:strict"])
def test_names_that_the_terminal_cannot_show(encoding: str, two_points: Path) -> None:
    source = os.path.join(os.fsencode(two_points.parent), b"M\xfcller\xc3\xa4.nii.gz")
    os.rename(two_points, source)
    command = [sys.executable, "-m", "MedColorLib", "info", source]
    done = subprocess.run(command, capture_output=True, env={**os.environ, "PYTHONIOENCODING": encoding}, check=False)
    assert done.returncode == 0 and b"time point 2" in done.stdout
    done = subprocess.run(
        [*command[:-1], source + b"x"],
        capture_output=True,
        env={**os.environ, "PYTHONIOENCODING": encoding},
        check=False,
    )
    assert done.returncode == 2 and b"M\\udcfcller" in done.stderr and done.stderr.count(b"\n") == 1
