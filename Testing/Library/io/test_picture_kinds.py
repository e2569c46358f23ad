"""Kinds of TIFF, BMP and JPEG that programs write: pages one by one, previews, inks, ImageJ's calibration, wrong endings."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from MedColorLib.errors import InputError
from MedColorLib.io.files import list_volumes, read_volume
from MedColorLib.io.tiff import tiff_stacks

A = np.random.default_rng(8).integers(0, 32768, (6, 7, 9)).astype(np.uint16)
BYTES = (A >> 7).astype(np.uint8)


@pytest.mark.parametrize("where", ["file", "folder"])
@pytest.mark.parametrize("kind", ["grey", "alpha", "preview first", "preview last"])
def test_pages_written_one_by_one(kind: str, where: str, tmp_path: Path) -> None:
    options = {"photometric": "minisblack", **({"extrasamples": ["unassalpha"]} if kind == "alpha" else {})}
    with tifffile.TiffWriter(tmp_path / "a.tif") as writer:
        if kind == "preview first":
            writer.write(BYTES[0, :3, :3], subfiletype=1)
        for plane in BYTES:
            writer.write(np.stack([plane, np.full_like(plane, 255)], -1) if kind == "alpha" else plane, **options)
        if kind == "preview last":
            writer.write(BYTES[0, :3, :3], subfiletype=1)
    volume = read_volume(tmp_path / "a.tif" if where == "file" else tmp_path)
    np.testing.assert_array_equal(volume.array, BYTES)
    assert volume.notes[0] == "6 pages that the TIFF holds one by one were put together in their order"


def test_pages_of_two_sizes_written_one_by_one(tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "a.tif") as writer:
        for n, plane in enumerate(A):
            writer.write(plane if n % 3 else plane[:5, :5])
    assert [choice.size for choice in list_volumes(tmp_path / "a.tif")[0]] == [(9, 7, 4), (5, 5, 2)]
    np.testing.assert_array_equal(read_volume(tmp_path / "a.tif").array, A[[1, 2, 4, 5]])
    np.testing.assert_array_equal(read_volume(tmp_path / "a.tif", volume=2).array, A[[0, 3], :5, :5])


@pytest.mark.parametrize("leads", ["round in a circle", "to an empty page"])
def test_pages_that_lead_nowhere(leads: str, tmp_path: Path) -> None:
    cv2.imwritemulti(str(tmp_path / "a.tif"), list(A))
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        places = [page.offset for page in file.pages]
    data = bytearray((tmp_path / "a.tif").read_bytes())
    last = places[-1] + 2 + 12 * int.from_bytes(data[places[-1] : places[-1] + 2], "little")
    target = places[2] if leads == "round in a circle" else len(data)
    data[last : last + 4] = target.to_bytes(4, "little")
    (tmp_path / "a.tif").write_bytes(bytes(data) + bytes(6))
    with pytest.raises(InputError, match=r"1 of its 7 pages hold no picture|before its last voxel"):
        read_volume(tmp_path / "a.tif")


@pytest.mark.parametrize("shape", [(1, 6, 1, 7, 9), (6, 1, 7, 9), (1, 1, 6, 7, 9)])
def test_axes_of_length_one_without_names(shape: tuple[int, ...], tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", A.reshape(shape), photometric="minisblack")
    np.testing.assert_array_equal(read_volume(tmp_path / "a.tif").array, A)


@pytest.mark.parametrize("axis", [0, 1])
def test_two_axes_without_names(axis: int, tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", np.stack([A, A // 2], axis), photometric="minisblack")
    for number, expected in enumerate((A, A // 2), 1):
        volume = read_volume(tmp_path / "a.tif", volume=number)
        np.testing.assert_array_equal(volume.array, expected)
        assert "the axes of the TIFF have no names; the longest is taken as that of the slices" in volume.notes


@pytest.mark.parametrize(
    "intercept, slope, dtype", [(-32768.0, 1.0, "i2"), (-1024.0, 1.0, "i4"), (-100.5, 0.25, "f4"), (0.0, 1.0, "u2")]
)
def test_calibration_of_imagej(intercept: float, slope: float, dtype: str, tmp_path: Path) -> None:
    words = {"axes": "ZYX", "cf": 0, "c0": intercept, "c1": slope}
    tifffile.imwrite(tmp_path / "a.tif", A, imagej=True, metadata=words)
    volume = read_volume(tmp_path / "a.tif")
    np.testing.assert_array_equal(volume.array, intercept + slope * A.astype(np.float64))
    assert volume.array.dtype == np.dtype(dtype)
    assert any("calibrated as ImageJ's words say" in note for note in volume.notes) == (dtype != "u2")


@pytest.mark.parametrize("photometric, name", [("separated", "CMYK"), ("cielab", "CIE")])
def test_inks_and_lab_are_no_grey(photometric: str, name: str, tmp_path: Path) -> None:
    channels = 4 if photometric == "separated" else 3
    tifffile.imwrite(tmp_path / "a.tif", np.repeat(BYTES[..., None], channels, -1), photometric=photometric)
    with pytest.raises(InputError, match=rf"its colours are .*{name}.*; save the slices as grey"):
        read_volume(tmp_path / "a.tif")


def test_pictures_renamed_without_being_converted(tmp_path: Path) -> None:
    for n, plane in enumerate(A):
        (tmp_path / "png").mkdir(exist_ok=True)
        (tmp_path / "tif").mkdir(exist_ok=True)
        (tmp_path / "png" / f"{n}.tif").write_bytes(cv2.imencode(".png", plane)[1].tobytes())
        (tmp_path / "tif" / f"{n}.png").write_bytes(cv2.imencode(".tif", plane)[1].tobytes())
    for name in ("png", "tif"):
        np.testing.assert_array_equal(read_volume(tmp_path / name).array, A)


@pytest.mark.parametrize("mode", ["L", "RGB", "P", "1"])
def test_bmp_slices(mode: str, tmp_path: Path) -> None:
    for n, plane in enumerate(BYTES):
        image = Image.fromarray(plane)
        if mode == "P":
            image = image.convert("P")
            image.putpalette([level for n in range(256) for level in (n, n, n)])
        elif mode == "1":
            image = Image.fromarray(plane > 100)
        (image.convert(mode) if mode == "RGB" else image).save(tmp_path / f"slice{n}.bmp")
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array, (BYTES > 100) * 255 if mode == "1" else BYTES)
    assert ("grey saved as" in volume.notes[0]) == (mode == "RGB")


def test_jpeg_slices(tmp_path: Path) -> None:
    smooth = np.linspace(20, 230, 6)[:, None, None] + np.zeros((1, 16, 24))
    for n, plane in enumerate(smooth.astype(np.uint8)):
        Image.fromarray(plane).convert("RGB" if n % 2 else "L").save(tmp_path / f"{n}.jpg", quality=95)
    volume = read_volume(tmp_path)
    np.testing.assert_allclose(volume.array, smooth.astype(np.uint8), atol=2)
    assert "JPEG slices have lost fine detail; PNG or TIFF keep it" in volume.notes
    data = (tmp_path / "3.jpg").read_bytes()
    (tmp_path / "3.jpg").write_bytes(data[: len(data) * 2 // 3])
    with pytest.raises(InputError, match=r"slice 3\.jpg: not a readable BMP or JPEG image, or cut short"):
        read_volume(tmp_path)
    Image.new("RGB", (24, 16), (200, 60, 50)).save(tmp_path / "3.jpg")
    with pytest.raises(InputError, match=r"slice 3\.jpg: a colour .* only be a reference"):
        read_volume(tmp_path)


def test_better_slices_go_before_bmp_and_jpeg(tmp_path: Path) -> None:
    for n, plane in enumerate(BYTES):
        Image.fromarray(plane).save(tmp_path / f"{n}.png")
    for n in range(9):
        Image.fromarray(BYTES[0]).save(tmp_path / f"{n}.jpg")
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array, BYTES)


def test_a_file_of_previews_alone_names_them(tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "a.tif") as writer:
        for size in (4, 8):
            plane = np.arange(3 * size * size, dtype=np.uint8).reshape(3, size, size)
            writer.write(plane, photometric="minisblack", subfiletype=1)
    assert [stack.label for stack in tiff_stacks(tmp_path / "a.tif")] == ["series 1", "series 2"]
