"""Volumes in: voxels and geometry against what was written, and against SimpleITK as an independent reader."""

from __future__ import annotations

import bz2
import gzip
import hashlib
import os
from pathlib import Path

import cv2
import nibabel as nib
import numpy as np
import pytest
import SimpleITK as sitk
from volume_samples import GEOMETRIES, LPS, geometry, save_nrrd, voxels

from MedColorLib.errors import InputError
from MedColorLib.io.files import file_sha256, read_volume

DATA = Path(__file__).resolve().parents[4] / "shared" / "data"
DTYPES = [np.dtype(f"{kind}{size}") for kind in "iu" for size in (1, 2, 4, 8)] + [np.dtype("f4"), np.dtype("f8")]


def same(volume, array: np.ndarray, matrix: np.ndarray) -> None:
    assert volume.array.dtype == array.dtype
    assert volume.array.dtype.isnative
    np.testing.assert_array_equal(volume.array, array)
    np.testing.assert_array_equal(volume.ijk_to_ras, matrix)


def same_points_as_itk(volume, image: sitk.Image) -> None:
    """SimpleITK puts the same voxels at the same places (it rounds directions to unit length)."""
    for ijk in [(0, 0, 0), (5, 0, 0), (0, 4, 0), (0, 0, 3), (3, 2, 1)]:
        point = volume.ijk_to_ras @ (*ijk, 1)
        np.testing.assert_allclose(LPS[:3, :3] @ image.TransformIndexToPhysicalPoint(ijk), point[:3], atol=1e-4)
        assert image[ijk] == volume.array[ijk[::-1]]


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_every_type_in_every_format(dtype: np.dtype, tmp_path: Path) -> None:
    array = voxels(dtype)
    save_nrrd(tmp_path / "a.nrrd", array)
    save_nrrd(tmp_path / "swapped.nrrd", array.astype(dtype.newbyteorder()))
    nib.save(nib.Nifti1Image(array.T, np.eye(4), dtype=dtype), tmp_path / "a.nii.gz")
    swapped = nib.Nifti1Header(endianness=">")
    swapped.set_data_dtype(dtype.newbyteorder(">"))
    nib.save(nib.Nifti1Image(array.T, np.eye(4), swapped), tmp_path / "swapped.nii")
    sitk.WriteImage(sitk.GetImageFromArray(array), tmp_path / "a.mha", useCompression=True)
    sitk.WriteImage(sitk.GetImageFromArray(array), tmp_path / "a.mhd")
    names = ["a.nrrd", "swapped.nrrd", "a.nii.gz", "swapped.nii", "a.mha", "a.mhd"]
    if dtype.itemsize < 8 or dtype.kind == "f":  # libtiff as OpenCV uses it has no 64-bit integers
        assert cv2.imwritemulti(str(tmp_path / "a.tiff"), list(array))
        names.append("a.tiff")
    for name in names:
        volume = read_volume(tmp_path / name)
        assert volume.name == name.split(".")[0]
        same(volume, array, np.eye(4) if ".nii" in name else LPS)


@pytest.mark.parametrize("name", GEOMETRIES)
def test_nrrd_geometry_is_kept_to_the_last_bit(name: str, tmp_path: Path) -> None:
    array, matrix = voxels(np.dtype("i2")), geometry(name)
    save_nrrd(tmp_path / "a.nrrd", array, matrix)
    volume = read_volume(tmp_path / "a.nrrd")
    same(volume, array, matrix)
    same_points_as_itk(volume, sitk.ReadImage(tmp_path / "a.nrrd"))


@pytest.mark.parametrize(
    "space, signs", [("RAS", (1, 1, 1)), ("left-anterior-superior", (-1, 1, 1)), ("LPS", (-1, -1, 1))]
)
def test_nrrd_spaces(space: str, signs: tuple[int, ...], tmp_path: Path) -> None:
    array, matrix = voxels(np.dtype("i2")), geometry("rotated")
    save_nrrd(tmp_path / "a.nrrd", array, LPS @ matrix, space=space)
    same(read_volume(tmp_path / "a.nrrd"), array, np.diag([*signs, 1.0]) @ matrix)


def test_nrrd_without_known_space_is_taken_as_ras_and_says_so(tmp_path: Path) -> None:
    array, matrix = voxels(np.dtype("i2")), geometry("rotated")
    save_nrrd(tmp_path / "a.nrrd", array, LPS @ matrix, **{"space": None, "space dimension": 3})
    volume = read_volume(tmp_path / "a.nrrd")
    same(volume, array, matrix)
    assert "RAS" in volume.notes[0]
    bare = {"space": None, "space directions": None, "space origin": None}
    save_nrrd(tmp_path / "b.nrrd", array, spacings=np.array([0.5, 0.25, np.nan]), **bare)
    volume = read_volume(tmp_path / "b.nrrd")
    same(volume, array, np.diag([0.5, 0.25, 1, 1]))
    assert len(volume.notes) == 3  # space, spacing and origin were assumed


def test_nrrd_encodings_skips_and_spelling(tmp_path: Path) -> None:
    array = voxels(np.dtype("<i2"))
    fields = (
        "type: short\ndimension: 3\nSizes: 6 5 4\nendian: little\nspace: LPS\n"
        'space directions: (1, 0, 0) ( 0,1,0) (0,0,1 )\nspace origin: (0, 0, 0)\nkey:=value\nlabels: "a" "b\n'
    )
    raw = array.tobytes()
    variants = {
        "raw": ("encoding: raw\nbyte skip: 3", b"???" + raw + b"trailing"),
        "end": ("encoding: raw\nbyteskip: -1", b"whatever it is" + raw),
        "gzip": ("encoding: gzip\nline skip: 1\nbyteskip: 2", b"a line\n" + gzip.compress(b"??" + raw)),
        "bzip2": ("encoding: bzip2", bz2.compress(raw)),
        "text": ("encoding: ascii", " ".join(map(str, array.ravel())).encode()),
        "commas": ("encoding: text", ", ".join(map(str, array.ravel())).encode()),
        "hex": ("encoding: hex\nbyte skip: 2", b"0a F" + b"F\n" + raw.hex("\n", 5).encode()),
        "behind": ("encoding: gzip", gzip.compress(raw) + b"rubbish"),
    }
    for name, (more, data) in variants.items():
        (tmp_path / f"{name}.nrrd").write_bytes(f"NRRD0004\n# comment\n{fields}{more}\n\n".encode() + data)
        (tmp_path / "Zahn-ä.raw").write_bytes(data)
        (tmp_path / f"{name}.nhdr").write_text(f"NRRD0004\n{fields}{more}\ndata file: ./Zahn-ä.raw\n", encoding="utf-8")
        for ending in (".nrrd", ".nhdr"):
            same(read_volume(tmp_path / (name + ending)), array, LPS)


@pytest.mark.parametrize("name", GEOMETRIES)
@pytest.mark.parametrize("version", [nib.Nifti1Image, nib.Nifti2Image])
def test_nifti_sform(name: str, version: type, tmp_path: Path) -> None:
    array, matrix = voxels(np.dtype("i2")), geometry(name)
    nib.save(version(array.T, matrix), tmp_path / "a.nii")
    exact = matrix if version is nib.Nifti2Image else np.vstack([matrix[:3].astype("f4"), [0, 0, 0, 1]])
    volume = read_volume(tmp_path / "a.nii")
    same(volume, array, exact)
    if name != "sheared" and version is nib.Nifti1Image:  # ITK refuses the others
        same_points_as_itk(volume, sitk.ReadImage(tmp_path / "a.nii"))


def test_nifti_qform_units_scale_and_trailing_axis(tmp_path: Path) -> None:
    array, matrix = voxels(np.dtype("i2")), geometry("left-handed")
    image = nib.Nifti1Image(array.T[..., None], None)
    image.set_qform(matrix, code=1)
    image.header.set_xyzt_units("micron")
    image.header.set_slope_inter(0.5, -1024)
    nib.save(image, tmp_path / "a.nii.gz")
    written = np.array(nib.load(tmp_path / "a.nii.gz").dataobj.get_unscaled())[..., 0].T
    volume = read_volume(tmp_path / "a.nii.gz")
    assert volume.array.dtype == np.float32  # holds scaled 16-bit integers
    np.testing.assert_array_equal(volume.array, written * 0.5 - 1024)
    np.testing.assert_allclose(volume.ijk_to_ras[:3], matrix[:3] / 1000, atol=1e-6)
    assert "millimetres" in volume.notes[0]


@pytest.mark.parametrize("ending", [".mha", ".mhd"])
@pytest.mark.parametrize("name", ["rotated", "left-handed"])
def test_meta_image_geometry(name: str, ending: str, tmp_path: Path) -> None:
    array, lps = voxels(np.dtype("f4")), LPS @ geometry(name)
    image = sitk.GetImageFromArray(array)
    spacing = np.linalg.norm(lps[:3, :3], axis=0)
    image.SetSpacing(spacing.tolist())
    image.SetDirection((lps[:3, :3] / spacing).ravel().tolist())
    image.SetOrigin(lps[:3, 3].tolist())
    sitk.WriteImage(image, tmp_path / f"a{ending}")
    volume = read_volume(tmp_path / f"a{ending}")
    np.testing.assert_array_equal(volume.array, array)
    np.testing.assert_allclose(volume.ijk_to_ras, LPS @ lps, rtol=1e-14, atol=1e-12)
    same_points_as_itk(volume, image)


@pytest.mark.parametrize("ending, dtype", [("png", "u1"), ("png", "u2"), ("tif", "i2"), ("tiff", "f4")])
def test_folder_of_pictures_in_natural_order(ending: str, dtype: str, tmp_path: Path) -> None:
    array = voxels(np.dtype(dtype), (12, 5, 6))
    for number, picture in enumerate(array):
        assert cv2.imwrite(str(tmp_path / f"slice{number + 1}.{ending}"), picture)
    (tmp_path / ".hidden.png").write_bytes(b"no picture")
    volume = read_volume(tmp_path)
    same(volume, array, LPS)
    assert "1 mm" in volume.notes[0]


def test_real_ct() -> None:
    if not DATA.is_dir():
        pytest.skip("the shared images are not here")
    volume = read_volume(DATA / "vhf_head_ct.nrrd")
    assert (volume.array.shape, volume.array.dtype, volume.name) == ((234, 512, 512), np.uint8, "vhf_head_ct")
    np.testing.assert_array_equal(volume.spacing_mm, [0.9375, 0.9375, 1.0])
    np.testing.assert_array_equal(volume.ijk_to_ras[:3, 3], [240, 240, 0])
    assert volume.window is None and volume.notes == ()


def test_file_sha256(tmp_path: Path) -> None:
    (tmp_path / "b" / "c").mkdir(parents=True)
    (tmp_path / "b" / "c" / "z").write_bytes(b"last")
    (tmp_path / "b" / "a").write_bytes(b"first")
    assert file_sha256(tmp_path / "b" / "a") == hashlib.sha256(b"first").hexdigest()
    parts = hashlib.sha256(b"first").digest() + hashlib.sha256(b"last").digest()
    before = file_sha256(tmp_path / "b")
    assert before == hashlib.sha256(parts).hexdigest()
    os.rename(tmp_path / "b" / "a", tmp_path / "b" / "b")
    assert file_sha256(tmp_path / "b") == before
    with pytest.raises(InputError, match="does not exist"):
        file_sha256(tmp_path / "missing")
