"""What scanners and exporters put into a series that is none of its slices, or no measurement."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pydicom
import pytest
from dicom_samples import STEP_MM, classic, planes, save
from pydicom.dataset import Dataset
from pydicom.encaps import encapsulate

from MedColorLib.errors import InputError
from MedColorLib.io.files import list_volumes, read_volume

ARRAY = planes(8)
HEIGHTS = [STEP_MM * n for n in range(8)]
BRIGHT = np.full(ARRAY.shape[1:], 9000, np.uint16)


def save_series(folder: Path, **fields) -> None:
    for number, (plane, height) in enumerate(zip(ARRAY, HEIGHTS)):
        given = {name: value(number) if callable(value) else value for name, value in fields.items()}
        save(classic(plane, height, number + 2, **given), folder / f"{number}.dcm")


@pytest.mark.parametrize("height", [-30.0, -3.0, 0.0, 10.6, 24.0, 60.0])
def test_planning_pictures_are_no_slices(height: float, tmp_path: Path) -> None:
    save_series(tmp_path, ImageType=["ORIGINAL", "PRIMARY", "AXIAL"])
    save(classic(BRIGHT, height, 1, ImageType=["ORIGINAL", "PRIMARY", "LOCALIZER"]), tmp_path / "plan.dcm")
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array, ARRAY)
    assert "left out: 2: MR series 7, image type LOCALIZER (5 x 6 x 1)" in volume.notes[0] and len(volume.notes) == 1
    assert read_volume(tmp_path, volume=2).array.min() == 9000


def test_planning_pictures_alone_are_read(tmp_path: Path) -> None:
    save_series(tmp_path, ImageType=["ORIGINAL", "PRIMARY", "LOCALIZER"])
    np.testing.assert_array_equal(read_volume(tmp_path).array, ARRAY)


@pytest.mark.parametrize(
    "height, reason",
    [
        (-30.0, "single images 30 mm beyond the others"),
        (60.0, "single images 39 mm beyond the others"),
        (1.3, "one image lies between slices that are even without it"),
        (10.6, "one image lies between slices that are even without it"),
    ],
)
def test_a_single_image_beside_even_slices_is_left_out(height: float, reason: str, tmp_path: Path) -> None:
    save_series(tmp_path)
    save(classic(BRIGHT, height, 1), tmp_path / "stray.dcm")
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array, ARRAY)
    assert reason in volume.notes[1] and "left out: 2: MR series 7 (5 x 6 x 1)" in volume.notes[0]
    np.testing.assert_allclose(volume.ijk_to_ras[2, 3], 0)


@pytest.mark.parametrize("missing", [(1,), (6,), (1, 2), (3, 4, 5)])
def test_gaps_of_missing_slices_are_filled_as_before(missing: tuple[int, ...], tmp_path: Path) -> None:
    save_series(tmp_path)
    for number in missing:
        (tmp_path / f"{number}.dcm").unlink()
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array, ARRAY)  # which is linear
    assert "gaps between slices" in volume.notes[0] and len(volume.notes) == 1


def test_sizes_are_listed_as_they_are_read(tmp_path: Path) -> None:
    save_series(tmp_path, ImagePositionPatient=lambda n: [0, 0.8 * n, HEIGHTS[n] + (n > 4) * STEP_MM])
    assert list_volumes(tmp_path)[0][0].size == read_volume(tmp_path).array.shape[::-1] == (5, 18, 9)


def padded(value: int, photometric: str, signed: int, folder: Path, **rescale: str) -> tuple[np.ndarray, np.ndarray]:
    """Writes slices whose first row is padding; returns them as stored, and where the padding is."""
    where = np.zeros(ARRAY.shape, bool)
    where[:, 0] = True
    stored = np.where(where, value, ARRAY.astype(np.int64) - 150 * signed)
    for number, plane in enumerate(stored):
        fields = {"PhotometricInterpretation": photometric, "PixelRepresentation": signed, **rescale}
        ds = classic(plane.astype(np.uint16), HEIGHTS[number], number + 1, **fields)
        ds.PixelData = plane.astype("<i2" if signed else "<u2").tobytes()
        ds.add_new(0x00280120, "SS" if signed else "US", value)
        save(ds, folder / f"{number}.dcm")
    return stored, where


@pytest.mark.parametrize(
    "value, photometric, signed",
    [(65535, "MONOCHROME2", 0), (0, "MONOCHROME1", 0), (30000, "MONOCHROME2", 1), (-30000, "MONOCHROME1", 1)],
)
def test_padding_is_never_brighter_than_the_rest(value: int, photometric: str, signed: int, tmp_path: Path) -> None:
    stored, where = padded(value, photometric, signed, tmp_path)
    shown = stored if photometric == "MONOCHROME2" else (65535 if not signed else -1) - stored
    expected = np.where(where, np.min(shown, axis=(1, 2), where=~where, initial=99999)[:, None, None], shown)
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array, expected)
    assert any("padding is no measurement: it was made as dark" in note for note in volume.notes)


@pytest.mark.parametrize("value, photometric, signed", [(0, "MONOCHROME2", 0), (-2000, "MONOCHROME2", 1)])
def test_dark_padding_stays(value: int, photometric: str, signed: int, tmp_path: Path) -> None:
    stored, _ = padded(value, photometric, signed, tmp_path)
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array, stored)
    assert not volume.notes


@pytest.mark.parametrize("slope, intercept", [("-1", "0"), ("-0.5", "100")])
@pytest.mark.parametrize("value, turned", [(0, True), (65535, False)])
def test_padding_of_a_falling_scale(value: int, turned: bool, slope: str, intercept: str, tmp_path: Path) -> None:
    """The smallest stored number becomes the largest value."""
    stored, where = padded(value, "MONOCHROME2", 0, tmp_path, RescaleSlope=slope, RescaleIntercept=intercept)
    scaled = stored * float(slope) + float(intercept)
    least = np.min(scaled, axis=(1, 2), where=~where, initial=99999)[:, None, None]
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array, np.where(where & turned, least, scaled))
    assert any("padding is no measurement: it was made as dark" in note for note in volume.notes) == turned


def test_a_slice_without_the_scale_of_the_others(tmp_path: Path) -> None:
    save_series(tmp_path, RescaleSlope="2", RescaleIntercept="-1024")
    bare = pydicom.dcmread(tmp_path / "3.dcm")
    del bare.RescaleSlope, bare.RescaleIntercept
    save(bare, tmp_path / "3.dcm")
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array, 2 * ARRAY.astype(int) - 1024)
    assert (
        "1 of 8 images have no rescale slope in their header; that of the others is taken (2, intercept -1024)"
        in volume.notes
    )
    other = pydicom.dcmread(tmp_path / "5.dcm")
    other.RescaleSlope = "3"
    save(other, tmp_path / "5.dcm")
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array[3], ARRAY[3])
    assert "1 of 8 images have no rescale slope in their header; their values are as stored" in volume.notes


def test_a_slice_that_is_meant_the_other_way_round_is_counted(tmp_path: Path) -> None:
    save_series(tmp_path, PhotometricInterpretation=lambda n: "MONOCHROME1" if n == 3 else "MONOCHROME2")
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array[3], 65535 - ARRAY[3])
    assert volume.notes[0].startswith("MONOCHROME1 of 1 of 8 images: larger stored numbers are meant to look darker")


def test_a_slope_of_zero_and_a_table_are_said(tmp_path: Path) -> None:
    table = Dataset()
    table.add_new(0x00283002, "US", [4, 0, 16])
    table.add_new(0x00283006, "US", [3, 2, 1, 0])
    save_series(tmp_path, RescaleSlope="0", RescaleIntercept="5", ModalityLUTSequence=[table])
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array, ARRAY + 5)
    said = " ".join(volume.notes)
    assert (
        "rescale slope of the header is 0; 1 is taken" in said and "(Modality LUT) in the header is not applied" in said
    )


def test_packed_in_a_way_that_is_not_known(tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    ds = classic(ARRAY[0], 0, 1)
    ds.file_meta.TransferSyntaxUID = "1.2.840.10008.1.2.4.100"
    ds.PixelData = encapsulate([b"\xff\x4f\xff\x51" + bytes(60)])
    ds["PixelData"].is_undefined_length = True
    save(ds, tmp_path / "a.dcm")
    data = (tmp_path / "a.dcm").read_bytes()  # pydicom 2 knows no High-Throughput JPEG 2000, and writes none
    assert data.count(b".1.2.4.100") == 1
    (tmp_path / "a.dcm").write_bytes(data.replace(b".1.2.4.100", b".1.2.4.201"))
    name = (
        "High-Throughput JPEG 2000"
        if int(pydicom.__version__.split(".")[0]) >= 3
        else r"1\.2\.840\.10008\.1\.2\.4\.201"
    )
    with pytest.raises(InputError, match=rf"packed as {name}.* cannot be decoded; .*gdcmconv --raw"):
        read_volume(tmp_path)
    assert capfd.readouterr().err == ""
