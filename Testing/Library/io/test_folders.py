"""Folders: media with a directory, pages and pictures beside the scan, files without a preamble, names that are not UTF-8."""

from __future__ import annotations

import os
from pathlib import Path, PurePath

import cv2
import nibabel as nib
import numpy as np
import pytest
from dicom_samples import classic, planes, save, save_stack
from volume_samples import LPS, save_nrrd

from MedColorLib.io.dicom import is_dicom
from MedColorLib.io.files import input_sha256, list_volumes, read_volume
from MedColorLib.io.folders import look_into
from MedColorLib.references.color_sections import read_sections

A = planes()
HEIGHTS = [3.0 * n for n in range(10)]


def save_medium(root: Path) -> None:
    save_stack(root / "DICOM" / "S1", A, HEIGHTS)
    save_stack(root / "DICOM" / "S2", A[:3] + 1, HEIGHTS, EchoTime=3, SeriesInstanceUID="1.2.8")


@pytest.mark.parametrize("beside", ["nothing", "directory", "logo", "report", "text", "hidden"])
def test_what_lies_in_the_root_hides_nothing(beside: str, tmp_path: Path) -> None:
    save_medium(tmp_path)
    if beside == "directory":
        (tmp_path / "DICOMDIR").write_bytes(bytes(128) + b"DICM" + bytes(99))
    elif beside == "logo":
        cv2.imwrite(str(tmp_path / "logo.png"), np.full((9, 9, 3), (0, 0, 200), np.uint8))
    elif beside == "report":
        page = classic(np.zeros((9, 9), np.uint16), 0, 1, Modality="OT", SeriesInstanceUID="1.2.9")
        save(page, tmp_path / "page.dcm")
    elif beside == "text":
        (tmp_path / "README.TXT").write_text("read me")
    elif beside == "hidden":
        save_stack(tmp_path / ".trash", np.repeat(A, 2, axis=0), range(20))
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array, A)
    assert ("1 PNG or TIFF pictures beside" in volume.notes[0]) == (beside == "logo")


def test_slices_that_are_named_as_pictures(tmp_path: Path) -> None:
    save_stack(tmp_path, A, HEIGHTS)
    for file in tmp_path.glob("*.dcm"):
        file.rename(file.with_suffix(".png"))
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array, A)
    assert not volume.notes


def test_many_pictures_beside_many_slices_take_time_in_proportion(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for n in range(50):
        (tmp_path / f"{n}.png").write_bytes(b"no picture")
        (tmp_path / f"{n}.dcm").write_bytes(b"no slice")
    hashed, plain = [], PurePath.__hash__
    monkeypatch.setattr(PurePath, "__hash__", lambda path: hashed.append(1) or plain(path))
    assert len(look_into(tmp_path).files) == 50
    assert len(hashed) <= 200


@pytest.mark.parametrize("ending", [".img", ".IMG", ".hdr"])
def test_slices_that_are_named_as_half_a_pair(ending: str, tmp_path: Path) -> None:
    save_stack(tmp_path, A, HEIGHTS)
    for file in sorted(tmp_path.glob("*.dcm")):
        file.rename(file.with_suffix(ending))
    one = sorted(tmp_path.iterdir())[0]
    np.testing.assert_array_equal(read_volume(one).array, A)
    assert list_volumes(one)[0][0].size == A.shape[::-1]
    assert input_sha256(one) != input_sha256(tmp_path)


def test_voxels_of_a_pair_that_begin_as_dicom_does(tmp_path: Path) -> None:
    """Labels: group 0008, a length of 8, and behind that the next element of group 0008."""
    labels = np.zeros((4, 8, 8), np.int16)
    labels.flat[[0, 2, 8]] = 8
    nib.save(nib.Nifti1Pair(labels.T, np.eye(4)), tmp_path / "a.img")
    assert is_dicom(tmp_path / "a.img")
    for name in ("a.img", "a.hdr"):
        np.testing.assert_array_equal(read_volume(tmp_path / name).array, labels)


@pytest.mark.parametrize("kind", ["dicom", "png", "bmp"])
def test_volume_files_beside_are_said(kind: str, tmp_path: Path) -> None:
    if kind == "dicom":
        save_medium(tmp_path)
    else:
        for n in range(4):
            cv2.imwrite(str(tmp_path / f"{n}.{kind}"), np.full((5, 6), n, np.uint8))
    for name in ("a.nii.gz", "b.nii.gz", "c.NRRD"):
        (tmp_path / name).write_bytes(b"another")
    said = " ".join(read_volume(tmp_path).notes)
    assert (
        "volume files in the folder itself (2 .nii.gz, 1 .nrrd) were not looked at; give one of them by its name"
        in said
    )


def test_folders_below_can_be_left_alone(tmp_path: Path) -> None:
    save_medium(tmp_path)
    save(classic(A[0], 0, 1, SeriesInstanceUID="1.2.9"), tmp_path / "page.dcm")
    assert read_volume(tmp_path, below=False).array.shape[0] == 1


def test_pictures_are_read_beside_a_few_dicom_files_below(tmp_path: Path) -> None:
    for n in range(4):
        cv2.imwrite(str(tmp_path / f"{n}.png"), A[n])
    save(classic(A[0], 0, 1), tmp_path / "below" / "a.dcm")
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array, A[:4])
    assert volume.notes[0] == "1 DICOM files in folders below were left out; give their folder"


def test_the_directory_itself_stands_for_its_medium(tmp_path: Path) -> None:
    save_medium(tmp_path)
    (tmp_path / "DICOMDIR").write_bytes(bytes(128) + b"DICM" + bytes(99))
    np.testing.assert_array_equal(read_volume(tmp_path / "DICOMDIR").array, A)


@pytest.mark.parametrize("implicit", [True, False])
def test_without_preamble_and_file_meta_information(implicit: bool, tmp_path: Path) -> None:
    for n, plane in enumerate(A):
        ds = classic(plane, HEIGHTS[n], n + 1)
        del ds.file_meta
        save(ds, tmp_path / f"IM{n:04}", preamble=False, implicit=implicit)
    np.testing.assert_array_equal(read_volume(tmp_path).array, A)


def test_other_files_are_not_taken_for_dicom(tmp_path: Path) -> None:
    texts = [b"", b"NRRD0004\n" * 30, bytes(400), b"\x08\x00" * 200, b"\x89PNG\r\n\x1a\n" + bytes(200), b"II*\0" * 99]
    generator = np.random.default_rng(3)
    texts += [b"\x08\x00" + generator.bytes(300) for _ in range(200)]
    (tmp_path / "file").touch()
    found = 0
    for text in texts:
        (tmp_path / "file").write_bytes(text)
        found += is_dicom(tmp_path / "file")
    assert found == 0


@pytest.fixture
def latin1(tmp_path: Path) -> Path:
    """A folder whose name is Latin-1, as unzipped from Windows."""
    folder = os.fsdecode(os.fsencode(tmp_path) + b"/M\xfcller")
    try:
        os.mkdir(folder)
    except OSError:
        pytest.skip("this file system takes UTF-8 names alone")
    return Path(folder)


def test_names_that_are_not_utf8(latin1: Path) -> None:
    save_stack(latin1 / "DICOM", A, HEIGHTS)
    np.testing.assert_array_equal(read_volume(latin1 / "DICOM").array, A)
    for n in range(3):
        np.uint16(A[n]).tofile(latin1 / "x.raw")
        (latin1 / f"{n}.png").write_bytes(cv2.imencode(".png", A[n])[1].tobytes())
    np.testing.assert_array_equal(read_volume(latin1).array, A)  # DICOM below: more than the pictures
    rgb = np.random.default_rng(2).integers(0, 255, (4, 8, 9, 3)).astype(np.uint8)
    name = os.fsdecode(b"F\xe4rbung.nrrd")
    directions = np.vstack([np.full(3, np.nan), np.eye(3)])
    fields = {"space directions": directions, "kinds": ["RGB-color"] + ["domain"] * 3, "space origin": np.zeros(3)}
    save_nrrd(latin1 / "a.nrrd", rgb, LPS, **fields)
    os.rename(latin1 / "a.nrrd", latin1 / name)
    assert len(read_sections(latin1 / name)) == 4


def test_packed_dicom_under_a_name_that_is_not_utf8(latin1: Path) -> None:
    from pydicom.uid import RLELossless

    ds = classic(A[0], 0, 1)
    ds.compress(RLELossless, generate_instance_uid=False)
    save(ds, latin1 / "a.dcm")
    np.testing.assert_array_equal(read_volume(latin1 / "a.dcm").array[0], A[0])
