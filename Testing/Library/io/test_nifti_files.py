"""NIfTI as it is packed, split in two and written by programs that leave fields empty or fill them with nonsense."""

from __future__ import annotations

import gzip
import struct
import tracemalloc
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
import SimpleITK as sitk
from volume_samples import LPS, voxels

from MedColorLib.cohort.batch import find_volumes
from MedColorLib.errors import InputError
from MedColorLib.io.colors import read_colors
from MedColorLib.io.files import input_sha256, read_color_volume, read_volume

VALUES = voxels(np.dtype("i2"))  # (k, j, i)
PLACE = np.array([[-2.0, 0, 0, 10], [0, 0, 4, -20], [0, -3, 0, 30], [0, 0, 0, 1]])


def save(path: Path, kind: type = nib.Nifti1Image) -> Path:
    image = kind(VALUES.T, PLACE)
    image.set_qform(PLACE, code=1)
    nib.save(image, path)
    return path


def write(path: Path, offset: int, form: str, *values: float) -> Path:
    """Numbers of the header replaced, as written by other programs; the offsets are those of nifti1.h."""
    data = bytearray(path.read_bytes())
    struct.pack_into(form, data, offset, *values)
    path.write_bytes(bytes(data))
    return path


def as_itk(path: Path) -> None:
    volume, image = read_volume(path), sitk.ReadImage(str(path))
    lps = np.eye(4)
    lps[:3, :3] = np.reshape(image.GetDirection(), (3, 3)) * image.GetSpacing()
    lps[:3, 3] = image.GetOrigin()
    np.testing.assert_array_equal(volume.array, sitk.GetArrayFromImage(image))
    np.testing.assert_allclose(volume.ijk_to_ras, LPS @ lps, atol=1e-4)


@pytest.mark.parametrize("kind", [nib.Nifti1Pair, nib.Nifti2Pair])
@pytest.mark.parametrize("ending", ["", ".gz"])
def test_pairs(ending: str, kind: type, tmp_path: Path) -> None:
    save(tmp_path / f"a.img{ending}", kind)
    for name in (f"a.hdr{ending}", f"a.img{ending}"):
        volume = read_volume(tmp_path / name)
        np.testing.assert_array_equal(volume.array, VALUES)
        np.testing.assert_allclose(volume.ijk_to_ras, PLACE, atol=1e-4)
        assert volume.name == "a" and not volume.notes
    if kind is nib.Nifti1Pair:
        as_itk(tmp_path / f"a.hdr{ending}")
    found = find_volumes(tmp_path, tmp_path / "out")
    assert list(found.volumes) == [f"a.hdr{ending}"] and not found.passed_over
    before = input_sha256(tmp_path / f"a.hdr{ending}")
    (tmp_path / f"a.img{ending}").write_bytes((tmp_path / f"a.img{ending}").read_bytes() + b"x")
    assert input_sha256(tmp_path / f"a.hdr{ending}") != before
    (tmp_path / f"a.img{ending}").unlink()
    with pytest.raises(InputError, match=r"one file of a pair, a\.img is missing"):
        read_volume(tmp_path / f"a.hdr{ending}")


def test_analyze_files_do_not_tell_left_from_right(tmp_path: Path) -> None:
    nib.save(nib.AnalyzeImage(VALUES.T, None), tmp_path / "a.img")
    with pytest.raises(InputError, match=r"Analyze.*left from right; save it as NIfTI"):
        read_volume(tmp_path / "a.hdr")


def test_names_that_do_not_tell_how_the_file_is_packed(tmp_path: Path) -> None:
    save(tmp_path / "a.nii").rename(tmp_path / "b.nii.gz")
    with pytest.raises(InputError, match=r"not packed with gzip, though .* if it is a NIfTI, name it b\.nii$"):
        read_volume(tmp_path / "b.nii.gz")
    save(tmp_path / "a.nii.gz").rename(tmp_path / "b.nii")
    with pytest.raises(InputError, match=r"packed with gzip, but .*; name it b\.nii\.gz$"):
        read_volume(tmp_path / "b.nii")


@pytest.mark.parametrize("behind", [b"rubbish", b"\0" * 100_000, b"\0" * 70_000 + b"\x1f"])
def test_what_follows_the_packed_data_does_not_count(behind: bytes, tmp_path: Path) -> None:
    path = save(tmp_path / "a.nii.gz")
    path.write_bytes(path.read_bytes() + behind)
    np.testing.assert_array_equal(read_volume(path).array, VALUES)


def test_data_packed_in_several_pieces(tmp_path: Path) -> None:
    data = save(tmp_path / "a.nii").read_bytes()
    (tmp_path / "b.nii.gz").write_bytes(b"".join(gzip.compress(data[n : n + 77]) for n in range(0, len(data), 77)))
    as_itk(tmp_path / "b.nii.gz")


def test_damaged_packed_voxels_are_noticed(tmp_path: Path) -> None:
    path = save(tmp_path / "a.nii.gz")
    path.write_bytes(gzip.compress(gzip.decompress(path.read_bytes()), 0))  # stored: damage gives no other error
    data = bytearray(path.read_bytes())
    data[-40] ^= 255
    path.write_bytes(bytes(data))
    with pytest.raises(InputError, match="damaged"):
        read_volume(path)
    path.write_bytes(bytes(data[:-30]))
    with pytest.raises(InputError, match="cut short"):
        read_volume(path)


@pytest.mark.parametrize("begin", [0.0, 348.0])
def test_voxels_that_would_begin_in_the_header(begin: float, tmp_path: Path) -> None:
    path = write(save(tmp_path / "a.nii"), 108, "<f", begin)
    with pytest.raises(InputError, match=f"voxels begin at byte {begin:g}, which is in the header"):
        read_volume(path)


def test_no_orientation_is_taken_as_itk_takes_it(tmp_path: Path) -> None:
    path = write(write(save(tmp_path / "a.nii"), 252, "<hh", 0, 0), 80, "<3f", 2.5, 3.5, 4.5)
    as_itk(path)
    assert "no orientation: axes are taken to lead left, back and up" in read_volume(path).notes[0]


@pytest.mark.parametrize("slope, intercept, noted", [(0, 0, False), (0, 5, True), (np.nan, 0, True), (np.inf, 1, True)])
def test_scales_that_are_none(slope: float, intercept: float, noted: bool, tmp_path: Path) -> None:
    path = write(save(tmp_path / "a.nii"), 112, "<ff", slope, intercept)
    volume = read_volume(path)
    np.testing.assert_array_equal(volume.array, VALUES)
    assert bool(volume.notes) is noted and all("is not used; the values are as stored" in note for note in volume.notes)


def test_a_scale_of_a_packed_file(tmp_path: Path) -> None:
    path = write(save(tmp_path / "a.nii"), 112, "<ff", -0.25, 7)
    (tmp_path / "b.nii.gz").write_bytes(gzip.compress(path.read_bytes()))
    as_itk(tmp_path / "b.nii.gz")
    assert read_volume(tmp_path / "b.nii.gz").array.dtype == np.float32


@pytest.mark.parametrize("ending", ["", ".gz"])
@pytest.mark.parametrize("channels", [3, 4])
def test_colours_have_no_scale(channels: int, ending: str, tmp_path: Path, rng: np.random.Generator) -> None:
    """nifti1.h: scl_slope and scl_inter are not used with RGB."""
    colors = rng.integers(0, 256, (2, 3, 4, channels), dtype=np.uint8)  # (k, j, i, channel)
    kind = np.dtype([(name, "u1") for name in "RGBA"[:channels]])
    nib.save(nib.Nifti1Image(colors.view(kind)[..., 0].T, PLACE), tmp_path / "a.nii")
    write(tmp_path / "a.nii", 112, "<ff", 2, 7)
    if ending:
        (tmp_path / "a.nii.gz").write_bytes(gzip.compress((tmp_path / "a.nii").read_bytes()))
    np.testing.assert_array_equal(read_colors(tmp_path / f"a.nii{ending}", 1 << 20)[0], colors)
    if channels == 3:
        np.testing.assert_array_equal(read_color_volume(tmp_path / f"a.nii{ending}").rgb, colors)


def test_a_fourth_axis_of_one_is_scaled_plane_by_plane(tmp_path: Path) -> None:
    values = np.arange(64**3, dtype="i2").reshape(1, 64, 64, 64)
    nib.save(nib.Nifti1Image(values.T, PLACE), tmp_path / "a.nii")
    write(tmp_path / "a.nii", 112, "<ff", 0.5, 7)
    read_volume(tmp_path / "a.nii")  # modules are loaded
    tracemalloc.start()
    array = read_volume(tmp_path / "a.nii").array
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    np.testing.assert_array_equal(array, values[0] * np.float32(0.5) + 7)
    assert array.dtype == np.float32 and peak < 1.5 * array.nbytes


def test_size_of_zero_is_said(tmp_path: Path) -> None:
    path = write(write(save(tmp_path / "a.nii"), 254, "<h", 0), 84, "<f", 0)
    assert "has no size of the voxels along j (0): 1 mm is assumed" in " ".join(read_volume(path).notes)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_damaged_sform(value: float, tmp_path: Path) -> None:
    path = write(save(tmp_path / "a.nii"), 280, "<f", value)
    volume = read_volume(path)
    np.testing.assert_allclose(volume.ijk_to_ras, PLACE, atol=1e-4)
    assert volume.notes == ("the sform of the NIfTI header is damaged; the qform is used",)
    with pytest.raises(InputError, match="sform cannot be used; repair its orientation"):
        read_volume(write(path, 252, "<h", 0))
