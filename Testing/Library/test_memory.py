"""Memory: files that need no unpacking are mapped, and no stage copies the volume as a whole."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import tempfile
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
from scipy import ndimage
from volume_samples import LPS, save_nrrd

from MedColorLib import ColorVolume, Settings, colorize, read_volume, write_color_volume
from MedColorLib.io import dicom as dicom_series
from MedColorLib.report import voxels_sha256
from MedColorLib.scan import parts, reduced
from MedColorLib.scan.body import find_body
from MedColorLib.scan.intensity import choose_window, strided
from MedColorLib.scan.parts import _find_parts

ROOT = Path(__file__).resolve().parents[2]
DRAFT = Settings(preset="draft", features="embedded", device="cpu", slices=(2, 5))


def save_raw(path: Path, array: np.ndarray) -> None:
    """Uncompressed, by the ending: .nrrd, .nhdr (with .raw), .mha or .mhd (with .raw), in the array's byte order."""
    if path.suffix in (".nrrd", ".nhdr"):
        save_nrrd(path, array, encoding="raw")
        return
    order = "True" if array.dtype.newbyteorder("=").newbyteorder(">") == array.dtype else "False"
    sizes = " ".join(map(str, array.shape[::-1]))
    lines = ["ObjectType = Image", "NDims = 3", "BinaryData = True", f"BinaryDataByteOrderMSB = {order}"]
    lines += [f"DimSize = {sizes}", "ElementType = MET_SHORT"]
    if path.suffix == ".mha":
        path.write_bytes("\n".join([*lines, "ElementDataFile = LOCAL", ""]).encode() + array.tobytes())
        return
    path.write_text("\n".join([*lines, f"ElementDataFile = {path.stem}.raw", ""]), encoding="ascii")
    path.with_suffix(".raw").write_bytes(array.tobytes())


def is_mapped(array: np.ndarray) -> bool:
    while array is not None and not isinstance(array, np.memmap):
        array = array.base
    return array is not None


def peak_bytes(work) -> int:
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.usefixtures("small_raster")
@pytest.mark.parametrize("swapped", [False, True], ids=["native", "swapped"])
@pytest.mark.parametrize("ending", [".nrrd", ".nhdr", ".mha", ".mhd"])
def test_raw_files_are_mapped_and_colored_as_from_memory(ending, swapped, ct, tmp_path):
    array = ct.volume.array.astype(np.int16)
    path = tmp_path / f"a{ending}"
    save_raw(path, array.astype(array.dtype.newbyteorder()) if swapped else array)
    before = {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in tmp_path.iterdir()}
    volume = read_volume(path)
    assert is_mapped(volume.array) and not volume.array.flags.writeable
    np.testing.assert_array_equal(volume.array, array)
    if ending == ".mha":
        np.testing.assert_array_equal(sitk.GetArrayFromImage(sitk.ReadImage(str(path))), array)
    inside = type(volume)(array, volume.ijk_to_ras, name=volume.name)
    mapped, plain = (colorize(v, [ct.reference], DRAFT) for v in (volume, inside))
    np.testing.assert_array_equal(mapped.rgb, plain.rgb)
    assert mapped.report["input"] == plain.report["input"]
    assert before == {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in tmp_path.iterdir()}


def test_packed_files_are_read_in_native_order(tmp_path):
    array = np.arange(60, dtype=">i2").reshape(3, 4, 5)
    save_nrrd(tmp_path / "a.nrrd", array)
    found = read_volume(tmp_path / "a.nrrd").array
    assert not is_mapped(found) and found.dtype.isnative
    np.testing.assert_array_equal(found, array)


@pytest.mark.parametrize("limit", [0, 1 << 30])
def test_large_dicom_series_lies_in_a_file_without_a_name(limit, tmp_path, monkeypatch):
    monkeypatch.setattr(dicom_series, "IN_MEMORY", limit)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    (tmp_path / "series").mkdir()
    array = np.arange(4 * 5 * 6, dtype=np.int16).reshape(4, 5, 6)
    for k, plane in enumerate(array):
        image = sitk.GetImageFromArray(plane[None])
        for tag, value in {"0020|000e": "1.2", "0020|0032": f"0\\0\\{k}", "0020|0037": "1\\0\\0\\0\\1\\0"}.items():
            image.SetMetaData(tag, value)
        writer = sitk.ImageFileWriter()
        writer.KeepOriginalImageUIDOn()
        writer.SetFileName(str(tmp_path / "series" / f"{k}.dcm"))
        writer.Execute(image)
    volume = read_volume(tmp_path / "series")
    np.testing.assert_array_equal(volume.array, array)
    assert is_mapped(volume.array) == (limit == 0)
    assert any("temporary file" in note for note in volume.notes) == (limit == 0)
    if os.name == "posix":
        assert not list((tmp_path / "temporary").iterdir())


def test_dicom_stays_in_memory_where_the_disk_has_no_room(tmp_path, monkeypatch):
    monkeypatch.setattr(dicom_series, "IN_MEMORY", 0)
    monkeypatch.setattr("MedColorLib.io.voxel_data.shutil.disk_usage", lambda _: type("Usage", (), {"free": 10})())
    sitk.WriteImage(sitk.GetImageFromArray(np.ones((1, 5, 6), np.int16)), str(tmp_path / "a.dcm"))
    volume = read_volume(tmp_path)
    assert not is_mapped(volume.array) and not any("temporary" in note for note in volume.notes)


class TestSamples:
    """By planes the same values come out as by the plain formula on a copy."""

    @pytest.mark.parametrize("limit", [1, 7, 64, 1000, 10**6])
    def test_transposed_and_flipped_views(self, limit, rng):
        array = rng.integers(-1000, 1000, (7, 9, 11)).astype(np.int16)
        for view in (array, array.T, array.transpose(1, 0, 2), array[::-1, :, ::-1], array[:, ::2]):
            flat = view.reshape(-1)
            np.testing.assert_array_equal(strided(view, limit), flat[:: -(-flat.size // limit) | 1].astype(np.float64))

    @pytest.mark.parametrize("share", [0.0, 0.01, 0.4, 1.0])
    def test_inside_a_mask(self, share, rng):
        array = rng.normal(size=(5, 8, 9))
        mask = rng.random(array.shape) < share
        for view, inside in ((array, mask), (array.T, mask.T)):
            flat = view[inside]
            step = -(-flat.size // 50) | 1
            np.testing.assert_array_equal(strided(view, 50, inside), flat[::step])

    def test_window_of_a_body(self, ct):
        window = choose_window(ct.volume.array, ct.inside)
        low, high = np.percentile(ct.volume.array[ct.inside].astype(np.float64), (0.5, 99.5))
        assert (window.low, window.high) == pytest.approx((low, high))

    def test_hash_does_not_depend_on_layout_or_byte_order(self, ct):
        array = np.asarray(ct.volume.array)
        expected = hashlib.sha256(np.ascontiguousarray(array).data).hexdigest()
        for same in (array, np.asfortranarray(array), array.astype(array.dtype.newbyteorder())):
            assert voxels_sha256(same) == expected


def test_parts_found_by_planes_are_those_of_the_stack(rng):
    for _ in range(200):
        mask = rng.random((rng.integers(1, 6), *rng.integers(1, 12, 2))) < rng.choice([0.0, 0.05, 0.3, 0.5, 0.8])
        found = _find_parts(mask * parts.TISSUE, 1)
        labels, _ = ndimage.label(mask)
        assert sorted(found.size) == sorted(np.bincount(labels.ravel())[1:])
        flags = mask * parts.TISSUE
        parts._select(flags, found, found.size >= 4)
        np.testing.assert_array_equal((flags & parts.BODY) > 0, mask & (np.bincount(labels.ravel()) >= 4)[labels])


class TestPeak:
    def test_outline_takes_two_bytes_for_a_pixel_of_its_raster(self, monkeypatch):
        """Flags and mask; a stack of labels or floats would be 8 to 19 bytes."""
        monkeypatch.setattr(reduced, "_SAMPLE", 1000)
        rows, cols = np.mgrid[:128, :128] - 63.5
        body = np.hypot(rows, cols) < 50
        stack = np.broadcast_to(body.astype(np.uint8), (480, 128, 128))
        peaks = [peak_bytes(lambda n=n: find_body(stack[:n])) for n in (240, 480)]
        assert peaks[1] - peaks[0] < 2.5 * 240 * 128 * 128

    @pytest.mark.parametrize("ending", [".nrrd", ".nii", ".nii.gz"])
    def test_writing_does_not_copy_the_result(self, ending, tmp_path):
        volume = ColorVolume(np.zeros((300, 256, 256, 3), np.uint8), LPS)
        assert peak_bytes(lambda: write_color_volume(volume, tmp_path / f"a{ending}")) < 0.3 * volume.rgb.nbytes


_CHILD = """
import json, resource, sys
import numpy as np, scipy.ndimage, scipy.sparse.csgraph, torch
from dataclasses import replace
from MedColorLib import Settings, Volume, colorize, read_volume
from MedColorLib.parameters import PRESETS
from MedColorLib.phantom import sample, section
torch.set_num_threads(1)
PRESETS["draft"] = replace(PRESETS["draft"], grid_px=64)
def status(name):
    return next(1024 * int(line.split()[1]) for line in open("/proc/self/status") if line.startswith(name))
"""

_LIMITED = """
from MedColorLib.run.prepare import prepare
settings = Settings(preset="draft", features="embedded", device="cpu", slices=(100, 104))
colorize(sample("ct")[0], [section()], replace(settings, slices=(20, 24)))  # everything is loaded before the limit
voxels = 512 * 512 * 400
def allow(more):
    resource.setrlimit(resource.RLIMIT_DATA, (status("VmData") + more, resource.RLIM_INFINITY))
allow(2 * voxels)
volume = read_volume(sys.argv[1])
assert volume.array.nbytes == 2 * voxels
prepare(volume, [section()], settings)
allow(3 * voxels + 2 * voxels)
result = colorize(volume, [section()], settings)
print(json.dumps({"colored": sum(int(plane.any(-1).sum()) for plane in result.rgb)}))
"""

_GROWTH = """
settings = Settings(preset="draft", features="embedded", device="cpu", coherence_mm=3.0)
colorize(sample("ct")[0], [section()], replace(settings, slices=(20, 24)))
volume = read_volume(sys.argv[1])
peak = before = status("RssAnon")
def watch(fraction, text):
    global peak
    peak = max(peak, status("RssAnon"))
result = colorize(volume, [section()], settings, progress=watch)
print(json.dumps({"over": peak - before - result.rgb.nbytes}))
"""


def cylinder(path: Path, count: int, side: int, stack_axis: int = 0) -> None:
    """Raw NRRD of `count` transverse slices, made by formula; the file's axis `stack_axis` of (k, j, i) runs upwards."""
    rows, cols = (np.mgrid[:side, :side] - (side - 1) / 2) / (side / 2)
    bone, air = np.hypot(rows - 0.3, cols) < 0.2, np.random.default_rng(0).normal(-1000, 10, rows.shape)
    tissue = (60 + 50 * np.sin(6 * cols + n / 3) + 400 * bone for n in range(8))
    planes = [np.where(np.hypot(rows, cols) < 0.8, values, air).astype("<i2") for values in tissue]
    axes = {0: ((-1, 0, 0), (0, -1, 0), (0, 0, 1)), 2: ((0, 0, 1), (0, -1, 0), (-1, 0, 0))}[stack_axis]
    shape = (count, side, side) if stack_axis == 0 else (side, side, count)
    vectors = " ".join(f"({x},{y},{z})" for x, y, z in axes)
    header = (
        f"NRRD0004\ntype: short\ndimension: 3\nspace: RAS\nsizes: {shape[2]} {shape[1]} {shape[0]}\n"
        f"space directions: {vectors}\nspace origin: (0,0,0)\nendian: little\nencoding: raw\n\n"
    ).encode()
    with path.open("wb") as file:
        file.write(header)
        if stack_axis == 0:
            for n in range(count):
                file.write(planes[n % 8].tobytes())
        else:
            stack = np.stack([planes[n % 8] for n in range(count)])
            for column in range(side):
                file.write(np.ascontiguousarray(stack[:, :, column].T).tobytes())


def in_child(code: str, path: Path) -> dict:
    done = subprocess.run(
        [sys.executable, "-c", _CHILD + code, str(path)],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
        env={**os.environ, "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"},
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs Linux: RLIMIT_DATA counts what a process maps")
class TestProcess:
    @pytest.mark.parametrize("stack_axis", [0, 2], ids=["transverse", "sagittal"])
    def test_colors_with_less_memory_than_a_copy_of_the_input(self, stack_axis, tmp_path):
        """512 x 512 x 400 of int16: 200 MiB as it is, 400 MiB as float32; 200 MiB are allowed, and then the result."""
        cylinder(tmp_path / "a.nrrd", 400, 512, stack_axis)
        assert in_child(_LIMITED, tmp_path / "a.nrrd")["colored"] > 4 * 100_000

    def test_peak_grows_by_the_result_and_the_outline_alone(self, tmp_path):
        over = {}
        for count in (200, 800):
            cylinder(tmp_path / "a.nrrd", count, 64)
            over[count] = in_child(_GROWTH, tmp_path / "a.nrrd")["over"]
        assert over[800] - over[200] < 600 * 3 * 64 * 64 + 8 * 2**20  # outline 1 byte a pixel, 3 while it is found
