"""DICOM: slices that lie on no upright regular grid are resampled to one; what they show stays where it was."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
from dicom_samples import ORIGIN_MM, SPACING_MM, classic, enhanced, planes, save

from MedColorLib.io.files import read_volume

GRADIENT = np.array(
    [30.0, -20.0, 12.0]
)  # grey values per millimetre: what is linear in space survives linear resampling
SHAPE = (24, 20)
OBLIQUE = (0.8, 0.6, 0.0, -0.48, 0.64, 0.6)


def linear_slice(corner: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """(j, i) grey values of the linear scan; LPS millimetres."""
    j, i = np.indices(SHAPE)
    points = corner + (i[..., None] * SPACING_MM[0]) * axes[0] + (j[..., None] * SPACING_MM[1]) * axes[1]
    return np.rint(points @ GRADIENT + 20000).astype(np.uint16)


def save_slices(folder: Path, corners: np.ndarray, axes: tuple = (1, 0, 0, 0, 1, 0)) -> None:
    for n, corner in enumerate(corners):
        plane = linear_slice(corner, np.reshape(axes, (2, 3)))
        options = {"ImagePositionPatient": [f"{v:.8f}" for v in corner], "ImageOrientationPatient": list(axes)}
        save(classic(plane, 0, n + 1, **options), folder / f"{n}.dcm")


def check_linear(folder: Path, note: str, tolerance: float = 1.5) -> None:
    """Every voxel that the slices cover has the value of its place, and the grid is upright."""
    volume = read_volume(folder)
    columns = volume.ijk_to_ras[:3, :3] / volume.spacing_mm
    np.testing.assert_allclose(columns.T @ columns, np.eye(3), atol=1e-6)
    k, j, i = np.indices(volume.array.shape)
    lps = (volume.ijk_to_ras @ np.stack([i.ravel(), j.ravel(), k.ravel(), np.ones(i.size)]))[:3].T * (-1, -1, 1)
    expected = (lps @ GRADIENT + 20000).reshape(volume.array.shape)
    off = np.abs(volume.array - expected) > tolerance
    covered = SHAPE[0] * SHAPE[1] * len(volume.array)
    assert (~off).sum() > 0.85 * covered, (~off).sum() / covered
    assert note in " ".join(volume.notes)


def test_tilt_of_parts_of_pixels(tmp_path: Path) -> None:
    corners = np.array([(*ORIGIN_MM, 0.0)]) + np.arange(9)[:, None] * (0.0, 0.37, 2.5)
    save_slices(tmp_path, corners)
    check_linear(tmp_path, "gantry tilt of 8.4 degrees; resampled to an upright grid (linear)")


def test_tilt_of_an_oblique_stack(tmp_path: Path) -> None:
    axes = np.reshape(OBLIQUE, (2, 3))
    step = 2.5 * np.cross(*axes) + 0.3 * axes[0] - 0.4 * axes[1]
    save_slices(tmp_path, np.array([(*ORIGIN_MM, 0.0)]) + np.arange(9)[:, None] * step, OBLIQUE)
    check_linear(tmp_path, "gantry tilt of 11.3 degrees")


def test_steps_that_grow(tmp_path: Path) -> None:
    heights = np.cumsum([0, 2, 2, 2, 2, 2.5, 2.8, 2, 2, 3])
    save_slices(tmp_path, np.array([(*ORIGIN_MM, h) for h in heights]))
    check_linear(tmp_path, "slices 2 to 3 mm apart; resampled to 2 mm (linear)")


def test_jitter_of_height_and_sideways(tmp_path: Path) -> None:
    generator = np.random.default_rng(4)
    corners = np.array([(*ORIGIN_MM, 3.0 * n) for n in range(10)]) + generator.uniform(-0.6, 0.6, (10, 3))
    save_slices(tmp_path, corners)
    check_linear(tmp_path, "moved back to their places (linear)")


def test_frames_of_one_file_are_resampled_as_slices_are(tmp_path: Path) -> None:
    heights = [0, 3, 6, 9.5, 12, 15]
    save(
        enhanced([linear_slice(np.array((*ORIGIN_MM, h)), np.eye(3)[:2]) for h in heights], heights), tmp_path / "a.dcm"
    )
    check_linear(tmp_path, "resampled to 3 mm (linear)")


@pytest.mark.parametrize("rounded", [0, 0.05])
def test_what_is_even_stays_as_it_is(rounded: float, tmp_path: Path) -> None:
    """Headers round positions: that is no reason to blur."""
    corners = np.array([(*ORIGIN_MM, 3.3333 * n) for n in range(9)])
    corners[:, 2] = np.round(corners[:, 2] / rounded) * rounded if rounded else corners[:, 2]
    save_slices(tmp_path, corners)
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array, [linear_slice(corner, np.eye(3)[:2]) for corner in corners])
    assert not any("resampled" in note for note in volume.notes)
    itk = sitk.ReadImage(sitk.ImageSeriesReader.GetGDCMSeriesFileNames(str(tmp_path)))
    np.testing.assert_array_equal(sitk.GetArrayViewFromImage(itk), volume.array)
    for ijk in ((0, 0, 0), (19, 23, 8)):
        ras = (volume.ijk_to_ras @ (*ijk, 1))[:3]
        np.testing.assert_allclose(ras, np.multiply(itk.TransformIndexToPhysicalPoint(ijk), (-1, -1, 1)), atol=0.06)


def test_a_large_gap_of_many_slices_is_filled_in_place(tmp_path: Path) -> None:
    heights = [0.0, 3, 6, 9, 18, 21, 24, 27]
    save_slices(tmp_path, np.array([(*ORIGIN_MM, h) for h in heights]))
    check_linear(tmp_path, "1 gaps between slices, where 3 mm is usual: 9 mm after 9 mm")
    assert len(read_volume(tmp_path).array) == 10


def test_single_slice_keeps_its_thickness(tmp_path: Path) -> None:
    save(classic(planes(1)[0], 4, 1), tmp_path / "a.dcm")
    volume = read_volume(tmp_path)
    np.testing.assert_allclose(volume.spacing_mm, (*SPACING_MM, 3))
    assert volume.notes == ()
