"""DICOM series in: order, geometry, what was picked and what was left out, on series written here and on a real one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk

from MedColorLib.errors import InputError
from MedColorLib.io.files import read_volume
from MedColorLib.volume import Volume

MR = Path(__file__).resolve().parents[4] / "shared" / "data" / "mr_head_t1_dicom"
LPS = np.diag([-1.0, -1.0, 1.0])
AXIAL = (1, 0, 0, 0, 1, 0)
OBLIQUE = (0.8, 0.6, 0, -0.6, 0.8, 0)
SPACING = (0.75, 0.5)  # along i, along j
VOXELS = np.random.default_rng(5).integers(-1000, 3000, (9, 5, 6)).astype(np.int16)


def text(*numbers: float) -> str:
    return "\\".join(f"{number:.12g}" for number in numbers)


def save(
    path: Path, pixels: np.ndarray, position: Sequence[float] = (), axes: Sequence[float] = AXIAL, **tags: str
) -> None:
    """One DICOM file. `tags` as t0008_103e="..." set or replace elements."""
    image = sitk.GetImageFromArray(pixels[None], isVector=pixels.ndim == 3)
    image.SetSpacing((*SPACING, 2.5))
    elements = {"t0008_0060": "CT", "t0020_000e": "1.2.3", "t0020_0011": "4", "t0010_0010": "DOE^JANE", **tags}
    if position:
        elements.update(t0020_0032=text(*position), t0020_0037=text(*axes))
    for tag, value in elements.items():
        image.SetMetaData(tag[1:].replace("_", "|"), value)
    writer = sitk.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    writer.SetImageIO("GDCMImageIO")
    writer.SetFileName(str(path))
    writer.Execute(image)


def save_stack(folder: Path, positions: Sequence[Sequence[float]], prefix: str = "", **kwargs) -> None:
    """Slice n shows VOXELS[n]; the file names are in another order."""
    folder.mkdir(exist_ok=True)
    for number, position in enumerate(positions):
        name = f"{prefix}{(number * 7) % 10}.dcm"
        save(folder / name, VOXELS[number], position, t0020_0013=str(number + 1), **kwargs)


def along_z(*heights: float) -> list[tuple[float, float, float]]:
    return [(-20.5, 30.25, height) for height in heights]


def check(
    volume: Volume,
    positions: Sequence[Sequence[float]],
    axes: Sequence[float] = AXIAL,
    shift: Sequence[float] = (0, 0),
) -> None:
    """Every voxel of every slice lies where its file says (DICOM PS3.3, C.7.6.2.1.1)."""
    for k, position in enumerate(np.add(positions, (*shift, 0))):
        for j, i in [(0, 0), (4, 5), (2, 1)]:
            expected = np.array(position) + SPACING[0] * i * np.array(axes[:3]) + SPACING[1] * j * np.array(axes[3:])
            np.testing.assert_allclose((volume.ijk_to_ras @ (i, j, k, 1))[:3], LPS @ expected, atol=1e-9)


def test_slices_are_ordered_by_position(tmp_path: Path) -> None:
    positions = along_z(-10, -7, -4, -1, 2)
    save_stack(tmp_path, positions)
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array, VOXELS[:5])
    assert volume.array.dtype == np.int16
    check(volume, positions)
    assert (volume.notes, volume.window, volume.name) == ((), None, "CT series 4")


def test_oblique_stack_written_from_the_far_end(tmp_path: Path) -> None:
    normal = np.cross(OBLIQUE[:3], OBLIQUE[3:])
    positions = [tuple(np.array([5.0, 6, 7]) - 1.25 * number * normal) for number in range(4)]
    save_stack(tmp_path, positions, axes=OBLIQUE)
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array, VOXELS[3::-1])
    check(volume, positions[::-1], OBLIQUE)


def test_gantry_tilt_is_resampled_to_an_upright_grid(tmp_path: Path) -> None:
    """Whole pixels of shift, so that every voxel of the file is still there, at its own place."""
    positions = [(0.0, 0.5 * number, 2.0 * number) for number in range(5)]
    save_stack(tmp_path, positions)
    volume = read_volume(tmp_path)
    assert volume.array.shape == (5, 9, 6) and volume.array.dtype == np.int16
    for k in range(5):
        np.testing.assert_array_equal(volume.array[k, k : k + 5], VOXELS[k])
    check(volume, along_z(0, 2, 4, 6, 8), shift=(20.5, -30.25))
    assert volume.notes == ("gantry tilt of 14.0 degrees; resampled to an upright grid (linear)",)


def test_gap_is_reported_with_its_place_and_size_and_filled(tmp_path: Path) -> None:
    save_stack(tmp_path, along_z(0, 3, 6, 12, 15))
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array[[0, 1, 2, 4, 5]], VOXELS[:5])
    np.testing.assert_allclose(volume.array[3], (VOXELS[2] + VOXELS[3].astype(float)) / 2, atol=0.5)
    check(volume, along_z(0, 3, 6, 9, 12, 15))
    assert len(volume.notes) == 1 and "1 gaps" in volume.notes[0] and "6 mm after 6 mm" in volume.notes[0]
    assert "filled by interpolation" in volume.notes[0]


def test_blocks_far_from_each_other_are_refused(tmp_path: Path) -> None:
    save_stack(tmp_path, along_z(0, 3, 6, 99, 102))
    with pytest.raises(InputError, match=r"blocks far from each other.*folder of their own"):
        read_volume(tmp_path)


def test_uneven_steps_are_resampled_to_their_median(tmp_path: Path) -> None:
    save_stack(tmp_path, along_z(0, 3, 6, 9.5, 12))
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array[[0, 1, 2, 4]], VOXELS[[0, 1, 2, 4]])
    np.testing.assert_allclose(volume.array[3], VOXELS[2] / 7 + VOXELS[3] * 6 / 7, atol=0.5 + 1e-6)
    check(volume, along_z(0, 3, 6, 9, 12))
    assert volume.notes == ("slices 2.5 to 3.5 mm apart; resampled to 3 mm (linear)",)


def test_rounded_positions_do_not_add_up(tmp_path: Path) -> None:
    heights = np.round(np.arange(9) * 10 / 3, 2)  # 3.33, 6.67, 10.00
    save_stack(tmp_path, along_z(*heights))
    volume = read_volume(tmp_path)
    assert volume.notes == () and volume.spacing_mm[2] == pytest.approx(heights[-1] / 8, abs=1e-12)


def test_slices_at_a_place_already_taken_are_another_volume(tmp_path: Path) -> None:
    save_stack(tmp_path, along_z(0, 3, 6, 9, 3, 6))
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array, VOXELS[:4])
    assert "left out: 2: CT series 4, image 2 of 2 at its place (6 x 5 x 2)" in volume.notes[0]
    assert "told apart by their times and numbers alone" in volume.notes[1]
    np.testing.assert_array_equal(read_volume(tmp_path, volume=2).array, VOXELS[4:6])


def test_slices_shifted_sideways_are_moved_back(tmp_path: Path) -> None:
    positions = along_z(0, 3, 6, 9)
    positions[2] = (positions[2][0] + 2 * SPACING[0], *positions[2][1:])
    save_stack(tmp_path, positions)
    volume = read_volume(tmp_path)
    assert volume.array.shape == (4, 5, 8)
    np.testing.assert_array_equal(volume.array[[0, 1, 3], :, :6], VOXELS[[0, 1, 3]])
    np.testing.assert_array_equal(volume.array[2, :, 2:], VOXELS[2])
    check(volume, along_z(0, 3, 6, 9))
    assert volume.notes == ("slices are shifted sideways by up to 1.5 mm; moved back to their places (linear)",)


def test_largest_series_and_the_series_of_a_file(tmp_path: Path) -> None:
    save_stack(tmp_path, along_z(0, 3, 6, 9), "large")
    save_stack(tmp_path, along_z(0, 5), "small", t0020_000e="1.2.4", t0020_0011="9", t0008_0060="MR")
    volume = read_volume(tmp_path)
    assert volume.array.shape[0] == 4
    assert volume.notes == (
        "CT series 4 (6 x 5 x 4) was read, the largest of 2 volumes; left out: 2: MR series 9 (6 x 5 x 2) (choose with "
        "--volume N, `medcolor info` lists all)",
    )
    assert read_volume(tmp_path, volume=2).name == "MR series 9"
    with pytest.raises(InputError, match="volume 3 is not there: there are volumes 1 to 2"):
        read_volume(tmp_path, volume=3)
    volume = read_volume(tmp_path / "small7.dcm")
    assert (volume.array.shape[0], volume.spacing_mm[2], volume.name) == (2, 5, "MR series 9")
    (tmp_path / "small7.dcm").rename(tmp_path / "no ending")
    assert read_volume(tmp_path / "no ending").array.shape[0] == 2


def test_mixed_orientation_size_spacing_and_other_objects_are_left_out(tmp_path: Path) -> None:
    save_stack(tmp_path, along_z(0, 3, 6, 9))
    save_stack(tmp_path, along_z(1, 2), "turned", axes=(0, 1, 0, 0, 0, -1))
    save(tmp_path / "large.dcm", np.zeros((7, 7), np.int16), (0, 0, 12))
    save(tmp_path / "color.dcm", np.zeros((5, 6, 3), np.uint8), (0, 0, 12))
    (tmp_path / "DICOMDIR").write_bytes(bytes(128) + b"DICM" + bytes(50))
    whole = (tmp_path / "large.dcm").read_bytes()
    (tmp_path / "cut.dcm").write_bytes(whole[: len(whole) - 20])
    (tmp_path / "readme.txt").write_text("no DICOM")
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array, VOXELS[:4])
    assert volume.notes[:2] == (
        "1 DICOM files without a readable image were left out",
        "1 colour images were left out",
    )
    assert "left out: 2: CT series 4 (7 x 7 x 1); 3: CT series 4, image 1 of 2" in volume.notes[2]


def test_medium_with_nested_folders(tmp_path: Path) -> None:
    save_stack(tmp_path / "S0001", along_z(0, 3))
    save_stack(tmp_path / "S0002", along_z(0, 3, 6), t0020_000e="1.2.4")
    assert read_volume(tmp_path).array.shape[0] == 3


def test_rescale_that_differs_between_slices(tmp_path: Path) -> None:
    """As in PET: stored numbers times each slice's own slope."""
    truth = [np.arange(30.0).reshape(5, 6) * slope for slope in (0.5, 0.25, 2.0)]
    for number, (pixels, slope) in enumerate(zip(truth, ("0.5", "0.25", "2"))):
        kind = {"t0028_0100": "16", "t0028_0101": "16", "t0028_0102": "15", "t0028_0103": "0"}
        rescale = {"t0028_1053": slope, "t0028_1052": "0"}
        save(tmp_path / f"{number}.dcm", pixels.astype(np.float32), along_z(number)[0], **kind, **rescale)
    volume = read_volume(tmp_path)
    assert volume.array.dtype == np.float32
    np.testing.assert_array_equal(volume.array, truth)


@pytest.mark.parametrize(
    "center, width, window, notes",
    [
        ("40", "400", (-160, 240), 0),
        ("40\\300", "400\\2000", (-160, 240), 1),
        ("40", "0", None, 0),
        ("40", "-5", None, 0),
        ("x", "400", None, 0),
        ("nan", "400", None, 0),
    ],
)
def test_window(center: str, width: str, window: tuple | None, notes: int, tmp_path: Path) -> None:
    save_stack(tmp_path, along_z(0, 3), t0028_1050=center, t0028_1051=width)
    volume = read_volume(tmp_path)
    assert volume.window == window and len(volume.notes) == notes


def replace_in(folder: Path, old: bytes, new: bytes) -> None:
    """For elements that ITK does not let a program choose."""
    for path in folder.iterdir():
        data = path.read_bytes()
        assert data.count(old) == 1 and len(old) == len(new)
        path.write_bytes(data.replace(old, new))


def test_slices_without_positions_follow_their_numbers(tmp_path: Path) -> None:
    for number in range(3):
        save(tmp_path / f"{9 - number}.dcm", VOXELS[number], (0, 0, 0), t0020_0013=str(number), t0018_0050="2.5")
    replace_in(tmp_path, b"\x20\x00\x32\x00", b"\x20\x00\x33\x00")
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array, VOXELS[:3])
    np.testing.assert_allclose(volume.spacing_mm, (*SPACING, 2.5))
    assert len(volume.notes) == 1 and "without a position" in volume.notes[0]


def test_multi_frame_file(tmp_path: Path) -> None:
    frames = VOXELS[:4].astype(np.uint16)
    image = sitk.GetImageFromArray(frames)
    sitk.WriteImage(image, tmp_path / "frames.dcm")
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array, frames)
    np.testing.assert_array_equal(volume.ijk_to_ras, np.diag([-1.0, -1.0, 1.0, 1.0]))
    assert volume.notes == ()


def test_monochrome1_is_noted(tmp_path: Path) -> None:
    save_stack(tmp_path, along_z(0, 3))
    replace_in(tmp_path, b"MONOCHROME2", b"MONOCHROME1")
    assert "MONOCHROME1" in read_volume(tmp_path).notes[-1]


def test_unusable_folders(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "a.dcm").write_bytes(bytes(128) + b"DICM" + bytes(50))
    with pytest.raises(InputError, match="no readable DICOM image"):
        read_volume(tmp_path / "a")
    (tmp_path / "b").mkdir()
    save(tmp_path / "b" / "color.dcm", np.zeros((5, 6, 3), np.uint8))
    with pytest.raises(InputError, match="colour"):
        read_volume(tmp_path / "b")
    save_stack(tmp_path / "c", along_z(0, 3, 6))
    assert read_volume(tmp_path / "c", max_bytes=180).array.nbytes == 180
    with pytest.raises(InputError, match="GiB"):
        read_volume(tmp_path / "c", max_bytes=179)


def test_no_patient_data_and_no_chatter(tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    save_stack(tmp_path / "DICOM", along_z(0, 3, 9, 9), t0010_0020="ID-77", t0008_103e="DOE JANE HEAD")
    volume = read_volume(tmp_path / "DICOM")
    said = " ".join([volume.name, *volume.notes])
    assert said.count("slices") and not any(word in said for word in ("DOE", "JANE", "ID-77"))
    assert capfd.readouterr() == ("", "")


def test_real_mr() -> None:
    if not MR.is_dir():
        pytest.skip("the shared images are not here")
    volume = read_volume(MR)
    assert (volume.array.shape, volume.array.dtype, volume.name) == ((48, 512, 512), np.uint16, "MR series 2")
    np.testing.assert_allclose(volume.spacing_mm, [0.41015625, 0.41015625, 1.5], rtol=1e-9)
    assert volume.notes == ("the window differs from slice to slice; the median is used",)
    low, high = volume.window
    assert low < 50 and 1100 < high < 1300
    reader = sitk.ImageSeriesReader()
    reader.SetFileNames(reader.GetGDCMSeriesFileNames(str(MR)))
    image = reader.Execute()
    np.testing.assert_array_equal(sitk.GetArrayViewFromImage(image), volume.array)
    for ijk in [(0, 0, 0), (511, 511, 47)]:
        np.testing.assert_allclose(
            LPS @ image.TransformIndexToPhysicalPoint(ijk), (volume.ijk_to_ras @ (*ijk, 1))[:3], atol=1e-4
        )
