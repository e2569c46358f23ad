"""Colour volumes out: exact round trips, SimpleITK as an independent reader, and nothing half-written left."""

from __future__ import annotations

import subprocess
import sys
from datetime import datetime
from pathlib import Path

import nibabel as nib
import nrrd
import numpy as np
import pytest
import SimpleITK as sitk
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from volume_samples import GEOMETRIES, LPS, SHAPE, geometry, save_nrrd, voxels

from MedColorLib.errors import InputError, OutputError
from MedColorLib.io import files as volume_io
from MedColorLib.io.files import check_output_path, read_color_volume, write_color_volume
from MedColorLib.volume import ColorVolume


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(numbers=st.lists(st.floats(-1e6, 1e6), min_size=12, max_size=12))
def test_color_nrrd_keeps_any_numbers(numbers: list[float], tmp_path: Path) -> None:
    matrix = np.eye(4)
    matrix[:3] = np.reshape(numbers, (3, 4))
    try:
        volume = ColorVolume(voxels(np.dtype("u1"), (*SHAPE, 3)), matrix)
    except InputError:
        return  # a singular geometry
    write_color_volume(volume, tmp_path / "a.nrrd")
    back = read_color_volume(tmp_path / "a.nrrd")
    np.testing.assert_array_equal(back.rgb, volume.rgb)
    np.testing.assert_array_equal(back.ijk_to_ras, volume.ijk_to_ras)


@pytest.mark.parametrize("name", GEOMETRIES)
@pytest.mark.parametrize("ending", [".nrrd", ".nii", ".nii.gz"])
def test_color_volume_as_simpleitk_reads_it(name: str, ending: str, tmp_path: Path) -> None:
    volume = ColorVolume(voxels(np.dtype("u1"), (*SHAPE, 3)), geometry(name), name="a")
    path = tmp_path / f"a{ending}"
    write_color_volume(volume, path)
    back = read_color_volume(path)
    np.testing.assert_array_equal(back.rgb, volume.rgb)
    stored = volume.ijk_to_ras if ending == ".nrrd" else volume.ijk_to_ras.astype("f4")
    np.testing.assert_array_equal(back.ijk_to_ras, stored)
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]
    if ending != ".nrrd":
        header = nib.load(path).header
        assert (int(header["sform_code"]), int(header["qform_code"])) == (1, 0 if name == "sheared" else 1)
        if name == "sheared":
            return  # ITK refuses it
    image = sitk.ReadImage(path)
    assert image.GetNumberOfComponentsPerPixel() == 3 and image.GetSize() == SHAPE[::-1]
    np.testing.assert_array_equal(sitk.GetArrayFromImage(image), volume.rgb)
    for ijk in [(0, 0, 0), (5, 4, 3)]:
        point = LPS[:3, :3] @ image.TransformIndexToPhysicalPoint(ijk)
        np.testing.assert_allclose(point, (volume.ijk_to_ras @ (*ijk, 1))[:3], atol=1e-4)


def test_equal_volumes_make_equal_files(tmp_path: Path, monkeypatch) -> None:
    """Whenever they are written: pynrrd's comment with the time is blanked, and nothing else of the file is touched."""
    volume = ColorVolume(voxels(np.dtype("u1"), (*SHAPE, 3)), geometry("rotated"))
    files, plain = [], tmp_path / "plain.nrrd"
    for year in (1999, 2031):

        class Clock:
            utcnow = now = staticmethod(lambda *_, year=year: datetime(year, 5, 6, 7, 8, 9))

        monkeypatch.setattr("nrrd.writer.datetime", Clock)
        write_color_volume(volume, tmp_path / f"{year}.nrrd")
        files.append((tmp_path / f"{year}.nrrd").read_bytes())
        with monkeypatch.context() as patch:
            patch.setattr(volume_io, "_blank_time", lambda _: None)
            write_color_volume(volume, plain)
        assert str(year).encode() in plain.read_bytes()
    assert files[0] == files[1] and b"2031" not in files[1].split(b"\n\n")[0]
    lines = [data.split(b"\n") for data in (files[1], plain.read_bytes())]
    assert [n for n, (one, other) in enumerate(zip(*lines)) if one != other] == [2] and len(lines[0]) == len(lines[1])


def test_color_reader_refuses_other_volumes(tmp_path: Path) -> None:
    gray, four = voxels(np.dtype("u1")), voxels(np.dtype("u1"), (*SHAPE, 4))
    directions = np.vstack([np.full(3, np.nan), np.eye(3)])
    save_nrrd(tmp_path / "gray.nrrd", gray)
    save_nrrd(
        tmp_path / "rgba.nrrd", four, **{"space directions": directions, "kinds": ["RGBA-color"] + ["domain"] * 3}
    )
    save_nrrd(tmp_path / "wide.nrrd", four[..., :3].astype("u2"), **{"space directions": directions})
    nib.save(nib.Nifti1Image(gray.T, LPS), tmp_path / "gray.nii")
    (tmp_path / "a.png").write_bytes(b"0")
    for name in ("gray.nrrd", "rgba.nrrd", "wide.nrrd", "gray.nii", "a.png", "missing.nrrd"):
        with pytest.raises(InputError, match=name):
            read_color_volume(tmp_path / name)


def small() -> ColorVolume:
    return ColorVolume(voxels(np.dtype("u1"), (*SHAPE, 3)), np.eye(4))


def test_output_errors_come_early_and_name_the_remedy(tmp_path: Path) -> None:
    (tmp_path / "folder.nrrd").mkdir()
    cases = {"a.mha": ".nii.gz", "a": ".nrrd", "no folder/a.nrrd": "does not exist", "folder.nrrd": "is a folder"}
    for name, word in cases.items():
        for call in (check_output_path, lambda path: write_color_volume(small(), path)):
            with pytest.raises(OutputError, match=word):
                call(tmp_path / name)
    assert check_output_path(tmp_path / "A.NII.GZ") == ".nii.gz"
    assert [entry.name for entry in tmp_path.iterdir()] == ["folder.nrrd"]


def test_nifti_refuses_what_its_header_cannot_hold(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"write \.nrrd"):
        write_color_volume(ColorVolume(np.zeros((1, 1, 40_000, 3), np.uint8), np.eye(4)), tmp_path / "a.nii")
    assert list(tmp_path.iterdir()) == []


def test_read_only_folder() -> None:
    if not Path("/proc/self").is_dir():
        pytest.skip("needs a folder that nobody can write in")
    with pytest.raises(OutputError, match="cannot write"):
        check_output_path("/proc/self/a.nrrd")


@pytest.mark.parametrize("ending", [".nrrd", ".nii", ".nii.gz"])
def test_full_disk_leaves_the_former_file_alone(ending: str, tmp_path: Path) -> None:
    """A limit on the size of files stands for the full disk: the system refuses to write on."""
    resource = pytest.importorskip("resource")
    path = tmp_path / f"a{ending}"
    path.write_bytes(b"former")
    large = ColorVolume(voxels(np.dtype("u1"), (20, 50, 50, 3)), np.eye(4))
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, limits[1]))
    try:
        with pytest.raises(OutputError, match="cannot be written"):
            write_color_volume(large, path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]
    assert path.read_bytes() == b"former"


@pytest.mark.parametrize(
    "ending, library, function", [(".nrrd", nrrd, "write"), (".nii.gz", nib.Nifti1Image, "to_stream")]
)
def test_interruption_leaves_nothing(ending, library, function, tmp_path: Path, monkeypatch) -> None:
    def interrupted(*args, **kwargs) -> None:
        if isinstance(args[0], str):
            Path(args[0]).write_bytes(b"half")
        else:
            args[1].write(b"half")
        assert [entry.name.endswith(f"-unfinished-a{ending}") for entry in tmp_path.iterdir()] == [True]
        raise KeyboardInterrupt

    monkeypatch.setattr(nrrd, "write", interrupted)
    monkeypatch.setattr(nib.Nifti1Image, "to_stream", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_color_volume(small(), tmp_path / f"a{ending}")
    assert list(tmp_path.iterdir()) == []


def test_killed_process_leaves_no_file_of_the_final_name(tmp_path: Path) -> None:
    program = (
        "import os, nrrd, numpy as np\n"
        "from MedColorLib.io import files as volume_io; from MedColorLib.volume import ColorVolume\n"
        "nrrd.write = lambda path, *a, **k: (open(path, 'wb').write(b'half'), os.kill(os.getpid(), 9))\n"
        "volume = ColorVolume(np.zeros((2, 2, 2, 3), 'u1'), np.eye(4))\n"
        f"volume_io.write_color_volume(volume, {str(tmp_path / 'a.nrrd')!r})"
    )
    root = Path(volume_io.__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", program], cwd=root, check=False)
    assert done.returncode == -9
    assert not (tmp_path / "a.nrrd").exists()
    assert all("unfinished" in entry.name and entry.name.startswith(".") for entry in tmp_path.iterdir())


class TestConfidence:
    @pytest.mark.parametrize("ending", [".nrrd", ".nii.gz"])
    def test_scalars_on_the_same_grid(self, tmp_path, ending):
        from MedColorLib import read_volume, write_confidence

        matrix = np.array([[0.0, -0.5, 0, 3], [0.7, 0, 0, -8], [0, 0, 2.5, 11], [0, 0, 0, 1]])
        values = np.random.default_rng(0).integers(0, 101, (3, 4, 5)).astype(np.uint8)
        colored = ColorVolume(np.zeros((3, 4, 5, 3), np.uint8), matrix, confidence=values)
        write_confidence(colored, tmp_path / f"trust{ending}")
        back = read_volume(tmp_path / f"trust{ending}")
        np.testing.assert_array_equal(back.array, values)
        np.testing.assert_allclose(back.ijk_to_ras, matrix, atol=1e-6 if ending == ".nii.gz" else 0)

    def test_none_to_write(self, tmp_path):
        from MedColorLib import write_confidence

        colored = ColorVolume(np.zeros((3, 4, 5, 3), np.uint8), np.eye(4))
        with pytest.raises(InputError, match=r"holds no confidence; colour it with Settings\(confidence=True\)"):
            write_confidence(colored, tmp_path / "trust.nrrd")
        assert not list(tmp_path.iterdir())
