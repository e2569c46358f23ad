"""Unusable, damaged, oversized and hostile files: each gives one line that names the file and the reason."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import nibabel as nib
import numpy as np
import pytest
import SimpleITK as sitk
from volume_samples import SHAPE, save_nrrd, sound_files, voxels

from MedColorLib.errors import InputError
from MedColorLib.io.files import file_sha256, list_volumes, read_color_volume, read_volume, write_color_volume
from MedColorLib.volume import ColorVolume


def bad_inputs(folder: Path) -> dict[str, str]:
    """Names of unusable files and folders in `folder`, and a word of the message that each has to give."""
    gray, color = voxels(np.dtype("u1")), voxels(np.dtype("u1"), (*SHAPE, 3))
    save_nrrd(folder / "flat.nrrd", gray[0], **dict.fromkeys(("space", "space directions", "space origin")))
    directions = np.vstack([np.full(3, np.nan), np.eye(3)])
    save_nrrd(folder / "rgb.nrrd", color, **{"space directions": directions, "kinds": ["RGB-color"] + ["domain"] * 3})
    four_d = {"space directions": None, "space origin": None, "space": None}
    save_nrrd(folder / "four.nrrd", color, **four_d)
    save_nrrd(folder / "singular.nrrd", gray, np.diag([1.0, 0.0, 1.0, 1.0]))
    (folder / "block.nrrd").write_text("NRRD0004\ntype: block\ndimension: 3\nsizes: 1 1 1\nencoding: raw\n\n0")
    (folder / "order.nrrd").write_text("NRRD0004\ntype: int\ndimension: 3\nsizes: 1 1 1\nencoding: raw\n\n0000")
    (folder / "huge.nrrd").write_text("NRRD0004\ntype: uchar\ndimension: 3\nsizes: 99999 99999 99\nencoding: gzip\n\n0")
    (folder / "bomb.nrrd").write_text("NRRD0004\ntype: uchar\ndimension: 3\nsizes: 999 999 999\nencoding: gzip\n\n0")
    (folder / "axes.nrrd").write_text("NRRD0004\ntype: uchar\ndimension: 4\nsizes: 9 9 9\nencoding: raw\n\n")
    (folder / "outside.nhdr").write_text(
        "NRRD0004\ntype: uchar\ndimension: 3\nsizes: 1 1 1\nencoding: raw\ndata file: ../../../../../etc/passwd\n"
    )
    (folder / "gone.nhdr").write_text(
        "NRRD0004\ntype: uchar\ndimension: 3\nsizes: 1 1 1\nencoding: raw\ndata file: a.raw\n"
    )
    meta = "NDims = 3\nDimSize = 2 2 2\nElementType = MET_UCHAR\nElementDataFile = "
    (folder / "outside.mhd").write_text(f"{meta}/etc/passwd\n")
    (folder / "gone.mhd").write_text(f"{meta}a.raw\n")
    (folder / "list.mhd").write_text(f"{meta}LIST\na.raw\n")
    sitk.WriteImage(sitk.GetImageFromArray(gray), folder / "short.mha", useCompression=True)
    text = (folder / "short.mha").read_bytes()
    (folder / "short.mha").write_bytes(text.replace(b"DimSize = 6 5 4", b"DimSize = 6 5 9"))
    sitk.WriteImage(sitk.GetImageFromArray(color, isVector=True), folder / "rgb.mha")
    sitk.WriteImage(sitk.GetImageFromArray(gray[0]), folder / "flat.mha")
    nib.save(nib.Nifti1Image(np.zeros((4, 4, 4, 2), np.uint8), np.eye(4)), folder / "four.nii")
    nib.save(nib.Nifti1Image(np.zeros((4, 4), np.uint8), np.eye(4)), folder / "flat.nii.gz")
    nib.save(nib.Nifti1Image(np.zeros((4, 4, 4), np.complex64), np.eye(4)), folder / "complex.nii")
    write_color_volume(ColorVolume(color, np.eye(4)), folder / "rgb.nii")
    cv2.imwrite(str(folder / "flat.png"), gray[0])
    cv2.imwrite(str(folder / "flat.tif"), gray[0])
    cv2.imwritemulti(str(folder / "rgb.tif"), list(color))
    cv2.imwritemulti(str(folder / "mixed.tif"), [gray[0], gray[1, :3]])
    for name, pictures in {
        "mixed": (gray[0], gray[0, :3]),
        "colors": color,
        "types": (gray[0], gray[0].astype("u2")),
    }.items():
        (folder / name).mkdir()
        for number, picture in enumerate(pictures):
            cv2.imwrite(str(folder / name / f"{number}.png"), picture)
    (folder / "empty folder").mkdir()
    (folder / "other folder").mkdir()
    (folder / "other folder" / "readme.txt").write_text("nothing")
    (folder / "text.txt").write_text("no image")
    for ending in (".nrrd", ".nhdr", ".mha", ".mhd", ".nii", ".nii.gz", ".tif", ".dcm"):
        (folder / f"garbage{ending}").write_bytes(np.random.default_rng(1).bytes(5000))
        (folder / f"empty{ending}").write_bytes(b"")
    (folder / "wrong.nii").write_bytes((folder / "flat.tif").read_bytes())
    (folder / "wrong.nii.gz").write_bytes((folder / "flat.tif").read_bytes())
    return {
        **{
            "flat.nrrd": "two-dimensional",
            "rgb.nrrd": "reference",
            "four.nrrd": "dimensions",
            "singular.nrrd": "directions",
        },
        **{"block.nrrd": "block", "order.nrrd": "endian", "huge.nrrd": "GiB", "bomb.nrrd": "ends before"},
        **{"axes.nrrd": "dimension", "outside.nhdr": "outside", "gone.nhdr": "missing", "outside.mhd": "outside"},
        **{"gone.mhd": "missing", "list.mhd": "one file", "short.mha": "ends before", "rgb.mha": "reference"},
        **{"flat.mha": "two-dimensional", "four.nii": "dimensions", "flat.nii.gz": "two-dimensional"},
        **{"complex.nii": "complex", "rgb.nii": "reference", "flat.png": "folder", "flat.tif": "folder"},
        **{
            "rgb.tif": "reference",
            "mixed.tif": "one size",
            "mixed": "one size",
            "colors": "reference",
            "types": "one size",
        },
        **{
            "empty folder": "neither",
            "other folder": "neither",
            "text.txt": "endings",
            "missing.nrrd": "does not exist",
        },
        **{f"garbage{ending}": "" for ending in (".nrrd", ".nhdr", ".mha", ".mhd", ".nii", ".nii.gz", ".tif", ".dcm")},
        **{
            f"empty{ending}": "empty"
            for ending in (".nrrd", ".nhdr", ".mha", ".mhd", ".nii", ".nii.gz", ".tif", ".dcm")
        },
        **{"wrong.nii": "NIfTI", "wrong.nii.gz": "NIfTI"},
    }


def test_bad_input_is_named_with_a_reason(tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    for name, word in bad_inputs(tmp_path).items():
        with pytest.raises(InputError) as caught:
            read_volume(tmp_path / name)
        message = str(caught.value)
        assert message.startswith(str(tmp_path / name)) and word in message and "\n" not in message, (name, message)
    assert capfd.readouterr() == ("", "")


def test_truncated_files_never_pass_as_whole(tmp_path: Path) -> None:
    """Wherever a file is cut: an `InputError`, or (check sums and trailers cut off) every voxel as it was."""
    for path in sound_files(tmp_path):
        data, whole = path.read_bytes(), read_volume(path)
        refused = 0
        for cut in range(1, len(data), 13):
            path.write_bytes(data[:cut])
            try:
                np.testing.assert_array_equal(read_volume(path).array, whole.array)
            except InputError:
                refused += 1
        assert refused > 0.9 * len(range(1, len(data), 13)), path


def test_damaged_files_raise_nothing_but_input_errors(tmp_path: Path) -> None:
    generator = np.random.default_rng(11)
    for path in sound_files(tmp_path):
        data = np.frombuffer(path.read_bytes(), np.uint8)
        for _ in range(80):
            damaged = data.copy()
            damaged[generator.integers(0, min(len(data), 400), 2)] = generator.integers(0, 256, 2)
            path.write_bytes(damaged.tobytes())
            try:
                volume = read_volume(path, max_bytes=10_000_000)
            except InputError:
                continue
            assert volume.array.nbytes <= 10_000_000


@pytest.mark.parametrize("name", ["gzip.nrrd", "packed.mha"])
def test_damaged_compressed_voxels_are_noticed(name: str, tmp_path: Path) -> None:
    sound_files(tmp_path)
    data = bytearray((tmp_path / name).read_bytes())
    for at in range(1, 200, 7):
        damaged = data.copy()
        damaged[-at - 8] ^= 0x55
        (tmp_path / name).write_bytes(damaged)
        with pytest.raises(InputError):
            read_volume(tmp_path / name)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names here")
@pytest.mark.parametrize("read", [read_volume, list_volumes, read_color_volume, file_sha256])
def test_a_pipe_is_not_waited_for(read, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.nrrd")
    with pytest.raises(InputError, match="neither a file nor a folder"):
        read(tmp_path / "a.nrrd")


def test_limit_on_size_names_both_sizes(tmp_path: Path) -> None:
    for path in sound_files(tmp_path):
        assert read_volume(path, max_bytes=240).array.nbytes == 240
        with pytest.raises(InputError, match="GiB"):
            read_volume(path, max_bytes=239)


def test_data_file_behind_a_link_is_refused(tmp_path: Path) -> None:
    (tmp_path / "inside").mkdir()
    (tmp_path / "secret.raw").write_bytes(bytes(8))
    (tmp_path / "inside" / "link.raw").symlink_to(tmp_path / "secret.raw")
    header = tmp_path / "inside" / "a.nhdr"
    header.write_text("NRRD0004\ntype: uchar\ndimension: 3\nsizes: 2 2 2\nencoding: raw\ndata file: link.raw\n")
    with pytest.raises(InputError, match="outside"):
        read_volume(header)
