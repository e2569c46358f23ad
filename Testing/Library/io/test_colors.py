"""Colour volumes are read as ITK reads sound ones; damaged ones, which may end its process, are refused."""

from __future__ import annotations

from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
import SimpleITK as sitk
from volume_samples import LPS, geometry

from MedColorLib.errors import InputError
from MedColorLib.io.colors import read_colors

COLORS = np.random.default_rng(3).integers(0, 256, (4, 5, 6, 4)).astype(np.uint8)


def save(path: Path, channels: int, packed: bool) -> sitk.Image:
    image = sitk.GetImageFromArray(np.ascontiguousarray(COLORS[..., :channels]), isVector=True)
    lps = LPS @ geometry("rotated")
    spacing = np.linalg.norm(lps[:3, :3], axis=0)
    image.SetSpacing(spacing)
    image.SetDirection((lps[:3, :3] / spacing).ravel())
    image.SetOrigin(lps[:3, 3])
    sitk.WriteImage(image, str(path), useCompression=packed)
    return sitk.ReadImage(str(path))


@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("ending", [".nrrd", ".nhdr", ".mha", ".mhd", ".nii", ".nii.gz"])
def test_as_itk_reads_them(ending: str, packed: bool, channels: int, tmp_path: Path) -> None:
    image = save(tmp_path / f"a{ending}", channels, packed)
    values, matrix = read_colors(tmp_path / f"a{ending}", 1 << 20)
    np.testing.assert_array_equal(values, COLORS[..., :channels])
    expected = np.eye(4)
    expected[:3, :3] = np.reshape(image.GetDirection(), (3, 3)) * image.GetSpacing()
    expected[:3, 3] = image.GetOrigin()
    np.testing.assert_allclose(matrix, LPS @ expected, atol=1e-4)


@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize("ending", [".nii", ".nii.gz"])
def test_nifti_of_colour_types(ending: str, channels: int, tmp_path: Path) -> None:
    kind = np.dtype([(letter, "u1") for letter in "RGBA"[:channels]])
    values = np.ascontiguousarray(COLORS[..., :channels]).view(kind)[..., 0]
    nib.save(nib.Nifti1Image(values.T, np.diag([2.0, 3, 4, 1])), tmp_path / f"a{ending}")
    got, matrix = read_colors(tmp_path / f"a{ending}", 1 << 20)
    np.testing.assert_array_equal(got, COLORS[..., :channels])
    np.testing.assert_allclose(matrix, np.diag([2.0, 3, 4, 1]))


def test_headers_that_lead_elsewhere_and_damaged_voxels(tmp_path: Path) -> None:
    save(tmp_path / "a.mhd", 3, False)
    (tmp_path / "sub").mkdir()
    (tmp_path / "a.mhd").rename(tmp_path / "sub" / "a.mhd")
    text = (tmp_path / "sub" / "a.mhd").read_text().replace("= a.raw", "= ../a.raw")
    (tmp_path / "sub" / "a.mhd").write_text(text)
    with pytest.raises(InputError, match="lies outside the header's folder"):
        read_colors(tmp_path / "sub" / "a.mhd", 1 << 20)
    save(tmp_path / "b.mha", 3, True)
    data = bytearray((tmp_path / "b.mha").read_bytes())
    data[-30] ^= 255
    (tmp_path / "b.mha").write_bytes(data)
    with pytest.raises(InputError, match="damaged"):
        read_colors(tmp_path / "b.mha", 1 << 20)
    with pytest.raises(InputError, match="more than the limit"):
        read_colors(tmp_path / "b.mha", 100)
