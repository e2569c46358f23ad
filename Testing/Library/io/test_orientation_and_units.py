"""NIfTI, NRRD and MetaImage: orientations that contradict each other, axis ends, units, axes of length one, time points."""

from __future__ import annotations

from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
import SimpleITK as sitk
from volume_samples import LPS, save_nrrd

from MedColorLib.errors import InputError
from MedColorLib.io.files import list_volumes, read_volume

A = np.arange(60, dtype=np.int16).reshape(3, 4, 5)
STRAIGHT = np.array([[2.0, 0, 0, -40], [0, 2, 0, -48], [0, 0, 3, 0], [0, 0, 0, 1]])
TURNED = np.array([[0.0, -2, 0, -40], [2, 0, 0, -48], [0, 0, 3, 0], [0, 0, 0, 1]])
SHIFTED = STRAIGHT + np.eye(4, k=3) * 10
SHEARED = STRAIGHT + np.array([[0, 0.5, 0, 0]] + [[0] * 4] * 3)
HAIR = STRAIGHT + np.eye(4, k=3) * 1e-3


def itk_matrix(path: Path) -> np.ndarray:
    image = sitk.ReadImage(path)
    matrix = np.eye(4)
    matrix[:3, :3] = np.reshape(image.GetDirection(), (3, 3)) * image.GetSpacing()
    matrix[:3, 3] = image.GetOrigin()
    return LPS @ matrix


@pytest.mark.parametrize("sform_code", [1, 2, 3, 4])
@pytest.mark.parametrize("qform_code", [1, 2])
@pytest.mark.parametrize("sform", [TURNED, SHIFTED, SHEARED], ids=["turned", "shifted", "sheared"])
def test_sform_and_qform_that_differ(sform: np.ndarray, sform_code: int, qform_code: int, tmp_path: Path) -> None:
    """The same choice as ITK's, and a note that says which."""
    image = nib.Nifti1Image(A.T, sform)
    image.set_sform(sform, sform_code)
    image.set_qform(STRAIGHT, qform_code)
    nib.save(image, tmp_path / "a.nii")
    volume = read_volume(tmp_path / "a.nii")
    np.testing.assert_allclose(volume.ijk_to_ras, itk_matrix(tmp_path / "a.nii"), atol=1e-5)
    taken = "sform" if np.allclose(volume.ijk_to_ras, sform, atol=1e-5) else "qform"
    assert len(volume.notes) == 1 and f"the {taken} is used, as ITK and 3D Slicer do" in volume.notes[0]
    assert ("90 degrees" in volume.notes[0]) == (sform is TURNED)


def test_sform_and_qform_that_differ_by_a_hair(tmp_path: Path) -> None:
    image = nib.Nifti1Image(A.T, HAIR)
    image.set_sform(HAIR, 2)
    image.set_qform(STRAIGHT, 1)
    nib.save(image, tmp_path / "a.nii")
    assert read_volume(tmp_path / "a.nii").notes == ()


def test_uncompressed_nifti_is_mapped(tmp_path: Path) -> None:
    nib.save(nib.Nifti1Image(A.T, STRAIGHT), tmp_path / "a.nii")
    array = read_volume(tmp_path / "a.nii").array
    base = array
    while base is not None and not isinstance(base, np.memmap):
        base = base.base
    assert isinstance(base, np.memmap) and not array.flags.writeable and array.flags.c_contiguous
    np.testing.assert_array_equal(array, A)


@pytest.mark.parametrize("shape", [(1,), (1, 1), (1, 1, 1)])
def test_nifti_axes_of_length_one(shape: tuple, tmp_path: Path) -> None:
    nib.save(nib.Nifti1Image(A.T.reshape(5, 4, 3, *shape), STRAIGHT), tmp_path / "a.nii.gz")
    volume = read_volume(tmp_path / "a.nii.gz")
    np.testing.assert_array_equal(volume.array, A)
    assert volume.notes == ()


def test_nifti_of_one_slice_without_a_thickness(tmp_path: Path) -> None:
    image = nib.Nifti1Image(A[:1].T, STRAIGHT)
    image.set_sform(np.diag([2.0, 2, 0, 1]), 1)
    image.set_qform(None, 0)
    nib.save(image, tmp_path / "a.nii")
    volume = read_volume(tmp_path / "a.nii")
    np.testing.assert_array_equal(volume.ijk_to_ras, np.diag([2.0, 2, 1, 1]))
    assert volume.notes == ("axis k has one voxel and no size: 1 mm is assumed",)


@pytest.mark.parametrize("ending", [".nii", ".nii.gz"])
def test_time_points_of_a_nifti(ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{ending}"
    image = nib.Nifti1Image(np.stack([A.T, A.T + 100], axis=3), STRAIGHT)
    nib.save(image, path)
    with pytest.raises(InputError, match=r"choose one with --volume N.*\(2 volumes\)"):
        read_volume(path)
    for number in (1, 2):
        volume = read_volume(path, volume=number)
        np.testing.assert_array_equal(volume.array, A + 100 * (number - 1))
        assert f"time point {number} (5 x 4 x 3) was read, as asked for" in volume.notes[0]
    assert [choice.text() for choice in list_volumes(path)[0]] == [
        "time point 1 (5 x 4 x 3)",
        "time point 2 (5 x 4 x 3)",
    ]
    image.header.set_slope_inter(2, 1)
    nib.save(image, path)
    np.testing.assert_array_equal(read_volume(path, volume=2).array, nib.load(path).get_fdata()[..., 1].T)


def write_nrrd(path: Path, lines: str, array: np.ndarray = A) -> Path:
    sizes = " ".join(map(str, array.shape[::-1]))
    head = f"NRRD0005\ntype: short\ndimension: {array.ndim}\nsizes: {sizes}\nencoding: raw\nendian: little\n{lines}\n\n"
    path.write_bytes(head.encode() + array.astype("<i2").tobytes())
    return path


@pytest.mark.parametrize(
    "lines, spacing, origin",
    [
        ("spacings: 2 2 3\naxis mins: -40 -48 100", (2, 2, 3), (-39, -47, 101.5)),
        ("spacings: 2 2 3\naxis mins: -40 -48 100\ncenters: node node node", (2, 2, 3), (-40, -48, 100)),
        ("axismins: 0 0 0\naxismaxs: 10 8 9", (2, 2, 3), (1, 1, 1.5)),
        ("axis mins: 0 0 0\naxis maxs: 8 6 6\ncenterings: node node node", (2, 2, 3), (0, 0, 0)),
    ],
)
def test_ends_of_the_axes_of_an_nrrd(lines: str, spacing: tuple, origin: tuple, tmp_path: Path) -> None:
    volume = read_volume(write_nrrd(tmp_path / "a.nrrd", lines))
    np.testing.assert_allclose(volume.spacing_mm, spacing)
    np.testing.assert_allclose(volume.ijk_to_ras[:3, 3], origin)
    assert any("axis mins of the NRRD header, as ITK does" in note for note in volume.notes)
    assert not any("is assumed" in note for note in volume.notes)
    if "spacings" in lines:  # ITK does not reckon them from the ends
        image = sitk.ReadImage(tmp_path / "a.nrrd")
        np.testing.assert_allclose(image.GetSpacing(), spacing)
        np.testing.assert_allclose(image.GetOrigin(), origin)


def test_a_thickness_that_is_taken_for_the_distance_is_said(tmp_path: Path) -> None:
    volume = read_volume(write_nrrd(tmp_path / "a.nrrd", "spacings: 2 2 nan\nthicknesses: nan nan 3"))
    np.testing.assert_allclose(volume.spacing_mm, (2, 2, 3))
    assert "thickness of slices, not their distance" in " ".join(volume.notes)


@pytest.mark.parametrize(
    "unit, scale", [("m", 1000), ("um", 1e-3), ("µm", 1e-3), ("mm", 1), ("", 1), ("furlong", None)]
)
@pytest.mark.parametrize("with_space", [True, False])
def test_units_of_an_nrrd(unit: str, scale: float | None, with_space: bool, tmp_path: Path) -> None:
    quoted = " ".join([f'"{unit}"'] * 3)
    if with_space:
        lines = f"space: LPS\nspace directions: (2,0,0) (0,2,0) (0,0,3)\nspace origin: (4,5,6)\nspace units: {quoted}"
    else:
        lines = f"spacings: 2 2 3\nunits: {quoted}"
    volume = read_volume(write_nrrd(tmp_path / "a.nrrd", lines))
    np.testing.assert_allclose(volume.spacing_mm, np.multiply((2, 2, 3), scale or 1))
    if with_space:
        np.testing.assert_allclose(volume.ijk_to_ras[:3, 3], np.multiply((-4, -5, 6), scale or 1))
    said = " ".join(volume.notes)
    assert ("unit is not millimetres" in said) == (scale not in (1, None)) and ("furlong" in said) == (scale is None)


@pytest.mark.parametrize("where", [0, 3])
def test_nrrd_axes_of_length_one(where: int, tmp_path: Path) -> None:
    directions = ["(2,0,0)", "(0,2,0)", "(0,0,3)"]
    kinds = ["domain"] * 3
    for words, word in ((directions, "none"), (kinds, "list")):
        words.insert(where, word)
    lines = f"space: RAS\nspace directions: {' '.join(directions)}\nkinds: {' '.join(kinds)}\nspace origin: (0,0,0)"
    volume = read_volume(write_nrrd(tmp_path / "a.nrrd", lines, np.expand_dims(A, 3 - where)))
    np.testing.assert_array_equal(volume.array, A)
    np.testing.assert_allclose(volume.spacing_mm, (2, 2, 3))


@pytest.mark.parametrize("where", [0, 3])
def test_time_points_of_an_nrrd(where: int, tmp_path: Path) -> None:
    """As 3D Slicer writes sequences: the list axis first; or last, as others do."""
    directions, kinds = ["(2,0,0)", "(0,2,0)", "(0,0,3)"], ["domain"] * 3
    directions.insert(where, "none")
    kinds.insert(where, "list")
    lines = f"space: RAS\nspace directions: {' '.join(directions)}\nkinds: {' '.join(kinds)}\nspace origin: (0,0,0)"
    path = write_nrrd(tmp_path / "a.nrrd", lines, np.stack([A, A + 100], axis=3 - where))
    with pytest.raises(InputError, match=r"choose one with --volume N.*\(2 volumes\)"):
        read_volume(path)
    np.testing.assert_array_equal(read_volume(path, volume=2).array, A + 100)
    assert len(list_volumes(path)[0]) == 2


def test_colours_are_no_time_points(tmp_path: Path) -> None:
    fields = {"space directions": np.vstack([np.full(3, np.nan), np.eye(3)]), "kinds": ["RGB-color"] + ["domain"] * 3}
    save_nrrd(tmp_path / "a.nrrd", np.zeros((3, 4, 5, 3), np.uint8), **fields)
    for number in (None, 1):
        with pytest.raises(InputError, match="colour"):
            read_volume(tmp_path / "a.nrrd", volume=number)


def test_meta_image_with_a_fourth_axis_of_length_one(tmp_path: Path) -> None:
    image = sitk.GetImageFromArray(A[None].astype(np.float32), isVector=False)
    image.SetSpacing((2, 2, 3, 1))
    image.SetOrigin((4, 5, 6, 0))
    sitk.WriteImage(image, tmp_path / "a.mha")
    volume = read_volume(tmp_path / "a.mha")
    np.testing.assert_array_equal(volume.array, A)
    np.testing.assert_allclose(volume.ijk_to_ras, LPS @ [[2, 0, 0, 4], [0, 2, 0, 5], [0, 0, 3, 6], [0, 0, 0, 1]])


@pytest.mark.parametrize("packed", [True, False])
def test_time_points_of_a_meta_image(packed: bool, tmp_path: Path) -> None:
    image = sitk.GetImageFromArray(np.stack([A, A + 100]).astype(np.float32), isVector=False)
    image.SetSpacing((2, 2, 3, 1))
    sitk.WriteImage(image, tmp_path / "a.mha", useCompression=packed)
    with pytest.raises(InputError, match=r"choose one with --volume N.*\(2 volumes\)"):
        read_volume(tmp_path / "a.mha")
    volume = read_volume(tmp_path / "a.mha", volume=2)
    np.testing.assert_array_equal(volume.array, A + 100)
    assert "time point 2 (5 x 4 x 3) was read, as asked for; left out: 1: time point 1" in volume.notes[0]
    assert len(list_volumes(tmp_path / "a.mha")[0]) == 2


@pytest.mark.parametrize("unit, scale", [("um", 1e-3), ("m", 1e3), ("mm", 1)])
def test_units_of_a_meta_image(unit: str, scale: float, tmp_path: Path) -> None:
    lines = f"NDims = 3\nDimSize = 5 4 3\nElementSpacing = 2 2 3\nOffset = 4 5 6\nDistanceUnits = {unit}\n"
    text = f"{lines}ElementType = MET_SHORT\nBinaryData = True\nElementDataFile = LOCAL\n"
    (tmp_path / "a.mha").write_bytes(text.encode() + A.tobytes())
    volume = read_volume(tmp_path / "a.mha")
    np.testing.assert_allclose(volume.ijk_to_ras @ (1, 1, 1, 1), (*np.multiply((-6, -7, 9), scale), 1))
    assert len(volume.notes) == (scale != 1)
