"""`medcolor colorize --time-points`: a file for each time point, all of them or none."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import nibabel as nib
import numpy as np
import pytest

from MedColorLib import colorize_time_points, read_color_volume, read_volume
from MedColorLib.cli import time_points
from MedColorLib.cli.main import main
from MedColorLib.cli.time_points import numbered
from MedColorLib.parameters import Settings

pytestmark = pytest.mark.usefixtures("small_raster")
LINE = ("colorize", "beating.nii.gz", "--time-points", "-r", "section.png", "--preset", "draft")


@pytest.fixture
def files(ct, tmp_path, monkeypatch):
    """Working folder with a series of three time points, the last of them upside down; returns the names of what is new."""
    array = ct.volume.array[3:8]
    points = np.stack([array, array + 2, array[:, ::-1]], axis=-1).transpose(2, 1, 0, 3)
    nib.save(nib.Nifti1Image(points, ct.volume.ijk_to_ras), tmp_path / "beating.nii.gz")
    cv2.imwrite(str(tmp_path / "section.png"), ct.reference[..., ::-1])
    monkeypatch.chdir(tmp_path)
    before = {path.name for path in tmp_path.iterdir()}
    return lambda: {path.name for path in tmp_path.iterdir()} - before


def test_a_file_for_each(files, ct, capsys):
    Path("out_2.nrrd").write_bytes(b"former")
    wanted = ("-o", "out.nrrd", "--report", "said.json", "--confidence", "sure.nii.gz")
    assert main([*LINE, *wanted]) == 0
    assert files() == {name for n in "123" for name in (f"out_{n}.nrrd", f"said_{n}.json", f"sure_{n}.nii.gz")}
    said = capsys.readouterr()
    assert "out_2.nrrd: the earlier file of this name was replaced" in said.err and "left out" not in said.err
    assert "out_2.nrrd: 2 of 3, takes the matches of time point 1" in said.out
    assert "out_3.nrrd: 3 of 3, matched by itself" in said.out
    volumes = [read_volume("beating.nii.gz", volume=n) for n in (1, 2, 3)]
    settings = Settings(preset="draft", confidence=True)
    for n, expected in enumerate(colorize_time_points(volumes, ["section.png"], settings), 1):
        written = read_color_volume(f"out_{n}.nrrd")
        np.testing.assert_array_equal(written.rgb, expected.rgb)
        np.testing.assert_allclose(written.ijk_to_ras, ct.volume.ijk_to_ras)
        np.testing.assert_array_equal(read_volume(f"sure_{n}.nii.gz").array, expected.confidence)
        report = json.loads(Path(f"said_{n}.json").read_text())
        assert report["time_point"] == expected.report["time_point"] and report["time_point"]["number"] == n
        assert report["input"]["file_sha256"] and not any("left out:" in note for note in report["input"]["notes"])


def test_the_plan_says_whose_matches_are_taken(files, capsys):
    assert main([*LINE, "--plan"]) == 0
    said = capsys.readouterr().out
    assert "1 of 3, matched by itself\n" in said and not files()
    assert "Time point 2 of 3, takes the matches of time point 1 (likeness " in said
    assert "Time point 3 of 3, matched by itself (likeness" in said


def test_broken_off_nothing_is_left(files, monkeypatch, capsys):
    write = time_points._write

    def interrupted(result, *paths):
        if result.report["time_point"]["number"] == 3:
            raise KeyboardInterrupt
        write(result, *paths)

    Path("out_1.nrrd").write_bytes(b"former")
    monkeypatch.setattr(time_points, "_write", interrupted)
    assert main([*LINE, "-o", "out.nrrd", "--report", "said.json"]) == 130
    assert files() == {"out_1.nrrd"} and Path("out_1.nrrd").read_bytes() == b"former"
    assert capsys.readouterr().err == "medcolor: interrupted; nothing was written\n"


def test_stacks_of_pictures_are_no_time_points(files, capsys):
    """Channels, or two stacks in one folder: nothing says that they differ in time."""
    Path("pictures").mkdir()
    for name in ("one", "two"):
        for n in range(5):
            cv2.imwrite(f"pictures/{name}_{n}.png", np.full((20, 20), 40 * n, np.uint8))
    assert main(["colorize", "pictures", *LINE[2:], "-o", "out.nrrd"]) == 2
    assert "has no other time points" in capsys.readouterr().err and not files() - {"pictures"}
    assert main([*LINE, "--volume", "9", "-o", "out.nrrd"]) == 2
    assert "volume 9 is not there: there are volumes 1 to 3" in capsys.readouterr().err


def test_no_input_is_replaced(files, ct, capsys):
    nib.save(nib.load("beating.nii.gz"), "out_2.nii.gz")
    assert main(["colorize", "out_2.nii.gz", *LINE[2:], "-o", "out.nii.gz"]) == 2
    assert "out_2.nii.gz is the input; the result would replace it" in capsys.readouterr().err


def test_a_body_that_is_read_is_not_replaced(files, ct, capsys):
    nib.save(nib.Nifti1Image((ct.volume.array[3:8] > 0).astype(np.uint8).T, ct.volume.ijk_to_ras), "body.nii.gz")
    line = ("colorize", "beating.nii.gz", *LINE[3:])
    assert main([*line, "--body", "body.nii.gz", "-o", "body.nii.gz"]) == 2
    assert "body.nii.gz is the body; the result would replace it" in capsys.readouterr().err
    cv2.imwrite("mask.png", np.full(cv2.imread("section.png").shape[:2], 255, np.uint8))
    Path("mask.json").write_bytes(Path("mask.png").read_bytes())
    assert main([*line, "--reference-mask", "mask.json", "-o", "out.nrrd", "--report", "mask.json"]) == 2
    assert "mask.json is a reference's mask; the report would replace it" in capsys.readouterr().err


@pytest.mark.parametrize(
    "name, number, count, expected",
    [("a.nrrd", 3, 9, "a_3.nrrd"), ("b/a.b.nii.gz", 3, 10, "b/a.b_03.nii.gz"), ("A.NII.GZ", 1, 1, "A_1.NII.GZ")],
)
def test_names(name, number, count, expected):
    assert numbered(name, number, count) == Path(expected)
